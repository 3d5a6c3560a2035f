"""Dry friction of one level for each direction."""

from __future__ import annotations

from bayessim_jax.effects.contract import EffectParameter, Memory, Moment, Number, Scales, Values
from bayessim_jax.effects.dry_friction import DryFriction

__all__ = ["AsymmetricFriction"]


class AsymmetricFriction(DryFriction):
    """τ = −F₊ for v > 0 and F₋ for v < 0; at rest whatever holds the joint between the two.

    τ = −clip(m (v/h + a), −F₋, F₊), in N m or N. It is Coulomb friction (F₊ + F₋)/2 with a constant force (F₋ − F₊)/2.
    """

    name = "asymmetric_friction"

    def levels(self, place: str, scales: Scales) -> tuple[EffectParameter, ...]:
        """F₊ and F₋, the levels against motion in the positive and in the negative direction."""
        force = scales.force
        return (
            EffectParameter("positive", scales.force_unit, 0.0, force, 0.0, 0.12 * force, form=0.01),
            EffectParameter("negative", scales.force_unit, 0.0, force, 0.0, 0.08 * force, form=0.01),
        )

    def force(self, values: Values, memory: Memory, moment: Moment) -> tuple[Number, Memory]:
        """Opposes motion, or holds."""
        return self.resist(values, moment, values["positive"], values["negative"]), memory
