"""What a run is about: a registered system, or the simulator that a diagnosis repaired."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from bayessim_jax import systems
from bayessim_jax.cli.options import DIAGNOSED, Settings
from bayessim_jax.systems import Entry

if TYPE_CHECKING:
    from bayessim_jax.contracts import Box

__all__ = ["Subject", "find_subject"]


@dataclass(frozen=True)
class Subject:
    """How the system and its tasks are made, and what is known of the target beforehand."""

    entry: Entry
    box: Box
    """The prior, where the settings say nothing else."""
    truth: Float[np.ndarray, " d"] | None = None
    """θ* where `--truth` does not name it; without it, a draw from the prior."""
    remarks: tuple[str, ...] = ()
    """What a person should know before it starts."""


def find_subject(settings: Settings) -> Subject:
    """What the settings name; raises `ValueError` where there is no such thing."""
    if settings.system != DIAGNOSED:
        for name, value in (("--from", settings.diagnosis), ("--goal", settings.goal)):
            if value:
                raise ValueError(f"{name} is for the simulator of a diagnosis; leave out {settings.system} or {name}.")
        entry = systems.lookup(settings.system)
        return Subject(entry, entry.system().parameters)
    if not settings.diagnosis:
        raise ValueError(f"system {DIAGNOSED} is what a diagnosis repaired: add --from RUN, its run folder.")
    from bayessim_jax.recordings.repaired import load_repaired

    repaired = load_repaired(Path(settings.diagnosis))
    task = repaired.task(settings.goal)
    summary = f"hold {repaired.name} in a pose"
    entry = Entry(repaired.system, lambda: task, "sac", summary, lambda: task)
    return Subject(entry, repaired.posterior_box(), repaired.mean, repaired.sentences(task))
