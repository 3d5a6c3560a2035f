"""A spring on a joint, with a cubic part."""

from __future__ import annotations

import jax.numpy as jnp
import mujoco

from bayessim_jax.effects.contract import EffectParameter, ForceEffect, Memory, Moment, Number, Scales, Values
from bayessim_jax.effects.places import joints

__all__ = ["JointSpring"]


class JointSpring(ForceEffect):
    """τ = −k (q − q₀) − k₃ (q − q₀)³.

    A spring that softens (k₃ < 0) ends where it has no force left. k in N m/rad or N/m, q₀ in rad or m, k₃ in N m/rad³
    or N/m³.
    """

    name = "joint_spring"

    def places(self, model: mujoco.MjModel) -> list[str]:
        """Every hinge and slide."""
        return joints(model)

    def parameters(self, place: str, scales: Scales) -> tuple[EffectParameter, ...]:
        """k, q₀ and k₃; the stiffness stays below what the time step can follow."""
        reach = scales.position
        k = min(4.0 * scales.force / reach, 0.5 * scales.stiffest)
        cubic = 0.5 * k / reach**2
        unit = f"{scales.force_unit}/{scales.unit}"
        low, high = scales.centre - 2.0 * reach, scales.centre + 2.0 * reach
        return (
            EffectParameter("stiffness", unit, 0.0, k, 0.0, 0.05 * k),
            EffectParameter("reference", scales.unit, low, high, scales.centre, scales.centre, scan=4),
            EffectParameter("cubic", f"{unit}³", -cubic, cubic, 0.0, 0.01 * cubic),
        )

    def force(self, values: Values, memory: Memory, moment: Moment) -> tuple[Number, Memory]:
        """Towards q₀."""
        stretch = moment.position - values["reference"]
        stiffness = values["stiffness"] + values["cubic"] * (stretch * stretch)
        return -stretch * jnp.where(values["cubic"] < 0.0, jnp.maximum(stiffness, 0.0), stiffness), memory
