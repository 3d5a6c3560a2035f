"""A sensor whose scale is not what it should be."""

from __future__ import annotations

import mujoco

from bayessim_jax.contracts import Scalar
from bayessim_jax.effects.contract import EffectParameter, Memory, Moment, Number, Scales, SenseEffect, Values
from bayessim_jax.effects.places import encoders

__all__ = ["SensorScale"]


class SensorScale(SenseEffect):
    """q ↦ k q.

    A velocity that is not measured of itself comes from the same sensor, and is k times too large as well.
    """

    name = "sensor_scale"

    def places(self, model: mujoco.MjModel) -> list[str]:
        """Positions of hinges and slides, and sensors of one number."""
        return encoders(model)

    def parameters(self, place: str, scales: Scales) -> tuple[EffectParameter, ...]:
        """The scale k: edges counted once or four times, or another gear, are factors."""
        return (EffectParameter("scale", "", 0.125, 8.0, 1.0, 1.05, log=True, scan=7),)

    def sense(self, values: Values, memory: Memory, reading: Scalar, moment: Moment) -> Scalar:
        """The product k q."""
        return values["scale"] * reading

    def restore(self, values: Values, moment: Moment) -> tuple[Number, Number]:
        """Both divided by k."""
        return moment.position / values["scale"], moment.velocity / values["scale"]
