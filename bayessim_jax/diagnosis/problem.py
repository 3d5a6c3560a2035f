"""What a diagnosis is about, as arrays: what reads cases and writes files stands above it."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Int

from bayessim_jax.beliefs.margins import Margins
from bayessim_jax.diagnosis.bench import SLOTS, Bench
from bayessim_jax.diagnosis.response import Motion
from bayessim_jax.diagnosis.scene import Scene
from bayessim_jax.diagnosis.screen import Screen
from bayessim_jax.diagnosis.simulated_scene import SimulatedScene
from bayessim_jax.effects import Scales
from bayessim_jax.inference.replay import Restarted
from bayessim_jax.inference.shooting import Fit, Shots
from bayessim_jax.systems.mjcf import MjcfSystem

__all__ = ["WORKERS", "Problem"]

WORKERS = 2
"""Candidates that are tried at the same time."""
SCREENED = 30
"""Windows with which every candidate is tried at first."""


@dataclass(frozen=True)
class Problem:
    """What a diagnosis is about: a system, what is believed of it, what may be missing, and windows of recordings."""

    system: MjcfSystem | Restarted
    margins: Margins
    pairs: tuple[tuple[Any, str], ...]
    """Effects and places."""
    scales: Mapping[str, Scales]
    shots: Shots
    group: Int[np.ndarray, " windows"]
    """The recording of each window."""
    motion: Motion | None
    """The smoothed motion in the same windows; None for a system without a model, which is simulated instead."""
    step: float = 0.0
    ahead: Shots | None = None
    """Windows as long as predictions are to be, to which nothing is fitted."""

    @cached_property
    def every(self) -> Screen:
        """All pairs, to be held against some of the windows."""
        return self.screen(self.pairs)

    def screens(self) -> list[Screen]:
        """The same for each of those who work at the same time; what the others keep from fit to fit goes with them."""
        return [self.every, *(self.every.twin() for _ in range(1, WORKERS))]

    def screen(self, pairs: Sequence[tuple[Any, str]], slots: int = SLOTS) -> Screen:
        """Pairs to be held against some of the windows."""
        count = len(self.group)
        rows = np.unique(np.linspace(0, count - 1, min(SCREENED, count)).astype(int))
        every = (self.motion, self.shots.inputs, self.shots.y, self.shots.measured)
        motion, inputs, y, measured = jax.tree.map(lambda x: jax.device_put(np.asarray(x)[rows]), every)
        shots = dataclasses.replace(self.shots, inputs=inputs, y=y, measured=measured)
        if isinstance(self.system, Restarted):
            return Screen(SimulatedScene(Bench(self.system, self.margins, pairs, self.scales, shots, slots=slots)))
        assert motion is not None
        return Screen(Scene(self.system, self.margins, pairs, self.scales, shots, motion, self.step, slots))

    def bench(self, pairs: Sequence[tuple[Any, str]], slots: int = SLOTS) -> Bench:
        """A bench for these pairs."""
        return Bench(self.system, self.margins, pairs, self.scales, self.shots, self.step, slots)

    def still(self, fit: Fit) -> Fit:
        """A fit to other windows as where a fit to these begins."""
        return dataclasses.replace(fit, delta=jnp.zeros((len(self.group), fit.delta.shape[-1])))
