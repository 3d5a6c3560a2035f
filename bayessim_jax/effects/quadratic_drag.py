"""Drag of a body in a fluid."""

from __future__ import annotations

import jax.numpy as jnp
import mujoco

from bayessim_jax.effects.contract import EffectParameter, ForceEffect, Memory, Moment, Number, Scales, Values
from bayessim_jax.effects.places import joints

__all__ = ["QuadraticDrag"]


class QuadraticDrag(ForceEffect):
    """τ = −c v|v|.

    c in N m s²/rad² or N s²/m². v is the mean of the velocities before and after the time step, v + (a + τ/m) h/2, and
    |v| that before it, which is stable for every c.
    """

    name = "quadratic_drag"
    holds = True

    def places(self, model: mujoco.MjModel) -> list[str]:
        """Every hinge and slide."""
        return joints(model)

    def parameters(self, place: str, scales: Scales) -> tuple[EffectParameter, ...]:
        """The coefficient c."""
        high = 2.0 * scales.force / scales.speed**2
        return (
            EffectParameter(
                "coefficient", f"{scales.force_unit} s²/{scales.unit}²", 0.0, high, 0.0, 0.1 * high, form=0.01
            ),
        )

    def force(self, values: Values, memory: Memory, moment: Moment) -> tuple[Number, Memory]:
        """Against the motion."""
        rate, half = values["coefficient"] * jnp.abs(moment.velocity), 0.5 * moment.h
        coasting = moment.velocity + half * moment.acceleration
        return -rate * coasting / (1.0 + rate * half / moment.inertia), memory
