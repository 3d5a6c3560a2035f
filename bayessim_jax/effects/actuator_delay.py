"""A command that arrives late."""

from __future__ import annotations

import math
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from bayessim_jax.contracts import Scalar
from bayessim_jax.effects.contract import ActEffect, EffectParameter, Memory, Moment, Scales, Values
from bayessim_jax.effects.history import RECENT

__all__ = ["ActuatorDelay"]

LEAST, MOST = 16, 400
"""The fewest and the most time steps that are remembered: the longest delay is longer or shorter for it."""


class ActuatorDelay(ActEffect):
    """u(t) ↦ u(t − T), T any fraction of a time step.

    A command that is held from one time step to the next arrives, on average over a time step n, as
    (1 − f) u[n − k] + f u[n − k − 1] with T/h = k + f. T in s, 0.1 at most, or 16 time steps where these are longer.
    """

    name = "actuator_delay"
    hurries = True
    brief = True

    def parameters(self, place: str, scales: Scales) -> tuple[EffectParameter, ...]:
        """The delay T."""
        high = scales.timestep * samples_back(scales.timestep)
        start = min(0.02 + 0.37 * scales.timestep, 0.5 * high)
        # a system without a model is simulated from few points, and its rows are its time steps
        scan = 4 if scales.timestep < scales.period else 0
        return (EffectParameter("seconds", "s", 0.0, high, 0.0, start, scan=scan, form=0.01, least=scales.shift),)

    def begin(self, values: Values, command: Any, moment: Moment) -> Memory:
        """The command as if it had always been the same, the latest first."""
        return jnp.full(samples_back(moment.h), command)

    def command(self, values: Values, memory: Memory, command: Any, moment: Moment) -> tuple[Any, Memory]:
        """The command T ago."""
        samples = jnp.concatenate([jnp.asarray(command)[None], memory])
        whole, rest = _split(values["seconds"] / moment.h, len(memory))
        place = jnp.arange(len(samples))
        share = jnp.where(place == whole, 1.0 - rest, jnp.where(place == whole + 1.0, rest, 0.0))
        return share @ samples, samples[:-1]

    def ahead(self, values: Values, memory: Memory, commands: Any, moment: Moment) -> tuple[Any, Memory]:
        """Shifted by one bit of k after the other, so that nothing is looked up."""
        back, count = len(memory), len(commands)
        samples = jnp.concatenate([memory[::-1], commands])
        whole, rest = _split(values["seconds"] / moment.h, back)
        late, bit = jnp.concatenate([samples[:1], samples]), 1
        whole = whole.astype(int)
        while bit < back:
            shifted = jnp.concatenate([jnp.broadcast_to(late[0], (bit,)), late[:-bit]])
            late = jnp.where(whole & bit, shifted, late)
            bit *= 2
        new = late[-count:] + rest * (late[-count - 1 : -1] - late[-count:])
        return new, _windows(samples[1:], count, back)[:, ::-1]


def samples_back(h: float) -> int:
    """How many earlier time steps are remembered."""
    return min(max(math.ceil(RECENT / h - 1e-9), LEAST), MOST)


def _windows(samples: Float[Array, " n"], count: int, length: int) -> Float[Array, "count length"]:
    """Numbers i to i + length in row i: rows that are each one longer than the numbers begin one later.

    Nothing is looked up, so that of rows that nobody reads none is made.
    """
    size = len(samples)
    flat = jnp.broadcast_to(samples, (count + 1, size)).reshape(-1)
    return flat[: count * (size + 1)].reshape(count, size + 1)[:, :length]


def _split(steps: Scalar, back: int) -> tuple[Scalar, Scalar]:
    """Whole and broken part of a number of time steps between 0 and `back`."""
    steps = jnp.clip(steps, 0.0, float(back))
    whole = jnp.minimum(jnp.floor(steps), back - 1.0)
    return whole, steps - whole
