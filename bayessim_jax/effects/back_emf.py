"""A motor that generates against its own motion."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp

from bayessim_jax.effects.contract import ActEffect, EffectParameter, Memory, Moment, Scales, Values

__all__ = ["BackEmf"]


class BackEmf(ActEffect):
    """V ↦ (V − k_e v)/ρ: the torque k_t (V − k_e v)/R of a motor that the model takes as k_t V/R₀, ρ = R/R₀.

    v is the velocity of the joint, k_e in units of the command per rad/s or m/s, `resistance` is ρ. The voltage against
    takes at most as much as stops the joint within the time step.
    """

    name = "back_emf"
    looks = True

    def parameters(self, place: str, scales: Scales) -> tuple[EffectParameter, ...]:
        """k_e and ρ."""
        high = 2.0 * scales.command / scales.speed
        return (
            EffectParameter("constant", f"s/{scales.unit}", 0.0, high, 0.0, 0.1 * high),
            EffectParameter("resistance", "", 0.2, 5.0, 1.0, 1.05, log=True),
        )

    def command(self, values: Values, memory: Memory, command: Any, moment: Moment) -> tuple[Any, Memory]:
        """What is left of the voltage."""
        constant, resistance = values["constant"], values["resistance"]
        most = resistance * moment.inertia / (moment.h * jnp.maximum(jnp.abs(moment.gain), 1e-12))
        return (command - jnp.minimum(constant, most) * moment.velocity) / resistance, memory
