"""A centre of mass that is not where it is believed to be."""

from __future__ import annotations

import mujoco
import numpy as np
from jaxtyping import Array

from bayessim_jax.effects.contract import EffectParameter, ModelEffect, Number, Numbers, Scales, Values
from bayessim_jax.effects.directions import link_axes
from bayessim_jax.effects.places import detail, find_body, movable_bodies

__all__ = ["LinkOffset"]


class LinkOffset(ModelEffect):
    """c ↦ c + x e: the centre of mass shifted by x along the link, or across it in the plane of its motion.

    In m. The inertia about the centre of mass stays.
    """

    name = "link_offset"

    def places(self, model: mujoco.MjModel) -> list[str]:
        """Every body that moves, `body/arm` along the link and `body/arm#across`."""
        return [place + way for place in movable_bodies(model) for way in ("", "#across")]

    def parameters(self, place: str, scales: Scales) -> tuple[EffectParameter, ...]:
        """The offset x."""
        length = scales.length
        return (EffectParameter("offset", "m", -length, length, 0.0, 0.03 * length),)

    def targets(self, model: mujoco.MjModel, place: str) -> tuple[tuple[str, tuple[int, ...]], ...]:
        """The components of the centre of mass that change."""
        return tuple(("body_ipos", (find_body(model, place), int(k))) for k in np.flatnonzero(_axis(model, place)))

    def edit(self, values: Values, numbers: Numbers, model: mujoco.MjModel, place: str) -> tuple[Number | Array, ...]:
        """Shifted."""
        axis = _axis(model, place)
        return tuple(numbers(f, *i) + float(axis[i[1]]) * values["offset"] for f, i in self.targets(model, place))


def _axis(model: mujoco.MjModel, place: str) -> np.ndarray:
    return link_axes(model, find_body(model, place))[2 if detail(place) == "across" else 1]
