"""An actuator whose output can only change so fast."""

from __future__ import annotations

import math
from typing import Any

import jax.numpy as jnp

from bayessim_jax.effects.contract import ActEffect, EffectParameter, Memory, Moment, Scales, Values

__all__ = ["ActuatorRateLimit"]


class ActuatorRateLimit(ActEffect):
    """|u̇| ≤ r: u[n] ↦ clip(u[n], a[n−1] ± r h), in the unit of the command per s."""

    name = "actuator_rate_limit"

    def parameters(self, place: str, scales: Scales) -> tuple[EffectParameter, ...]:
        """The rate r; a fit begins at half of what commands as fast as the motion need."""
        rate = scales.command * scales.speed / scales.position
        return (
            EffectParameter(
                "rate", "1/s", 0.02 * rate, 50.0 * rate, math.inf, 0.5 * rate, log=True, scan=10, form=0.01
            ),
        )

    def begin(self, values: Values, command: Any, moment: Moment) -> Memory:
        """Arrived."""
        return command

    def command(self, values: Values, memory: Memory, command: Any, moment: Moment) -> tuple[Any, Memory]:
        """Towards the command, as fast as it can."""
        reach = values["rate"] * moment.h
        new = jnp.clip(command, memory - reach, memory + reach)
        return new, new
