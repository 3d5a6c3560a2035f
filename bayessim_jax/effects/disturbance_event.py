"""A push from outside, once."""

from __future__ import annotations

import math
from functools import partial

import jax.numpy as jnp
import mujoco

from bayessim_jax.effects.contract import EffectParameter, ForceEffect, Memory, Moment, Number, Scales, Values
from bayessim_jax.effects.open_form import OpenForm
from bayessim_jax.effects.places import joints

__all__ = ["DisturbanceEvent"]

TAPER = "taper"


class DisturbanceEvent(OpenForm, ForceEffect):
    """τ = (2 P/w) sin²(π (t − t₀)/w) for t₀ < t < t₁, w = t₁ − t₀: a bump that hands over the impulse P.

    The shape of the push is unknown; a bump without corners stands for it. One that is `rounded` is constant but for
    the share c of its time, the taper, in which it rises and falls as a cosine: c = 1 is the bump, c → 0 a rectangle.
    t in s since the beginning of the recording, P in N m s or N s.

    Source: Harris 1978 (the tapered cosine)
    """

    name = "disturbance_event"

    def places(self, model: mujoco.MjModel) -> list[str]:
        """Every hinge and slide."""
        return joints(model)

    def parameters(self, place: str, scales: Scales) -> tuple[EffectParameter, ...]:
        """t₀, t₁ and P; the taper where that is free."""
        moment = partial(EffectParameter, scan=8, moment=True, form=0.08)
        duration, impulse = scales.duration, 12.0 * scales.inertia * scales.speed
        return (
            moment("start", "s", 0.0, duration, 0.45 * duration, 0.45 * duration),
            moment("end", "s", 0.0, duration, 0.55 * duration, 0.55 * duration),
            EffectParameter("impulse", f"{scales.force_unit} s", -impulse, impulse, 0.0, 0.02 * impulse, form=0.01),
            *((EffectParameter(TAPER, "", 0.05, 1.0, 1.0, 0.6, form=0.3),) if self.rounded else ()),
        )

    def force(self, values: Values, memory: Memory, moment: Moment) -> tuple[Number, Memory]:
        """The bump in the middle of the time step."""
        width = jnp.maximum(values["end"] - values["start"], 3.0 * moment.h)
        phase = jnp.clip((moment.time + 0.5 * moment.h - values["start"]) / width, 0.0, 1.0)
        taper = values[TAPER] if self.rounded else 1.0
        rise = jnp.clip(jnp.minimum(phase, 1.0 - phase) / taper, 0.0, 0.5)
        height = values["impulse"] / (width * (1.0 - 0.5 * taper))
        return 0.5 * height * (1.0 - jnp.cos(2.0 * math.pi * rise)), memory
