"""An actuator that follows its command with a first-order lag."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp

from bayessim_jax.effects.contract import ActEffect, EffectParameter, Memory, Moment, Scales, Values

__all__ = ["ActuatorLag"]


class ActuatorLag(ActEffect):
    """ȧ = (u − a)/T, and a arrives in place of u.

    Solved exactly for a command that is held: a(t + h) = u + (a − u) e^{−h/T}, and what arrives is the mean of a over
    the time step, u + (a − u) (1 − e^{−h/T}) T/h. T in s.
    """

    name = "actuator_lag"

    def parameters(self, place: str, scales: Scales) -> tuple[EffectParameter, ...]:
        """The time constant T."""
        high = max(0.5, 20.0 * scales.period)
        start = max(0.02, scales.timestep)
        return (EffectParameter("time_constant", "s", 0.0, high, 0.0, start, form=0.01, least=scales.shift),)

    def begin(self, values: Values, command: Any, moment: Moment) -> Memory:
        """Settled."""
        return command

    def command(self, values: Values, memory: Memory, command: Any, moment: Moment) -> tuple[Any, Memory]:
        """The mean of a over the time step."""
        time = values["time_constant"]
        decay = jnp.exp(-moment.h / jnp.maximum(time, 1e-3 * moment.h))
        lack = memory - command
        return command + lack * ((1.0 - decay) * time / moment.h), command + lack * decay
