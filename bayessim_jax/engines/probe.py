"""What engines tell of a model by stepping it."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import mujoco
from jaxtyping import Array, Float

from bayessim_jax.contracts import Scalar
from bayessim_jax.mechanics import free_inertia

__all__ = ["probe_inertia"]


def probe_inertia(engine: Any, theta: Float[Array, " d"], qpos: Float[Array, " nq"], dof: int) -> Scalar:
    """`Engine.inertia` by how much a push of one time step moves the joint from rest.

    Where the step is implicit, damping within it counts as inertia.
    """
    model, kind = engine.model, jnp.result_type(theta)
    push = float(free_inertia(model, mujoco.MjData(model), model.qpos0)[dof]) / float(model.opt.timestep)
    state = engine.init(theta, jnp.asarray(qpos, kind), jnp.zeros(model.nv, kind))
    ctrl, applied = jnp.zeros(model.nu, kind), jnp.zeros(model.nv, kind)
    pushed = jnp.stack([applied, applied.at[dof].set(push)])
    still, moved = jax.vmap(lambda f: engine.qvel(engine.step(theta, state, ctrl, f))[dof])(pushed)
    return push * float(model.opt.timestep) / (moved - still)
