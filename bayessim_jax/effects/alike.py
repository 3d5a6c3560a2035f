"""An effect on all actuators of a system at once: they are of one make, or hang on one supply."""

from __future__ import annotations

from typing import Any

from bayessim_jax.effects.contract import ActEffect, EffectParameter, Memory, Moment, Scales, Values

__all__ = ["Alike"]


class Alike(ActEffect):
    """The effect of one actuator on several, with the same numbers and a memory for each."""

    def __init__(self, effect: ActEffect) -> None:
        self.effect, self.name = effect, effect.name

    def parameters(self, place: str, scales: Scales) -> tuple[EffectParameter, ...]:
        """Those of one."""
        return self.effect.parameters(place, scales)

    def begin(self, values: Values, command: Any, moment: Moment) -> Memory:
        """What each remembers."""
        return tuple(self.effect.begin(values, one, moment) for one in command)

    def command(self, values: Values, memory: Memory, command: Any, moment: Moment) -> tuple[Any, Memory]:
        """What arrives at each."""
        each = (self.effect.command(values, *one, moment) for one in zip(memory, command, strict=True))
        arrived, memory = zip(*each, strict=True)
        return arrived, memory
