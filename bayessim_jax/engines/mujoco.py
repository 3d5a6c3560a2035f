"""The mujoco engine: MuJoCo's C code on threads, called from inside compiled code."""

from __future__ import annotations

import math
import os
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from flax import struct
from jaxtyping import Array, Float, UInt32
from mujoco import rollout

from bayessim_jax.contracts import Scalar
from bayessim_jax.engines.fields import Write
from bayessim_jax.engines.models import ModelBank
from bayessim_jax.engines.probe import probe_inertia

__all__ = ["MujocoEngine", "MujocoState", "count_cores"]

PHYSICS = int(mujoco.mjtState.mjSTATE_FULLPHYSICS)
CTRL, APPLIED = int(mujoco.mjtState.mjSTATE_CTRL), int(mujoco.mjtState.mjSTATE_QFRC_APPLIED)


def count_cores() -> int:
    """Processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextmanager
def _silence() -> Iterator[None]:
    """Keep MuJoCo from printing and filing a line for every simulation that diverges: it shows in the numbers."""
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda text: None)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(before)


@struct.dataclass
class MujocoState:
    """MuJoCo's whole state in float64, each number as the two halves of its bits, and what of it is looked at."""

    physics: UInt32[Array, " 2n"]
    qpos: Float[Array, " nq"]
    qvel: Float[Array, " nv"]


