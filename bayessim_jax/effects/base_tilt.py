"""A base that does not stand level."""

from __future__ import annotations

import mujoco
from jaxtyping import Array

from bayessim_jax.effects.contract import EffectParameter, ModelEffect, Number, Numbers, Scales, Values
from bayessim_jax.effects.directions import tilt_axes, tilt_places, turn_gravity, turned_components
from bayessim_jax.effects.places import detail

__all__ = ["BaseTilt"]

WIDEST = 1.5
"""rad: a base that hangs on a wall is a model of its own."""


class BaseTilt(ModelEffect):
    """g ↦ R g: gravity turned by an angle about the hinge of a plane mechanism, or by two angles across gravity.

    In rad. To turn gravity by α is to tilt the base by −α.
    """

    name = "base_tilt"

    def places(self, model: mujoco.MjModel) -> list[str]:
        """The world; `world#joint/…` for a mechanism that moves in a plane."""
        return tilt_places(model)

    def parameters(self, place: str, scales: Scales) -> tuple[EffectParameter, ...]:
        """One angle, or two."""
        names = ("angle",) if detail(place) else ("angle", "second_angle")
        return tuple(EffectParameter(name, "rad", -WIDEST, WIDEST, 0.0, 0.02) for name in names)

    def targets(self, model: mujoco.MjModel, place: str) -> tuple[tuple[str, tuple[int, ...]], ...]:
        """The components of gravity that change."""
        return tuple(("gravity", (k,)) for k in turned_components(model, place))

    def edit(self, values: Values, numbers: Numbers, model: mujoco.MjModel, place: str) -> tuple[Number | Array, ...]:
        """Gravity, turned."""
        gravity = turn_gravity(numbers, tilt_axes(model, place), list(values.values()))
        return tuple(gravity[k] for k in turned_components(model, place))
