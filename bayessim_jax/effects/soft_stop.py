"""A stop that gives."""

from __future__ import annotations

import jax.numpy as jnp
import mujoco

from bayessim_jax.effects.contract import EffectParameter, ForceEffect, Memory, Moment, Number, Scales, Values
from bayessim_jax.effects.places import detail, joints

__all__ = ["SoftStop"]


class SoftStop(ForceEffect):
    """τ = −s max(0, k p + d ṗ) where p = s (q − q₁) > 0: a spring and a damper beyond an angle.

    The side s has no derivative and is part of the place: `#upper` (+1) stops motion to larger q, `#lower` (−1) to
    smaller. Depth and speed are those at the end of the time step, with v' = v + h (a + τ/m), so that it is stable for
    every k and d. q₁ in rad or m, k in N m/rad or N/m, d in N m s/rad or N s/m.
    """

    name = "soft_stop"
    holds = True

    def places(self, model: mujoco.MjModel) -> list[str]:
        """Every hinge and slide, `#upper` and `#lower`."""
        return [f"{joint}#{side}" for joint in joints(model) for side in ("upper", "lower")]

    def parameters(self, place: str, scales: Scales) -> tuple[EffectParameter, ...]:
        """The angle q₁, k and d."""
        side = _side(detail(place))
        reach, k = scales.position, 20.0 * scales.force / scales.position
        low, high = sorted((scales.centre, scales.centre + 1.2 * side * reach))
        damping = 2.0 * (k * scales.inertia) ** 0.5
        unit = f"{scales.force_unit}/{scales.unit}"
        return (
            EffectParameter(
                "angle",
                scales.unit,
                low,
                high,
                side * reach + scales.centre,
                scales.centre + 0.7 * side * reach,
                form=0.01,
            ),
            EffectParameter("stiffness", unit, 0.0, 5.0 * k, 0.0, 0.2 * k, form=0.03),
            EffectParameter(
                "damping", f"{scales.force_unit} s/{scales.unit}", 0.0, 5.0 * damping, 0.0, 0.05 * damping, form=0.5
            ),
        )

    def force(self, values: Values, memory: Memory, moment: Moment) -> tuple[Number, Memory]:
        """Away from the stop."""
        side, h = _side(moment.detail), moment.h
        speed = side * (moment.velocity + h * moment.acceleration)
        depth = side * (moment.position - values["angle"]) + h * speed
        k, d = values["stiffness"], values["damping"]
        push = jnp.maximum(k * depth + d * speed, 0.0) / (1.0 + h * (k * h + d) / moment.inertia)
        return -side * jnp.where(depth > 0.0, push, 0.0), memory


def _side(detail: str) -> float:
    return -1.0 if detail == "lower" else 1.0
