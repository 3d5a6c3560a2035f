"""Dry friction that is largest at rest."""

from __future__ import annotations

import jax.numpy as jnp

from bayessim_jax.effects.contract import EffectParameter, Memory, Moment, Number, Scales, Values
from bayessim_jax.effects.dry_friction import ONSET, DryFriction

__all__ = ["StribeckFriction"]

SHARP = 0.5
"""Share of v_s up to which the sign may be rounded: what falls off within that is how friction begins."""


class StribeckFriction(DryFriction):
    """τ = −F(v) sign(v) in motion, at rest whatever holds the joint up to F_s.

        F(v) = F_c + max(F_s − F_c, 0) exp(−(v/v_s)²)

    τ = −clip(m (v/h + a), ±F(v)). F_c and F_s in N m or N, v_s in rad/s or m/s. The onset of a sign that is `rounded`
    counts up to v_s/2: a fall within it would be another form of plain dry friction's sign.

    Source: Armstrong-Hélouvry, Dupont and Canudas de Wit 1994
    """

    name = "stribeck_friction"

    def levels(self, place: str, scales: Scales) -> tuple[EffectParameter, ...]:
        """F_c, F_s and v_s."""
        force, speed = scales.force, scales.speed
        return (
            EffectParameter("coulomb", scales.force_unit, 0.0, force, 0.0, 0.1 * force, form=0.03),
            EffectParameter("static", scales.force_unit, 0.0, 1.5 * force, 0.0, 0.2 * force, form=0.03),
            EffectParameter(
                "velocity",
                f"{scales.unit}/s",
                1e-3 * speed,
                speed,
                0.1 * speed,
                0.1 * speed,
                log=True,
                scan=3,
                form=0.3,
            ),
        )

    def force(self, values: Values, memory: Memory, moment: Moment) -> tuple[Number, Memory]:
        """Opposes motion, or holds."""
        ratio = moment.velocity / values["velocity"]
        coulomb = values["coulomb"]
        level = coulomb + jnp.maximum(values["static"] - coulomb, 0.0) * jnp.exp(-ratio * ratio)
        if self.rounded:
            values = {**values, ONSET: jnp.minimum(values[ONSET], SHARP * values["velocity"])}
        return self.resist(values, moment, level, level), memory
