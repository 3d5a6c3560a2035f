"""A sensor whose zero is not where it should be."""

from __future__ import annotations

import mujoco

from bayessim_jax.contracts import Scalar
from bayessim_jax.effects.contract import EffectParameter, Memory, Moment, Number, Scales, SenseEffect, Values
from bayessim_jax.effects.places import encoders

__all__ = ["SensorOffset"]

TURN = 1.5
"""rad: as far as a base may be tilted, which in a plane is the same."""


class SensorOffset(SenseEffect):
    """q ↦ q + q₀, in the unit of the channel."""

    name = "sensor_offset"

    def places(self, model: mujoco.MjModel) -> list[str]:
        """Positions of hinges and slides, and sensors of one number."""
        return encoders(model)

    def parameters(self, place: str, scales: Scales) -> tuple[EffectParameter, ...]:
        """The offset q₀."""
        reach = scales.position
        most = max(0.5 * reach, TURN) if scales.unit == "rad" else 0.5 * reach
        return (EffectParameter("offset", scales.unit, -most, most, 0.0, 0.03 * reach, scan=4),)

    def sense(self, values: Values, memory: Memory, reading: Scalar, moment: Moment) -> Scalar:
        """The sum q + q₀."""
        return reading + values["offset"]

    def restore(self, values: Values, moment: Moment) -> tuple[Number, Number]:
        """The position q − q₀."""
        return moment.position - values["offset"], moment.velocity
