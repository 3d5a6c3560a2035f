"""An actuator that does not answer to small commands."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp

from bayessim_jax.effects.contract import ActEffect, EffectParameter, Memory, Moment, Scales, Values

__all__ = ["ActuatorDeadband"]


class ActuatorDeadband(ActEffect):
    """u ↦ sign(u) max(|u| − w, 0) = u − clip(u, ±w), in the unit of the command."""

    name = "actuator_deadband"

    def parameters(self, place: str, scales: Scales) -> tuple[EffectParameter, ...]:
        """The width w."""
        return (EffectParameter("width", "", 0.0, scales.command, 0.0, 0.1 * scales.command, form=0.01),)

    def command(self, values: Values, memory: Memory, command: Any, moment: Moment) -> tuple[Any, Memory]:
        """What of the command is beyond w."""
        return command - jnp.clip(command, -values["width"], values["width"]), memory
