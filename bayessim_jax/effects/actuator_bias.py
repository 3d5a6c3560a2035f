"""A command that is always off by the same."""

from __future__ import annotations

from typing import Any

from bayessim_jax.effects.contract import ActEffect, EffectParameter, Memory, Moment, Scales, Values

__all__ = ["ActuatorBias"]


class ActuatorBias(ActEffect):
    """u ↦ u + τ₀, in the unit of the command."""

    name = "actuator_bias"

    def parameters(self, place: str, scales: Scales) -> tuple[EffectParameter, ...]:
        """The bias τ₀."""
        return (EffectParameter("torque", "", -scales.command, scales.command, 0.0, 0.05 * scales.command),)

    def command(self, values: Values, memory: Memory, command: Any, moment: Moment) -> tuple[Any, Memory]:
        """The sum u + τ₀."""
        return command + values["torque"], memory
