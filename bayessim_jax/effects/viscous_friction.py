"""Friction in proportion to speed."""

from __future__ import annotations

import mujoco

from bayessim_jax.effects.contract import EffectParameter, ForceEffect, Memory, Moment, Number, Scales, Values
from bayessim_jax.effects.places import joints

__all__ = ["ViscousFriction"]


class ViscousFriction(ForceEffect):
    """τ = −b v.

    b in N m s/rad or N s/m. v is the mean of the velocities before and after the time step, v + (a + τ/m) h/2, which
    is stable for every b.
    """

    name = "viscous_friction"
    holds = True

    def places(self, model: mujoco.MjModel) -> list[str]:
        """Every hinge and slide."""
        return joints(model)

    def parameters(self, place: str, scales: Scales) -> tuple[EffectParameter, ...]:
        """The coefficient b."""
        high = 2.0 * scales.force / scales.speed
        return (EffectParameter("viscous", f"{scales.force_unit} s/{scales.unit}", 0.0, high, 0.0, 0.1 * high),)

    def force(self, values: Values, memory: Memory, moment: Moment) -> tuple[Number, Memory]:
        """Against the motion."""
        b, half = values["viscous"], 0.5 * moment.h
        coasting = moment.velocity + half * moment.acceleration
        return -b * coasting / (1.0 + b * half / moment.inertia), memory
