"""`bayessim evaluate RUN --recordings 'elsewhere/*.csv'`: a diagnosis' simulators on recordings given later."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from bayessim_jax.cli.parsing import UsageError, parse

if TYPE_CHECKING:
    from collections.abc import Sequence

__all__ = ["Evaluate", "evaluate"]


@dataclass(frozen=True)
class Evaluate:
    """Score the baseline and the augmented simulator of a diagnosis on other recordings, into RUN/evaluation.json."""

    run: tyro.conf.Positional[Annotated[Path, tyro.conf.arg(metavar="RUN")]]
    """Folder that bayessim diagnose wrote."""
    recordings: Annotated[str, tyro.conf.arg(metavar="PATTERN")]
    """Files to score on, such as 'elsewhere/*.csv' (quoted)."""
    quiet: bool = False
    """Print nothing but errors."""


def evaluate(words: Sequence[str]) -> int:
    """Evaluate a run; returns the exit code."""
    command = parse(Evaluate, words, "bayessim evaluate")
    import jax

    from bayessim_jax.cli.cache import use_compilation_cache
    from bayessim_jax.recordings.evaluation import evaluate_run, summary_lines
    from bayessim_jax.recordings.files import to_json, write_text
    from bayessim_jax.recordings.run_folder import RunFolder

    double = bool(jax.config.read("jax_enable_x64"))
    jax.config.update("jax_enable_x64", True)
    try:
        use_compilation_cache()
        folder = RunFolder.open(command.run)
        tell = (lambda line: None) if command.quiet else (lambda line: print(line, file=sys.stderr))
        result = evaluate_run(folder, command.recordings, tell)
        write_text(folder.path / "evaluation.json", to_json(result, indent=2) + "\n")
    except KeyError as error:
        raise UsageError(f"{command.run}: its files lack {error}; run bayessim diagnose again.") from error
    except ValueError as error:
        raise UsageError(str(error)) from error
    except Exception as error:  # whatever else goes wrong is told in one line, too
        reason = next(iter(str(error).splitlines()), "")
        print(f"bayessim: the evaluation failed: {type(error).__name__}: {reason[:300]}", file=sys.stderr)
        return 1
    finally:
        jax.config.update("jax_enable_x64", double)
    if not command.quiet:
        print("\n".join(summary_lines(result["fit"])))
    return 0
