"""A spring that gives back less than it took."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import mujoco
from jaxtyping import Array

from bayessim_jax.effects.bending import bent_before
from bayessim_jax.effects.contract import EffectParameter, ForceEffect, Memory, Moment, Number, Past, Scales, Values
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
    settles = False

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
        most = _most(values)
        return jnp.clip(moment.stop / (values["stiffness"] + TINY), -most, most)

    def recall(self, values: Values, memory: Memory, past: Past, move: Number = 0.0) -> Memory:
        """As far as a path that was recorded bends it, ∂z/∂q = A − (β sign(ż) sign(z) + γ) |z|ⁿ, by the midpoint rule.

        What it was bent before is a guess: as much as now if nothing has moved since, and less the longer the path is.
        A machine may be let go in any state, and a spring be bent since long before.
        """
        mean = 0.5 * (past.velocities[1:] + past.velocities[:-1])
        moved = jnp.where(past.recorded, past.period * mean, 0.0).at[-1:].multiply(1.0 - past.h / past.period)
        most = _most(values)
        before = bent_before(memory, most, values["A"] * jnp.abs(moved).sum() / most, move)

        def bend(z: Array, dq: Array) -> Array:
            size = jnp.abs(z) + TINY
            return dq * (values["A"] - (values["beta"] * jnp.sign(dq * z) + values["gamma"]) * size ** values["n"])

        def once(z: Array, dq: Array) -> tuple[Array, None]:
            middle = jnp.clip(z + 0.5 * bend(z, dq), -most, most)
            return jnp.clip(z + bend(middle, dq), -most, most), None

        return jax.lax.scan(once, before, moved)[0]

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


def _most(values: Values) -> Number:
    return (values["A"] / jnp.maximum(values["beta"] + values["gamma"], 1e-3 * values["beta"])) ** (1.0 / values["n"])
