"""Dry friction of a gearbox, which grows with what it transmits."""

from __future__ import annotations

import jax.numpy as jnp
import mujoco

from bayessim_jax.effects.contract import EffectParameter, Memory, Moment, Number, Scales, Values
from bayessim_jax.effects.dry_friction import DryFriction
from bayessim_jax.effects.places import driven_joints

__all__ = ["LoadDependentFriction"]


class LoadDependentFriction(DryFriction):
    """τ = −(F_c + K |τ_load|) sign(v) in motion, at rest whatever holds the joint up to that.

    τ_load is what the actuators exert on the joint through its transmission: gear · clip(gain u + bias). F_c in N m or
    N, K without a unit.

    Source: Duclusaud, Passault, Padois and Ly 2024
    """

    name = "load_dependent_friction"

    def places(self, model: mujoco.MjModel) -> list[str]:
        """Every hinge and slide that an actuator drives."""
        return driven_joints(model)

    def levels(self, place: str, scales: Scales) -> tuple[EffectParameter, ...]:
        """F_c and K."""
        force = scales.force
        return (
            EffectParameter("coulomb", scales.force_unit, 0.0, force, 0.0, 0.05 * force, form=0.01),
            EffectParameter("gain", "", 0.0, 1.0, 0.0, 0.1, form=0.01),
        )

    def force(self, values: Values, memory: Memory, moment: Moment) -> tuple[Number, Memory]:
        """Opposes motion, or holds."""
        level = values["coulomb"] + values["gain"] * jnp.abs(moment.drive)
        return self.resist(values, moment, level, level), memory