class MujocoEngine:
    """`mujoco.rollout` over a model for each θ, in `jax.pure_callback`: under `jax.vmap` one call takes the batch.

    Works inside `jax.jit`, `jax.lax.scan` and `jax.vmap`, and is not differentiable. In `step` the constraint solver
    starts from rest at each call; in `replay` it goes on from the last time step, as a loop of `mj_step` does. A
    simulation that diverges is not reset, so that it shows as numbers that are not finite.
    """

    name = "mujoco"

    def __init__(
        self,
        model: mujoco.MjModel,
        writes: Sequence[Write] = (),
        spec: mujoco.MjSpec | None = None,
        threads: int | None = None,
        inputs: int = CTRL,
    ) -> None:
        """`inputs` says which parts of MuJoCo's state (`mujoco.mjtState`) `drive` is given, in MuJoCo's order."""
        model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
        self.model, self.writes, self.inputs = model, tuple(writes), inputs
        self.bank = ModelBank(model, writes, spec)
        self.threads = threads or count_cores()
        self.pool = rollout.Rollout(nthread=self.threads)
        self.data = [mujoco.MjData(model) for _ in range(self.threads)]
        self.lock = threading.Lock()
        self.rest = np.zeros(mujoco.mj_stateSize(model, PHYSICS))
        mujoco.mj_getState(model, self.data[0], self.rest, PHYSICS)

    def init(self, theta: Float[Array, " d"], qpos: Float[Array, " nq"], qvel: Float[Array, " nv"]) -> MujocoState:
        """The state with these positions and velocities, at time 0, everything else at rest."""
        kind = jnp.result_type(theta)
        qpos, qvel = jnp.asarray(qpos, kind), jnp.asarray(qvel, kind)
        shape = jax.ShapeDtypeStruct((2 * self.rest.size,), jnp.uint32)
        return MujocoState(jax.pure_callback(self._begin, shape, qpos, qvel, vmap_method="broadcast_all"), qpos, qvel)

    def step(
        self,
        theta: Float[Array, " d"],
        state: MujocoState,
        ctrl: Float[Array, " nu"],
        applied: Float[Array, " nv"] | None = None,
        steps: int = 1,
    ) -> MujocoState:
        """Advance by `steps` time steps under a control and a generalized force that are held."""
        held = ctrl[None], None if applied is None else applied[None]
        return jax.tree.map(lambda leaf: leaf[0], self.replay(theta, state, *held, steps=steps))

    def replay(
        self,
        theta: Float[Array, " d"],
        state: MujocoState,
        ctrls: Float[Array, "periods nu"],
        applied: Float[Array, "periods nv"] | None = None,
        steps: int = 1,
    ) -> MujocoState:
        """The states after each row of controls, each held for `steps` time steps, in one call of the C code."""
        kind, periods = state.qpos.dtype, ctrls.shape[0]
        shapes = (
            jax.ShapeDtypeStruct((periods, 2 * self.rest.size), jnp.uint32),
            jax.ShapeDtypeStruct((periods, self.model.nq), kind),
            jax.ShapeDtypeStruct((periods, self.model.nv), kind),
        )
        call = partial(self._advance, steps)
        inputs = (theta, state.physics, ctrls) if applied is None else (theta, state.physics, ctrls, applied)
        return MujocoState(*jax.pure_callback(call, shapes, *inputs, vmap_method="broadcast_all"))

    def drive(
        self, theta: Float[Array, " d"], state: MujocoState, inputs: Float[Array, " inputs"], steps: int = 1
    ) -> tuple[MujocoState, Float[Array, " ns"]]:
        """Advance by `steps` time steps under inputs that are held, and what the sensors show after them.

        Sensors of forces and accelerations show those under the same inputs.
        """
        kind, model = state.qpos.dtype, self.model
        shapes = (
            jax.ShapeDtypeStruct((2 * self.rest.size,), jnp.uint32),
            jax.ShapeDtypeStruct((model.nq,), kind),
            jax.ShapeDtypeStruct((model.nv,), kind),
            jax.ShapeDtypeStruct((model.nsensordata,), kind),
        )
        call = partial(self._drive, steps)
        *after, seen = jax.pure_callback(call, shapes, theta, state.physics, inputs, vmap_method="broadcast_all")
        return MujocoState(*after), seen

    def clear(self, state: MujocoState, index: tuple[int, ...]) -> MujocoState:
        """The same state with these entries of `qpos` zero; all others stay as they are to the last bit."""
        rows = jnp.array(index)
        bits = state.physics.reshape(-1, 2).at[1 + rows].set(0).ravel()
        return MujocoState(bits, state.qpos.at[rows].set(0.0), state.qvel)

    def qpos(self, state: MujocoState) -> Float[Array, " nq"]:
        """Joint positions."""
        return state.qpos

    def qvel(self, state: MujocoState) -> Float[Array, " nv"]:
        """Joint velocities."""
        return state.qvel

    def sensors(self, theta: Float[Array, " d"], state: MujocoState, ctrl: Float[Array, " nu"]) -> Float[Array, " ns"]:
        """`sensordata` in a state, under a control."""
        shape = jax.ShapeDtypeStruct((self.model.nsensordata,), state.qpos.dtype)
        return jax.pure_callback(self._sense, shape, theta, state.physics, ctrl, vmap_method="broadcast_all")

    def inertia(self, theta: Float[Array, " d"], qpos: Float[Array, " nq"], dof: int) -> Scalar:
        """1/(M⁻¹)ⱼⱼ at a pose, from a step."""
        return probe_inertia(self, theta, qpos, dof)

    def _begin(self, qpos: Any, qvel: Any) -> np.ndarray:
        qpos, qvel = np.asarray(qpos), np.asarray(qvel)
        physics = np.broadcast_to(self.rest, (*qpos.shape[:-1], self.rest.size)).copy()
        nq, nv = self.model.nq, self.model.nv
        physics[..., 1 : 1 + nq] = qpos
        physics[..., 1 + nq : 1 + nq + nv] = qvel
        return physics.view(np.uint32)

    def _advance(
        self, steps: int, theta: Any, physics: Any, ctrls: Any, applied: Any = None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        physics, ctrls = np.asarray(physics), np.asarray(ctrls)
        lead, periods = physics.shape[:-1], ctrls.shape[-2]
        size = math.prod(lead)
        rows = [ctrls] if applied is None else [ctrls, np.asarray(applied)]
        control = np.concatenate([r.reshape(size, periods, r.shape[-1]).astype(np.float64) for r in rows], -1)
        control = np.repeat(control, steps, axis=1) if steps > 1 else control
        spec = CTRL if applied is None else CTRL | APPLIED
        states, _ = self._rollout(theta, physics, control, spec, sensors=False)
        return self._show(states[:, steps - 1 :: steps].reshape(*lead, periods, -1), np.asarray(theta).dtype)

    def _drive(self, steps: int, theta: Any, physics: Any, inputs: Any) -> tuple[np.ndarray, ...]:
        """One time step more than asked for: it begins with the sensors of the state asked for, and is thrown away."""
        physics, inputs, kind = np.asarray(physics), np.asarray(inputs), np.asarray(theta).dtype
        lead = physics.shape[:-1]
        held = np.repeat(inputs.reshape(math.prod(lead), 1, -1).astype(np.float64), steps + 1, axis=1)
        states, seen = self._rollout(theta, physics, held, self.inputs, sensors=True)
        after = self._show(states[:, steps - 1].reshape(*lead, -1), kind)
        return *after, seen[:, steps].reshape(*lead, -1).astype(kind)

    def _show(self, states: np.ndarray, kind: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The bits of states, and their positions and velocities as numbers of a kind."""
        nq, nv = self.model.nq, self.model.nv
        with np.errstate(over="ignore"):
            qpos, qvel = (part.astype(kind) for part in (states[..., 1 : 1 + nq], states[..., 1 + nq : 1 + nq + nv]))
        return np.ascontiguousarray(states).view(np.uint32), qpos, qvel

    def _sense(self, theta: Any, physics: Any, ctrl: Any) -> np.ndarray:
        """What the sensors show at the beginning of a time step, which is then thrown away."""
        physics, ctrl = np.asarray(physics), np.asarray(ctrl)
        control = ctrl.reshape(math.prod(ctrl.shape[:-1]), 1, ctrl.shape[-1]).astype(np.float64)
        _, seen = self._rollout(theta, physics, control, CTRL, sensors=True)
        return seen[:, 0].reshape(*physics.shape[:-1], -1).astype(np.asarray(theta).dtype)

    def _rollout(
        self, theta: Any, physics: np.ndarray, control: np.ndarray, spec: int, sensors: bool
    ) -> tuple[np.ndarray, np.ndarray]:
        theta = np.asarray(theta)
        size, steps = control.shape[:2]
        initial = np.ascontiguousarray(physics).reshape(size, -1).view(np.float64)
        states = np.empty((size, steps, self.rest.size))
        seen = np.empty((size, steps if sensors else 0, self.model.nsensordata))
        with self.lock, _silence():
            self.pool.rollout(
                self.bank.batch(theta.reshape(size, theta.shape[-1])),
                self.data,
                initial,
                control if control.size else None,
                control_spec=spec,
                nstep=steps,
                skip_checks=True,
                state=states,
                sensordata=seen if sensors else None,
            )
        return states, seen
