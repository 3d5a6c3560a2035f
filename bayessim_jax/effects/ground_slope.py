"""Ground that is not level."""

from __future__ import annotations

import mujoco
from jaxtyping import Array

from bayessim_jax.effects.contract import EffectParameter, ModelEffect, Number, Numbers, Scales, Values
from bayessim_jax.effects.directions import tilt_axes, tilt_places, turn_gravity, turned_components

__all__ = ["GroundSlope"]


class GroundSlope(ModelEffect):
    """g ↦ R g: seen from a slope, gravity is turned, and the ground is where it was.

    The angle, in rad, turns gravity about the hinge of a plane mechanism, else about the first axis across gravity (y,
    where gravity is along z). What else is fixed to the world is taken to be fixed to the ground.
    """

    name = "ground_slope"

    def places(self, model: mujoco.MjModel) -> list[str]:
        """The world, where it has a ground: a plane or a height field."""
        grounds = (mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_HFIELD)
        there = any(
            model.geom_type[g] in grounds and model.body_weldid[model.geom_bodyid[g]] == 0 for g in range(model.ngeom)
        )
        return tilt_places(model) if there else []

    def parameters(self, place: str, scales: Scales) -> tuple[EffectParameter, ...]:
        """The angle."""
        return (EffectParameter("angle", "rad", -0.5, 0.5, 0.0, 0.02),)

    def targets(self, model: mujoco.MjModel, place: str) -> tuple[tuple[str, tuple[int, ...]], ...]:
        """The components of gravity that change."""
        return tuple(("gravity", (k,)) for k in turned_components(model, place))

    def edit(self, values: Values, numbers: Numbers, model: mujoco.MjModel, place: str) -> tuple[Number | Array, ...]:
        """Gravity, turned."""
        gravity = turn_gravity(numbers, tilt_axes(model, place)[:1], [values["angle"]])
        return tuple(gravity[k] for k in turned_components(model, place))
