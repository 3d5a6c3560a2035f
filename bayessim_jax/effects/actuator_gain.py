"""An actuator that is stronger or weaker than believed."""

from __future__ import annotations

from typing import Any

from bayessim_jax.effects.contract import ActEffect, EffectParameter, Memory, Moment, Scales, Values

__all__ = ["ActuatorGain"]


class ActuatorGain(ActEffect):
    """u ↦ k u."""

    name = "actuator_gain"

    def parameters(self, place: str, scales: Scales) -> tuple[EffectParameter, ...]:
        """The gain k."""
        return (EffectParameter("gain", "", 0.0, 3.0, 1.0, 0.9),)

    def command(self, values: Values, memory: Memory, command: Any, moment: Moment) -> tuple[Any, Memory]:
        """The product k u."""
        return values["gain"] * command, memory
