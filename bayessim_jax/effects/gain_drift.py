"""An actuator that grows stronger or weaker in time, with heat or an empty battery."""

from __future__ import annotations

from typing import Any

from bayessim_jax.effects.contract import ActEffect, EffectParameter, Memory, Moment, Scales, Values

__all__ = ["GainDrift"]


class GainDrift(ActEffect):
    """u ↦ (1 + r t) u, t in s since the beginning of the recording, r in 1/s."""

    name = "gain_drift"

    def parameters(self, place: str, scales: Scales) -> tuple[EffectParameter, ...]:
        """The rate r."""
        rate = 1.0 / scales.duration
        return (EffectParameter("rate", "1/s", -3.0 * rate, 3.0 * rate, 0.0, -0.1 * rate, form=0.05),)

    def command(self, values: Values, memory: Memory, command: Any, moment: Moment) -> tuple[Any, Memory]:
        """The command times the gain of this time."""
        return command * (1.0 + values["rate"] * moment.time), memory
