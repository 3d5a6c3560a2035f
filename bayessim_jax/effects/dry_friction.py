"""What laws of dry friction share: they hold at rest, and their sign may be rounded."""

from __future__ import annotations

from abc import abstractmethod

import jax.numpy as jnp
import mujoco

from bayessim_jax.effects.contract import EffectParameter, ForceEffect, Moment, Number, Scales, Values
from bayessim_jax.effects.open_form import OpenForm
from bayessim_jax.effects.places import joints

__all__ = ["DryFriction"]

ONSET, HOLD = "onset", "hold"


class DryFriction(OpenForm, ForceEffect):
    """τ = −F s(v/v₀), s the sign, of a law that is `rounded` a straight line below its onset v₀, in rad/s or m/s.

    Machines are not as sharp as a sign: lubricants, bearings in series and the models of others let friction rise over
    a range of speeds, in which a joint creeps, or comes to rest in a while and is held there. Recordings tell that
    range from a law that falls or bends, such as Stribeck's, only where it may be one. A share α, `hold`, of what moves
    the joint is withstood at any speed below the onset, about: m is underestimated. With v' the velocity at the end of
    the time step, m (v' − v)/h = m a − clip(α m a + F v'/v₀, −F, F) has the solution

        τ = −clip(ρ m (v/h + a) + (1 − ρ) α m a, −F, F),    ρ = F/(F + m v₀/h),

    which stops the joint and holds it for v₀ → 0.
    """

    holds = True

    def places(self, model: mujoco.MjModel) -> list[str]:
        """Every hinge and slide."""
        return joints(model)

    @abstractmethod
    def levels(self, place: str, scales: Scales) -> tuple[EffectParameter, ...]:
        """The parameters of F."""

    def parameters(self, place: str, scales: Scales) -> tuple[EffectParameter, ...]:
        """Those of F, and the onset v₀ and what is held below it where these are free."""
        return (*self.levels(place, scales), *(_form(scales) if self.rounded else ()))

    def resist(self, values: Values, moment: Moment, positive: Number, negative: Number) -> Number:
        """The force of the levels against motion in the positive and in the negative direction."""
        stop = moment.stop
        if self.rounded:
            level = jnp.where(jnp.asarray(stop) > 0.0, positive, negative)
            sharp = level / (level + moment.inertia * values[ONSET] / moment.h)
            stop = sharp * stop + (1.0 - sharp) * values[HOLD] * moment.inertia * moment.acceleration
        return -jnp.clip(stop, -negative, positive)


def _form(scales: Scales) -> tuple[EffectParameter, EffectParameter]:
    """The onset is some hundredths of the joint's speed at most: beyond that friction is viscous, not dry."""
    speed = scales.speed
    return (
        EffectParameter(ONSET, f"{scales.unit}/s", 1e-4 * speed, 0.1 * speed, 0.0, 0.01 * speed, log=True, form=0.5),
        EffectParameter(HOLD, "", 0.0, 1.0, 0.0, 0.5, form=0.5),
    )
