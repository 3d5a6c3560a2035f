"""Ground that is more or less slippery than believed."""

from __future__ import annotations

import jax.numpy as jnp
import mujoco
from jaxtyping import Array

from bayessim_jax.effects.contract import EffectParameter, ModelEffect, Number, Numbers, Scales, Values
from bayessim_jax.engines.contacts import find_contact, find_partners

__all__ = ["ContactFriction"]


class ContactFriction(ModelEffect):
    """The coefficient μ of sliding friction between a geom that moves and what it touches.

    MuJoCo takes the larger coefficient of the two, so those of the world's geoms that it can touch are lowered to μ
    where they are above it. μ has no unit.
    """

    name = "contact_friction"

    def places(self, model: mujoco.MjModel) -> list[str]:
        """Every geom with a name that moves and can touch something, unless contacts are disabled."""
        if find_contact(model) is None:
            return []
        moving = [g for g in range(model.ngeom) if model.body_weldid[model.geom_bodyid[g]] and model.geom(g).name]
        return [f"geom/{model.geom(g).name}" for g in moving if find_partners(model, g)]

    def parameters(self, place: str, scales: Scales) -> tuple[EffectParameter, ...]:
        """The coefficient μ; `scales.friction` is that of the model."""
        friction = scales.friction
        return (EffectParameter("coefficient", "", 0.02, max(2.0, 2.0 * friction), friction, 0.8 * friction, log=True),)

    def targets(self, model: mujoco.MjModel, place: str) -> tuple[tuple[str, tuple[int, ...]], ...]:
        """The first coefficients of the geom and of the world's geoms that it can touch."""
        geom = model.geom(place.removeprefix("geom/")).id
        fixed = [o for o in find_partners(model, geom) if model.body_weldid[model.geom_bodyid[o]] == 0]
        return tuple(("geom_friction", (g, 0)) for g in (geom, *fixed))

    def edit(self, values: Values, numbers: Numbers, model: mujoco.MjModel, place: str) -> tuple[Number | Array, ...]:
        """The coefficient of the geom is μ, those of what it touches at most μ."""
        _, *fixed = self.targets(model, place)
        others = [jnp.minimum(numbers(field, *index), values["coefficient"]) for field, index in fixed]
        return (values["coefficient"], *others)
