"""A sensor that shows what was."""

from __future__ import annotations

import math
from typing import Any

import jax.numpy as jnp
import mujoco

from bayessim_jax.contracts import Scalar
from bayessim_jax.effects.contract import EffectParameter, Memory, Moment, Number, Scales, SenseEffect, Values
from bayessim_jax.effects.places import joints

__all__ = ["SensorDelay"]

LONGEST = 0.1
"""The longest delay, s."""
MOST = 50
"""The most control periods that are remembered."""


class SensorDelay(SenseEffect):
    """q(t) ↦ q(t − T), T any fraction of a control period.

    Between the control periods that are remembered q is the cubic with their positions and velocities. A simulation
    begins where the joint will be T after it was where it was measured, by its acceleration and its jerk then, or by
    those of now where its velocity is measured of itself. T in s, 0.1 at most.
    """

    name = "sensor_delay"
    remembers = True

    def places(self, model: mujoco.MjModel) -> list[str]:
        """Positions of hinges and slides."""
        return [f"{joint}/qpos" for joint in joints(model)]

    def parameters(self, place: str, scales: Scales) -> tuple[EffectParameter, ...]:
        """The delay T."""
        high = scales.period * _count(scales.period)
        start = min(0.015, 0.4 * high)
        return (EffectParameter("seconds", "s", 0.0, high, 0.0, start, form=0.01, least=scales.shift),)

    def begin(self, values: Values, moment: Moment) -> Memory:
        """Positions and velocities of the last control periods, as with the acceleration and the jerk of now."""
        earlier = (_move(moment, -k * moment.h) for k in range(1, _count(moment.h) + 1))
        return ((moment.position, moment.velocity), *earlier)

    def track(self, values: Values, memory: Memory, moment: Moment) -> Memory:
        """With the latest first."""
        return ((moment.position, moment.velocity), *memory[:-1])

    def sense(self, values: Values, memory: Memory, reading: Scalar, moment: Moment) -> Scalar:
        """The position T ago, and what the reading is off by now."""
        period, back = moment.h, len(memory) - 1
        steps = jnp.clip(values["seconds"] / period, 0.0, float(back))
        whole = jnp.minimum(jnp.floor(steps), back - 1.0)
        f = steps - whole
        near, far = _pick(memory, whole), _pick(memory, whole + 1.0)
        rise = near[0] - far[0]
        bend = rise - period * far[1], period * near[1] - rise
        late = near[0] - f * (rise + (1.0 - f) * ((1.0 - f) * bend[1] + f * bend[0]))
        return late + (reading - memory[0][0])

    def restore(self, values: Values, moment: Moment) -> tuple[Number, Number]:
        """Where it is T after it was there."""
        if not moment.prompt:
            return _move(moment, values["seconds"])
        was, _ = _move(moment, -values["seconds"])
        return moment.position + (moment.position - was), moment.velocity


def _count(period: float) -> int:
    return max(1, min(math.ceil(LONGEST / period - 1e-9), MOST))


def _move(moment: Moment, time: Number) -> tuple[Number, Number]:
    """Position and velocity a time later."""
    a, jerk = moment.acceleration, moment.jerk
    position = moment.position + time * (moment.velocity + time * (a / 2.0 + time * jerk / 6.0))
    return position, moment.velocity + time * (a + time * jerk / 2.0)


def _pick(memory: Memory, number: Scalar) -> tuple[Any, Any]:
    position, velocity = 0.0, 0.0
    for k, (q, v) in enumerate(memory):
        here = jnp.where(number == k, 1.0, 0.0)
        position, velocity = position + here * q, velocity + here * v
    return position, velocity
