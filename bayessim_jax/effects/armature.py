"""Inertia of a rotor, seen through the gearbox."""

from __future__ import annotations

import mujoco
from jaxtyping import Array

from bayessim_jax.effects.contract import EffectParameter, ModelEffect, Number, Numbers, Scales, Values
from bayessim_jax.effects.places import find_site, joints

__all__ = ["Armature"]


class Armature(ModelEffect):
    """(M + J) q̈ = …: an inertia that moves with the joint and with nothing else.

    J in kg m² or kg, added to the model's own armature.
    """

    name = "armature"

    def places(self, model: mujoco.MjModel) -> list[str]:
        """Every hinge and slide."""
        return joints(model)

    def parameters(self, place: str, scales: Scales) -> tuple[EffectParameter, ...]:
        """The inertia J."""
        inertia = scales.inertia
        return (EffectParameter("inertia", scales.inertia_unit, 0.0, 3.0 * inertia, 0.0, 0.1 * inertia),)

    def targets(self, model: mujoco.MjModel, place: str) -> tuple[tuple[str, tuple[int, ...]], ...]:
        """The armature of the joint."""
        return (("dof_armature", (int(model.jnt_dofadr[find_site(model, place).joint]),)),)

    def edit(self, values: Values, numbers: Numbers, model: mujoco.MjModel, place: str) -> tuple[Number | Array, ...]:
        """The model's armature and J."""
        ((field, index),) = self.targets(model, place)
        return (numbers(field, *index) + values["inertia"],)
