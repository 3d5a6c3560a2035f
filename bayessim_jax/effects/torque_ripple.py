"""A torque that comes and goes with the angle: cogging, teeth, an eccentric gear."""

from __future__ import annotations

import math

import jax.numpy as jnp
import mujoco

from bayessim_jax.effects.contract import EffectParameter, ForceEffect, Memory, Moment, Number, Scales, Values
from bayessim_jax.effects.places import joints

__all__ = ["TorqueRipple"]


class TorqueRipple(ForceEffect):
    """τ = A sin(n q + φ), A in N m or N, n in cycles per turn (per 2π m of a slide), φ in rad."""

    name = "torque_ripple"

    def places(self, model: mujoco.MjModel) -> list[str]:
        """Every hinge and slide."""
        return joints(model)

    def parameters(self, place: str, scales: Scales) -> tuple[EffectParameter, ...]:
        """A, n and φ."""
        turns = 1.0 if scales.unit == "rad" else math.pi / scales.position
        force = scales.force
        return (
            EffectParameter("amplitude", scales.force_unit, 0.0, force, 0.0, 0.1 * force),
            EffectParameter("cycles", "", turns, 100.0 * turns, 6.0 * turns, 6.0 * turns, log=True, scan=20),
            EffectParameter("phase", "rad", -1.5 * math.pi, 1.5 * math.pi, 0.0, 0.0, scan=3),
        )

    def force(self, values: Values, memory: Memory, moment: Moment) -> tuple[Number, Memory]:
        """A sine of the angle."""
        return values["amplitude"] * jnp.sin(values["cycles"] * moment.position + values["phase"]), memory
