"""Dry friction of one level for each direction."""

from __future__ import annotations

import jax.numpy as jnp
import mujoco

from bayessim_jax.effects.contract import EffectParameter, ForceEffect, Memory, Moment, Number, Scales, Values
from bayessim_jax.effects.places import joints

__all__ = ["AsymmetricFriction"]


class AsymmetricFriction(ForceEffect):
    """τ = −F₊ for v > 0 and F₋ for v < 0; at rest whatever holds the joint between the two.

    τ = −clip(m (v/h + a), −F₋, F₊), in N m or N. It is Coulomb friction (F₊ + F₋)/2 with a constant force (F₋ − F₊)/2.
    """

    name = "asymmetric_friction"
    holds = True

    def places(self, model: mujoco.MjModel) -> list[str]:
        """Every hinge and slide."""
        return joints(model)

    def parameters(self, place: str, scales: Scales) -> tuple[EffectParameter, ...]:
        """F₊ and F₋, the levels against motion in the positive and in the negative direction."""
        force = scales.force
        return (
            EffectParameter("positive", scales.force_unit, 0.0, force, 0.0, 0.12 * force, form=0.01),
            EffectParameter("negative", scales.force_unit, 0.0, force, 0.0, 0.08 * force, form=0.01),
        )

    def force(self, values: Values, memory: Memory, moment: Moment) -> tuple[Number, Memory]:
        """Opposes motion, or holds."""
        return -jnp.clip(moment.stop, -values["negative"], values["positive"]), memory
