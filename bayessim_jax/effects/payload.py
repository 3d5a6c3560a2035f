"""A mass on a body that the model does not know of."""

from __future__ import annotations

import mujoco
import numpy as np
from jaxtyping import Array

from bayessim_jax.effects.contract import EffectParameter, ModelEffect, Number, Numbers, Scales, Values
from bayessim_jax.effects.directions import link_axes
from bayessim_jax.effects.places import find_body, movable_bodies

__all__ = ["Payload"]


class Payload(ModelEffect):
    """A point mass m on the line from the joint through the centre of mass, at a distance x from the joint.

    With the body's mass M and the distance d of the point from its centre of mass c, along e:

        M ↦ M + m,   c ↦ c + d e m/(M + m),   I ↦ I + d² (1 − e eᵀ) M m/(M + m)

    Of I the diagonal in the body's principal axes is kept: exact about an axis of rotation that is a principal axis.
    m in kg, x in m.
    """

    name = "payload"

    def places(self, model: mujoco.MjModel) -> list[str]:
        """Every body that moves."""
        return movable_bodies(model)

    def parameters(self, place: str, scales: Scales) -> tuple[EffectParameter, ...]:
        """M and x."""
        mass, length = scales.mass, scales.length
        return (
            EffectParameter("mass", "kg", 0.001 * mass, 20.0 * mass, 0.0, 0.05 * mass, log=True),
            EffectParameter("position", "m", 0.0, 2.0 * length, length, length),
        )

    def targets(self, model: mujoco.MjModel, place: str) -> tuple[tuple[str, tuple[int, ...]], ...]:
        """Mass, and what of the centre of mass and of the inertia changes."""
        body = find_body(model, place)
        along, principal = _axes(model, body)
        centre = [("body_ipos", (body, int(k))) for k in np.flatnonzero(along)]
        inertia = [("body_inertia", (body, k)) for k in range(3) if 1.0 - principal[k] ** 2 > 1e-12]
        return (("body_mass", (body,)), *centre, *inertia)

    def edit(self, values: Values, numbers: Numbers, model: mujoco.MjModel, place: str) -> tuple[Number | Array, ...]:
        """With the point mass."""
        body, added = find_body(model, place), values["mass"]
        anchor = link_axes(model, body)[0]
        along, principal = _axes(model, body)
        mass = numbers("body_mass", body)
        reach = sum(float(along[k]) * (numbers("body_ipos", body, k) - float(anchor[k])) for k in range(3) if along[k])
        distance, share = values["position"] - reach, added / (mass + added)
        new = []
        for field, index in self.targets(model, place):
            old = numbers(field, *index)
            if field == "body_mass":
                new.append(old + added)
            elif field == "body_ipos":
                new.append(old + float(along[index[1]]) * (share * distance))
            else:
                new.append(old + float(1.0 - principal[index[1]] ** 2) * (mass * share * distance**2))
        return tuple(new)


def _axes(model: mujoco.MjModel, body: int) -> tuple[np.ndarray, np.ndarray]:
    """Along the link, in the body's frame and in its principal axes."""
    along, turn = link_axes(model, body)[1], np.zeros(9)
    mujoco.mju_quat2Mat(turn, model.body_iquat[body])
    return along, turn.reshape(3, 3).T @ along
