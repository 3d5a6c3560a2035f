"""Friction of bristles that bend before they slip."""

from __future__ import annotations

import jax.numpy as jnp
import mujoco

from bayessim_jax.effects.bending import bent_before
from bayessim_jax.effects.contract import EffectParameter, ForceEffect, Memory, Moment, Number, Past, Scales, Values
from bayessim_jax.effects.places import joints

__all__ = ["LuGreFriction"]

TINY = 1e-12


class LuGreFriction(ForceEffect):
    """τ = −(σ₀ z + σ₁ ż) with the bristles' deflection ż = v − σ₀ |v| z/g(v).

        g(v) = F_c + (F_s − F_c) exp(−(v/v_s)²)

    What is remembered is s = σ₀ z, and both s and the velocity at the end of the time step, v' = v + h (a + τ/m), are
    taken as unknown, so that it is stable for every σ₀. σ₀ in N m/rad or N/m, σ₁ in N m s/rad or N s/m.

    Source: Canudas de Wit, Olsson, Åström and Lischinsky 1995
    """

    name = "lugre_friction"
    holds = True
    recalls = True
    settles = False

    def places(self, model: mujoco.MjModel) -> list[str]:
        """Every hinge and slide."""
        return joints(model)

    def parameters(self, place: str, scales: Scales) -> tuple[EffectParameter, ...]:
        """σ₀, σ₁, F_c, F_s and v_s."""
        force, speed = scales.force, scales.speed
        k = force / scales.position
        damping = 2.0 * (k * scales.inertia) ** 0.5
        unit = f"{scales.force_unit}/{scales.unit}"
        return (
            EffectParameter("stiffness", unit, k, 1e5 * k, 100.0 * k, 100.0 * k, log=True, scan=4, form=0.05),
            EffectParameter(
                "damping", f"{scales.force_unit} s/{scales.unit}", 0.0, 10.0 * damping, 0.0, damping, form=0.05
            ),
            EffectParameter("coulomb", scales.force_unit, 0.0, force, 0.0, 0.1 * force, form=0.05),
            EffectParameter("static", scales.force_unit, 0.0, 1.5 * force, 0.0, 0.2 * force, form=0.1),
            EffectParameter(
                "velocity", f"{scales.unit}/s", 1e-3 * speed, speed, 0.1 * speed, 0.1 * speed, log=True, form=0.3
            ),
        )

    def begin(self, values: Values, moment: Moment) -> Memory:
        """Slipping with the motion, or bent by what the bristles hold."""
        level = _level(values, moment.velocity)
        return jnp.clip(moment.stop, -level, level)

    def recall(self, values: Values, memory: Memory, past: Past, move: Number = 0.0) -> Memory:
        """As far as a path that was recorded bends them.

        What they were bent before is a guess: as much as now if nothing has moved since, less the longer the path is.
        """
        moved = jnp.where(past.recorded, past.period * jnp.abs(past.velocities[:-1]), 0.0).sum()
        level = _level(values, past.velocities[0]) + TINY
        return super().recall(values, bent_before(memory, level, values["stiffness"] * moved / level, move), past)

    def force(self, values: Values, memory: Memory, moment: Moment) -> tuple[Number, Memory]:
        """What the bristles exert at the end of the time step."""
        level, h, m = _level(values, moment.velocity), moment.h, moment.inertia
        rise = values["stiffness"] * h
        share = level / (level + rise * jnp.abs(moment.velocity) + TINY)
        bent = share * (memory + rise * moment.velocity)
        rate = values["damping"] / rise
        coasting = moment.velocity + h * moment.acceleration
        pull = (1.0 + rate) * share * (bent + rise * coasting) - rate * bent
        return -pull / (1.0 + (1.0 + rate) * share * rise * h / m), bent


def _level(values: Values, velocity: Number) -> Number:
    ratio = velocity / values["velocity"]
    return values["coulomb"] + jnp.maximum(values["static"] - values["coulomb"], 0.0) * jnp.exp(-ratio * ratio)
