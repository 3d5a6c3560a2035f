"""The tree engine: contact-free MuJoCo models of hinges and slides, written out while tracing."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from flax import struct
from jax.core import Tracer
from jaxtyping import Array, Float

from bayessim_jax.contracts import Scalar
from bayessim_jax.engines.fields import Write
from bayessim_jax.engines.tree.dynamics import mass_matrix, place_links
from bayessim_jax.engines.tree.folding import Folded, fold, settle
from bayessim_jax.engines.tree.integrate import advance
from bayessim_jax.engines.tree.prepare import prepare
from bayessim_jax.engines.tree.solve import add_to_diagonal, solve
from bayessim_jax.engines.tree.support import find_refusals

__all__ = ["TreeEngine", "TreeState"]

Step = Callable[["TreeState", Sequence[Scalar], Sequence[Scalar] | None], "TreeState"]


@struct.dataclass
class TreeState:
    """Positions (m, rad) and velocities (m/s, rad/s), a scalar each: under `vmap` each has the batch as its axis."""

    qpos: tuple[Scalar, ...]
    qvel: tuple[Scalar, ...]


@dataclass(eq=False)
class TreeEngine:
    """Forward dynamics over the fixed topology of a model; zeros and ones of the model never reach the compiler.

    Engines of the same model and writes are equal, so that what was compiled for one serves the other; the model must
    not be changed afterwards.
    """

    model: mujoco.MjModel
    writes: tuple[Write, ...] = ()
    name: str = "tree"

    def __post_init__(self) -> None:
        refusals = find_refusals(self.model, self.writes)
        if refusals:
            raise ValueError(f"the tree engine does not take this model: {'; '.join(refusals)}.")

    def __eq__(self, other: object) -> bool:
        return isinstance(other, TreeEngine) and other._key == self._key

    def __hash__(self) -> int:
        return hash(self._key)

    @cached_property
    def _key(self) -> tuple[bytes, tuple[Write, ...]]:
        saved = np.empty(mujoco.mj_sizeModel(self.model), np.uint8)
        mujoco.mj_saveModel(self.model, None, saved)
        return saved.tobytes(), self.writes

    def init(self, theta: Float[Array, " d"], qpos: Float[Array, " nq"], qvel: Float[Array, " nv"]) -> TreeState:
        """The state with these positions and velocities."""
        kind = jnp.result_type(theta)
        return TreeState(_split(qpos, self.model.nq, kind), _split(qvel, self.model.nv, kind))

    def step(
        self,
        theta: Float[Array, " d"],
        state: TreeState,
        ctrl: Float[Array, " nu"],
        applied: Float[Array, " nv"] | None = None,
        steps: int = 1,
    ) -> TreeState:
        """Advance by `steps` time steps under a control and a generalized force that are held."""
        once, kind = self._prepare(theta), jnp.result_type(theta)
        forces = None if applied is None else _settled(applied, self.model.nv, kind)
        return _repeat(once, state, _settled(ctrl, self.model.nu, kind), forces, steps)

    def replay(
        self,
        theta: Float[Array, " d"],
        state: TreeState,
        ctrls: Float[Array, "periods nu"],
        applied: Float[Array, "periods nv"] | None = None,
        steps: int = 1,
    ) -> TreeState:
        """The states after each row of controls, each held for `steps` time steps."""
        once, kind = self._prepare(theta), jnp.result_type(theta)
        columns = tuple(ctrls[:, k].astype(kind) for k in range(self.model.nu))
        forces = None if applied is None else tuple(applied[:, k].astype(kind) for k in range(self.model.nv))

        def period(state: TreeState, row: tuple) -> tuple[TreeState, TreeState]:
            after = _repeat(once, state, row[0], row[1], steps)
            return after, after

        return jax.lax.scan(period, state, (columns, forces), length=ctrls.shape[0])[1]

    def qpos(self, state: TreeState) -> Float[Array, " nq"]:
        """Joint positions."""
        return jnp.stack(state.qpos)

    def qvel(self, state: TreeState) -> Float[Array, " nv"]:
        """Joint velocities."""
        return jnp.stack(state.qvel)

    def sensors(self, theta: Float[Array, " d"], state: TreeState, ctrl: Float[Array, " nu"]) -> Float[Array, " ns"]:
        """The tree engine has no sensors but the joints' positions and velocities."""
        raise NotImplementedError("the tree engine has no sensors; observe joints, or take the mujoco engine.")

    def inertia(self, theta: Float[Array, " d"], qpos: Float[Array, " nq"], dof: int) -> Scalar:
        """1/(M⁻¹)ⱼⱼ at a pose, of which what is known while tracing never reaches the compiler."""
        kind = jnp.result_type(theta)
        tree = prepare(self.model, self.writes, [theta[k] for k in range(theta.shape[0])])
        traced = isinstance(qpos, Tracer)
        pose = _split(qpos, self.model.nq, kind) if traced else np.asarray(qpos).tolist()
        matrix = add_to_diagonal(mass_matrix(tree.links, place_links(tree.links, _fold_all(pose))), tree.armature)
        inverse = solve(matrix, [fold(float(i == dof)) for i in range(self.model.nv)])
        return jnp.asarray((1.0 / inverse[dof]).value, kind)

    def _prepare(self, theta: Float[Array, " d"]) -> Step:
        """One time step with θ written in; what depends on θ alone is computed outside of loops."""
        tree = prepare(self.model, self.writes, [theta[k] for k in range(theta.shape[0])])

        def once(state: TreeState, ctrl: Sequence[Scalar], applied: Sequence[Scalar] | None) -> TreeState:
            forces = [fold(0.0)] * self.model.nv if applied is None else _fold_all(applied)
            q, v = _fold_all(state.qpos), _fold_all(state.qvel)
            q, v = advance(tree, q, v, _fold_all(ctrl), forces)
            return TreeState(tuple(x.value for x in q), tuple(x.value for x in v))

        return once


def _repeat(
    once: Step, state: TreeState, ctrl: Sequence[Scalar], applied: Sequence[Scalar] | None, steps: int
) -> TreeState:
    if steps == 1:
        return once(state, ctrl, applied)
    return jax.lax.scan(lambda s, _: (once(s, ctrl, applied), None), state, length=steps)[0]


def _fold_all(values: Sequence[Scalar | float]) -> list[Folded]:
    return [fold(x) for x in values]


def _split(vector: Float[Array, " n"], size: int, kind: jnp.dtype) -> tuple[Scalar, ...]:
    vector = jnp.asarray(vector, kind)
    return tuple(vector[k] for k in range(size))


def _settled(vector: Float[Array, " n"], size: int, kind: jnp.dtype) -> tuple[Scalar, ...]:
    """Components that lie next to each other in memory batch by batch, and so are not gathered inside of loops."""
    columns = _split(vector, size, kind)
    return columns if size < 2 else tuple(x.value for x in settle(*_fold_all(columns)))
