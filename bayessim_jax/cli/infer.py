"""`bayessim infer CASE`: a posterior over a case's parameters, and predictions before and after."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from bayessim_jax.cli.parsing import UsageError, parse

if TYPE_CHECKING:
    from collections.abc import Sequence

__all__ = ["Infer", "infer"]


@dataclass(frozen=True)
class Infer:
    """Infer the parameters of a case from its recordings, and write a run folder with the posterior and a report."""

    case: tyro.conf.Positional[Annotated[Path, tyro.conf.arg(metavar="CASE")]]
    """The case: a folder with a case.toml."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="RUN")] = None
    """Run folder to make; runs/CASE-infer by default."""
    method: Literal["direct", "amortised", "laplace"] = "direct"
    """direct: the likelihood, written down, with a sampler that corrects Laplace's approximation; amortised: networks
    that learn from simulations of the recordings' windows; laplace: that approximation alone."""
    engine: Literal["auto", "tree", "mujoco", "mjx"] = "auto"
    """What steps the model."""
    mask: bool = False
    """Use recordings in which numbers are missing or gaps are longer than a window: nothing is compared there."""
    seed: int = 0
    """Seed of everything random."""
    draws: int = 2000
    """Draws of the posterior."""
    quiet: bool = False
    """Print nothing but errors."""


def infer(words: Sequence[str]) -> int:
    """Run the inference; returns the exit code."""
    command = parse(Infer, words, "bayessim infer")
    if command.draws < 100:
        raise UsageError(f"draws is {command.draws}; give at least 100.")
    if command.seed < 0:
        raise UsageError(f"seed is {command.seed}; give 0 or more.")
    from bayessim_jax.cli.case_run import CaseRun

    settings = {
        "method": command.method,
        "engine": command.engine,
        "mask": command.mask,
        "seed": command.seed,
        "draws": command.draws,
    }
    with CaseRun.open("infer", command.case, command.out, settings, list(words), command.quiet) as run:
        import jax

        from bayessim_jax.recordings.identification import infer_case
        from bayessim_jax.recordings.results import write_inference
        from bayessim_jax.report.infer import headline, render

        run.facts["method"] = command.method
        model = run.model(engine=command.engine)
        key, options = jax.random.key(command.seed), {"method": command.method, "draws": command.draws}
        result = infer_case(key, model, **options, say=run.say)
        write_inference(run.folder, result, command.seed)
        run.conclude(render(result, run.facts), [headline(result)])
    return run.code
