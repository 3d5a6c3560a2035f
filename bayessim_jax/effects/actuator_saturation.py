"""An actuator that reaches its limit before it should."""

from __future__ import annotations

import math
from typing import Any

import jax.numpy as jnp

from bayessim_jax.effects.contract import ActEffect, EffectParameter, Memory, Moment, Scales, Values

__all__ = ["ActuatorSaturation"]


class ActuatorSaturation(ActEffect):
    """u ↦ clip(u, ±u_max), in the unit of the command."""

    name = "actuator_saturation"

    def parameters(self, place: str, scales: Scales) -> tuple[EffectParameter, ...]:
        """The limit u_max; a fit begins where some commands are above it."""
        u = scales.command
        return (EffectParameter("limit", "", 0.01 * u, 2.5 * u, math.inf, 0.7 * u, form=0.01),)

    def command(self, values: Values, memory: Memory, command: Any, moment: Moment) -> tuple[Any, Memory]:
        """The command within its limits."""
        return jnp.clip(command, -values["limit"], values["limit"]), memory
