"""A spring that gives back less than it took."""

from __future__ import annotations

import jax.numpy as jnp
import mujoco

from bayessim_jax.effects.contract import EffectParameter, ForceEffect, Memory, Moment, Number, Scales, Values
from bayessim_jax.effects.places import joints

__all__ = ["Hysteresis"]

TINY = 1e-12


class Hysteresis(ForceEffect):
    """τ = −κ z with the hysteretic deflection ż = A v − β |v| |z|ⁿ⁻¹ z − γ v |z|ⁿ (Bouc-Wen).

    z ends at (A/(β + γ))^{1/n} in lasting motion. Its decay and the velocity at the end of the time step,
    v' = v + h (a + τ/m), are taken as unknown, so that it is stable for every κ. z in rad or m, κ in N m/rad or N/m,
    β and γ in rad⁻ⁿ or m⁻ⁿ.

    Source: Wen 1976
    """

    name = "hysteresis"
    holds = True
    recalls = True

    def places(self, model: mujoco.MjModel) -> list[str]:
        """Every hinge and slide."""
        return joints(model)

    def parameters(self, place: str, scales: Scales) -> tuple[EffectParameter, ...]:
        """κ, A, β, γ and n; with the first values z ends at a twentieth of the joint's travel."""
        bend = 20.0 / scales.position
        k = scales.force * bend
        return (
            EffectParameter("stiffness", f"{scales.force_unit}/{scales.unit}", 0.0, 5.0 * k, 0.0, 0.1 * k),
            EffectParameter("A", "", 0.2, 5.0, 1.0, 1.0, log=True),
            EffectParameter("beta", f"{scales.unit}⁻ⁿ", 0.01 * bend, 100.0 * bend, bend, bend, log=True, scan=4),
            EffectParameter("gamma", f"{scales.unit}⁻ⁿ", -0.9 * bend, 10.0 * bend, 0.0, 0.1 * bend),
            EffectParameter("n", "", 1.0, 3.0, 1.0, 1.1),
        )

    def begin(self, values: Values, moment: Moment) -> Memory:
        """As far as lasting motion takes it, or as what it holds."""
        most = (values["A"] / jnp.maximum(values["beta"] + values["gamma"], 1e-3 * values["beta"])) ** (
            1.0 / values["n"]
        )
        return jnp.clip(moment.stop / (values["stiffness"] + TINY), -most, most)

    def force(self, values: Values, memory: Memory, moment: Moment) -> tuple[Number, Memory]:
        """What it exerts at the end of the time step."""
        h, m, v = moment.h, moment.inertia, moment.velocity
        rise = values["A"] * h
        size = jnp.abs(memory) + TINY
        decay = values["beta"] * jnp.abs(v) + values["gamma"] * v * jnp.sign(memory)
        share = 1.0 / (1.0 + h * jnp.maximum(size ** (values["n"] - 1.0) * decay, 0.0))
        bent = share * (memory + rise * v)
        coasting = v + h * moment.acceleration
        k = values["stiffness"] * share
        return -k * (bent + rise * coasting) / (1.0 + k * rise * h / m), bent
