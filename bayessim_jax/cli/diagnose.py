"""`bayessim diagnose CASE`: is physics missing in the simulator, where, which, and how much better with it."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from threading import Thread
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from bayessim_jax.cli.parsing import UsageError, parse

if TYPE_CHECKING:
    from collections.abc import Sequence

__all__ = ["Diagnose", "diagnose"]

LATER = ("bayessim_jax.recordings.results", "bayessim_jax.report.diagnose")
"""What writes files and draws: it is imported beside the work, for that takes more than a second."""


@dataclass(frozen=True)
class Diagnose:
    """Compare a simulator with recordings: detect a mismatch, locate it, name the effect left out, and model it."""

    case: tyro.conf.Positional[Annotated[Path, tyro.conf.arg(metavar="CASE")]]
    """The case: a folder with a case.toml."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="RUN")] = None
    """Run folder to make; runs/CASE-diagnose by default."""
    engine: Literal["auto", "tree", "mujoco", "mjx"] = "auto"
    """What steps the model."""
    mask: bool = False
    """Use recordings in which numbers are missing or gaps are longer than a window: nothing is compared there."""
    seed: int = 0
    """Seed of everything random."""
    quiet: bool = False
    """Print nothing but errors."""


def diagnose(words: Sequence[str]) -> int:
    """Run the diagnosis; returns the exit code."""
    command = parse(Diagnose, words, "bayessim diagnose")
    if command.seed < 0:
        raise UsageError(f"seed is {command.seed}; give 0 or more.")
    from bayessim_jax.cli.case_run import CaseRun

    settings = {"engine": command.engine, "mask": command.mask, "seed": command.seed}
    with CaseRun.open("diagnose", command.case, command.out, settings, list(words), command.quiet) as run:
        import jax

        from bayessim_jax.recordings.diagnosing import diagnose_case
        from bayessim_jax.recordings.evaluation import BEFORE

        Thread(target=lambda: [import_module(name) for name in LATER]).start()
        model = run.model(engine=command.engine, before=BEFORE)
        diagnosis = diagnose_case(jax.random.key(command.seed), model, say=run.say)
        from bayessim_jax.recordings.results import write_diagnosis
        from bayessim_jax.report.diagnose import headline, render

        write_diagnosis(run.folder, diagnosis, command.seed)
        run.conclude(render(diagnosis, run.facts), [headline(diagnosis)])
    return run.code
