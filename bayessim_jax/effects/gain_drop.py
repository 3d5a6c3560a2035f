"""An actuator that loses strength all at once."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp

from bayessim_jax.effects.contract import ActEffect, EffectParameter, Memory, Moment, Scales, Values

__all__ = ["GainDrop"]


class GainDrop(ActEffect):
    """u ↦ u for t < t* and k u from t* on.

    In the time step of t* each counts for its share, so that the motion has a derivative with respect to t*. t* in s
    since the beginning of the recording.
    """

    name = "gain_drop"

    def parameters(self, place: str, scales: Scales) -> tuple[EffectParameter, ...]:
        """t* and k."""
        duration = scales.duration
        return (
            EffectParameter("time", "s", 0.0, duration, 0.5 * duration, 0.5 * duration, scan=8, moment=True),
            EffectParameter("gain", "", 0.0, 2.0, 1.0, 0.8),
        )

    def command(self, values: Values, memory: Memory, command: Any, moment: Moment) -> tuple[Any, Memory]:
        """The command times the mean gain over the time step."""
        after = jnp.clip((moment.time - values["time"]) / moment.h + 1.0, 0.0, 1.0)
        return command * (1.0 + (values["gain"] - 1.0) * after), memory
