"""`bayessim online SYSTEM`: the outer loop against a target that hides its parameters, in a run folder."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

from bayessim_jax.cli.parsing import UsageError
from bayessim_jax.cli.resolution import read_command
from bayessim_jax.recordings.run_folder import RunFolder

if TYPE_CHECKING:
    from collections.abc import Sequence

__all__ = ["online"]


def online(words: Sequence[str]) -> int:
    """Start a run, or continue one; returns the exit code."""
    command = read_command(words)
    folder = RunFolder(command.folder)
    try:
        if not command.resume:
            folder.check_free(resumable=True)
        os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")  # XLA's remarks on slow compilation
        from bayessim_jax.cli.cache import use_compilation_cache
        from bayessim_jax.cli.memory import return_large_blocks
        from bayessim_jax.cli.plan import make_plan
        from bayessim_jax.cli.session import Session

        use_compilation_cache()
        return_large_blocks()
        plan = make_plan(command.settings)
        folder.check_writable() if command.resume else folder.create()
    except ValueError as error:
        raise UsageError(str(error)) from error
    return Session(plan, folder, list(words), command.resume, command.quiet).run()
