"""A command that arrives late."""

from __future__ import annotations

import math
from typing import Any

import jax.numpy as jnp
import mujoco

from bayessim_jax.contracts import Scalar
from bayessim_jax.effects.contract import ActEffect, EffectParameter, Memory, Moment, Number, Scales, Values
from bayessim_jax.effects.places import actuators

__all__ = ["LONGEST", "ActuatorDelay", "look_back", "samples_back"]

LONGEST = 0.1
"""The longest delay, s; what is remembered is as long."""
MOST = 100
"""The most time steps that are remembered, which makes the longest delay shorter where time steps are short."""


def samples_back(h: float) -> int:
    """How many earlier time steps are remembered."""
    return min(math.ceil(LONGEST / h - 1e-9), MOST)


def look_back(samples: Any, delay: Scalar, h: float) -> Number:
    """The number a delay ago of samples h apart, the latest first, on the line between the two nearest."""
    steps = jnp.clip(delay / h, 0.0, len(samples) - 1.0)
    whole = jnp.minimum(jnp.floor(steps), len(samples) - 2.0)
    rest = steps - whole
    total = 0.0
    for k, sample in enumerate(samples):
        weight = jnp.where(whole == k, 1.0 - rest, jnp.where(whole == k - 1, rest, 0.0))
        total = total + weight * sample
    return total


class ActuatorDelay(ActEffect):
    """u(t) ↦ u(t − T), T any fraction of a time step.

    A command that is held from one time step to the next arrives, on average over a time step n, as
    (1 − f) u[n − k] + f u[n − k − 1] with T/h = k + f. T in s, 0.1 at most.
    """

    name = "actuator_delay"

    def places(self, model: mujoco.MjModel) -> list[str]:
        """Every actuator."""
        return actuators(model)

    def parameters(self, place: str, scales: Scales) -> tuple[EffectParameter, ...]:
        """The delay T."""
        high = scales.timestep * samples_back(scales.timestep)
        return (EffectParameter("seconds", "s", 0.0, high, 0.0, min(0.02 + 0.37 * scales.timestep, 0.5 * high)),)

    def begin(self, values: Values, command: Any, moment: Moment) -> Memory:
        """The command as if it had always been the same, the latest first."""
        return (command,) * samples_back(moment.h)

    def command(self, values: Values, memory: Memory, command: Any, moment: Moment) -> tuple[Any, Memory]:
        """The command T ago."""
        samples = (command, *memory)
        return look_back(samples, values["seconds"], moment.h), samples[:-1]
