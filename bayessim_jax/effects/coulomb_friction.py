"""Dry friction of one level."""

from __future__ import annotations

from bayessim_jax.effects.contract import EffectParameter, Memory, Moment, Number, Scales, Values
from bayessim_jax.effects.dry_friction import DryFriction

__all__ = ["CoulombFriction"]


class CoulombFriction(DryFriction):
    """τ = −F_c sign(v) in motion; at rest whatever holds the joint, up to F_c.

    τ = −clip(m (v/h + a), ±F_c): what would stop the joint within the time step, and no more than the friction has.
    F_c in N m or N.
    """

    name = "coulomb_friction"

    def levels(self, place: str, scales: Scales) -> tuple[EffectParameter, ...]:
        """The level F_c."""
        return (EffectParameter("coulomb", scales.force_unit, 0.0, scales.force, 0.0, 0.1 * scales.force, form=0.01),)

    def force(self, values: Values, memory: Memory, moment: Moment) -> tuple[Number, Memory]:
        """Opposes motion, or holds."""
        level = values["coulomb"]
        return self.resist(values, moment, level, level), memory
