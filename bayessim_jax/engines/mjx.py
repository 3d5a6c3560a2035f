"""The mjx engine: MuJoCo in JAX, for models that the tree engine refuses, on an accelerator."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from flax import struct
from jaxtyping import Array, Float

from bayessim_jax.contracts import Scalar
from bayessim_jax.engines.fields import Write
from bayessim_jax.engines.probe import probe_inertia

__all__ = ["MjxEngine", "MjxState"]

MASSES = {"body_mass", "body_inertia", "body_ipos", "body_pos", "dof_armature"}
"""Fields from which MuJoCo derives others when it compiles a model."""


@struct.dataclass
class MjxState:
    """Time, positions, velocities, activations, and where the constraint solver starts."""

    time: Scalar
    qpos: Float[Array, " nq"]
    qvel: Float[Array, " nv"]
    act: Float[Array, " na"]
    warmstart: Float[Array, " nv"]


class MjxEngine:
    """`mujoco.mjx` with θ in the model's fields, and what MuJoCo derives from masses derived anew."""

    name = "mjx"

    def __init__(self, model: mujoco.MjModel, writes: Sequence[Write] = ()) -> None:
        self.mjx = _import_mjx()
        self.model, self.writes = model, tuple(writes)
        if any(w.field == "geom_size" for w in writes):
            raise ValueError("the mjx engine does not take the size of a geom as a parameter; take the mujoco engine.")
        built = model
        sliding = [w for w in writes if w.field == "dof_frictionloss"]
        if sliding:
            built = _with_friction(model, sliding)
        try:
            self.device_model = self.mjx.put_model(built)
        except NotImplementedError as error:
            raise ValueError(f"the mjx engine does not take this model: {error}") from error

    def init(self, theta: Float[Array, " d"], qpos: Float[Array, " nq"], qvel: Float[Array, " nv"]) -> MjxState:
        """The state with these positions and velocities, at time 0, everything else at rest."""
        kind = jnp.result_type(theta)
        zeros = jnp.zeros(self.model.na, kind), jnp.zeros(self.model.nv, kind)
        return MjxState(jnp.zeros((), kind), jnp.asarray(qpos, kind), jnp.asarray(qvel, kind), *zeros)

    def step(
        self,
        theta: Float[Array, " d"],
        state: MjxState,
        ctrl: Float[Array, " nu"],
        applied: Float[Array, " nv"] | None = None,
        steps: int = 1,
    ) -> MjxState:
        """Advance by `steps` time steps under a control and a generalized force that are held."""
        model = self._write(theta)
        data = self._data(model, state, ctrl, applied)
        data, _ = jax.lax.scan(lambda data, _: (self.mjx.step(model, data), None), data, length=steps)
        return MjxState(data.time, data.qpos, data.qvel, data.act, data.qacc_warmstart)

    def replay(
        self,
        theta: Float[Array, " d"],
        state: MjxState,
        ctrls: Float[Array, "periods nu"],
        applied: Float[Array, "periods nv"] | None = None,
        steps: int = 1,
    ) -> MjxState:
        """The states after each row of controls, each held for `steps` time steps."""

        def period(state: MjxState, row: tuple) -> tuple[MjxState, MjxState]:
            after = self.step(theta, state, *row, steps=steps)
            return after, after

        return jax.lax.scan(period, state, (ctrls, applied))[1]

    def qpos(self, state: MjxState) -> Float[Array, " nq"]:
        """Joint positions."""
        return state.qpos

    def qvel(self, state: MjxState) -> Float[Array, " nv"]:
        """Joint velocities."""
        return state.qvel

    def sensors(self, theta: Float[Array, " d"], state: MjxState, ctrl: Float[Array, " nu"]) -> Float[Array, " ns"]:
        """`sensordata` in a state, under a control."""
        model = self._write(theta)
        return self.mjx.forward(model, self._data(model, state, ctrl, None)).sensordata

    def inertia(self, theta: Float[Array, " d"], qpos: Float[Array, " nq"], dof: int) -> Scalar:
        """1/(M⁻¹)ⱼⱼ at a pose, from a step."""
        return probe_inertia(self, theta, qpos, dof)

    def _data(self, model: Any, state: MjxState, ctrl: Array, applied: Array | None) -> Any:
        fields = {
            "time": state.time,
            "qpos": state.qpos,
            "qvel": state.qvel,
            "act": state.act,
            "qacc_warmstart": state.warmstart,
            "ctrl": jnp.asarray(ctrl, state.qpos.dtype),
        }
        if applied is not None:
            fields["qfrc_applied"] = jnp.asarray(applied, state.qvel.dtype)
        return self.mjx.make_data(model).replace(**fields)

    def _write(self, theta: Float[Array, " d"]) -> Any:
        by_field: dict[str, list[Write]] = defaultdict(list)
        for write in self.writes:
            by_field[write.field].append(write)
        replaced = {}
        for field, writes in by_field.items():
            name = "opt.gravity" if field == "gravity" else field
            old = self.device_model.opt.gravity if field == "gravity" else getattr(self.device_model, field)
            index = tuple(np.array([w.index for w in writes]).T)
            factors = jnp.array([w.factor for w in writes], old.dtype)
            values = factors * theta[np.array([w.parameter for w in writes])].astype(old.dtype)
            replaced[name] = jnp.asarray(old).at[index].set(values)
        model = self.device_model.tree_replace(replaced)
        return self._derive(model) if MASSES & set(by_field) else model

    def _derive(self, model: Any) -> Any:
        """Subtree masses and inverse weights at the reference position, as `mj_setConst` computes them."""
        mjx = self.mjx
        parents, mass = self.model.body_parentid, list(model.body_mass)
        for body in reversed(range(1, self.model.nbody)):
            mass[parents[body]] = mass[parents[body]] + mass[body]
        model = model.replace(body_subtreemass=jnp.stack(mass))
        data = mjx.make_data(model).replace(qpos=jnp.asarray(self.model.qpos0, model.body_mass.dtype))
        data = mjx.crb(model, mjx.com_pos(model, mjx.kinematics(model, data)))
        inverse = jnp.linalg.inv(mjx.full_m(model, data))
        diagonal = jnp.diagonal(inverse)
        dofs = [diagonal[np.array(group)].mean() for group in self._dof_groups() for _ in group]

        def body_weight(body: int) -> Array:
            if self.model.body_weldid[body] == 0:
                return jnp.zeros(2, diagonal.dtype)
            jacobians = mjx.jac(model, data, data.xipos[body], body)
            return jnp.stack([jnp.einsum("ik,ij,jk->", j, inverse, j) / 3.0 for j in jacobians])

        bodies = jnp.stack([body_weight(b) for b in range(self.model.nbody)])
        return model.replace(dof_invweight0=jnp.stack(dofs), body_invweight0=bodies)

    def _dof_groups(self) -> list[list[int]]:
        """Degrees of freedom that share one inverse weight: three of a ball, twice three of a free joint."""
        groups = []
        for joint in range(self.model.njnt):
            kind, first = self.model.jnt_type[joint], int(self.model.jnt_dofadr[joint])
            if kind == mujoco.mjtJoint.mjJNT_FREE:
                groups += [[first, first + 1, first + 2], [first + 3, first + 4, first + 5]]
            elif kind == mujoco.mjtJoint.mjJNT_BALL:
                groups.append([first, first + 1, first + 2])
            else:
                groups.append([first])
        return groups


def _with_friction(model: mujoco.MjModel, writes: Sequence[Write]) -> mujoco.MjModel:
    """MJX decides which joints have friction when it takes the model: those whose friction is not zero."""
    import copy

    model = copy.copy(model)
    for write in writes:
        model.dof_frictionloss[write.index] = max(1e-3, float(model.dof_frictionloss[write.index]))
    return model


def _import_mjx() -> Any:
    try:
        from mujoco import mjx
    except ImportError as error:
        raise ValueError('the mjx engine needs mujoco-mjx: pip install "bayessim-jax[mjx]".') from error
    return mjx
