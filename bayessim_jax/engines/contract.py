"""What every engine promises: a MuJoCo model whose parameters θ are an argument, stepped in compiled code."""

from __future__ import annotations

from typing import Protocol, TypeVar, runtime_checkable

import mujoco
from jaxtyping import Array, Float

from bayessim_jax.contracts import Scalar
from bayessim_jax.engines.fields import Write

__all__ = ["Engine"]

S = TypeVar("S")


@runtime_checkable
class Engine(Protocol[S]):
    """Steps one model; callers batch with `jax.vmap`. θ is traced, so another θ never compiles anew.

    Positions, velocities, controls and forces are in the model's order and units (m, rad, s, kg). States hold arrays
    only.
    """

    name: str
    """What is named in outputs."""
    model: mujoco.MjModel
    writes: tuple[Write, ...]
    """Which numbers of the model θ sets."""

    def init(self, theta: Float[Array, " d"], qpos: Float[Array, " nq"], qvel: Float[Array, " nv"]) -> S:
        """The state with these positions and velocities, at time 0, everything else at rest."""
        ...

    def step(
        self,
        theta: Float[Array, " d"],
        state: S,
        ctrl: Float[Array, " nu"],
        applied: Float[Array, " nv"] | None = None,
        steps: int = 1,
    ) -> S:
        """Advance by `steps` time steps under a control and a generalized force (`qfrc_applied`) that are held."""
        ...

    def replay(
        self,
        theta: Float[Array, " d"],
        state: S,
        ctrls: Float[Array, "periods nu"],
        applied: Float[Array, "periods nv"] | None = None,
        steps: int = 1,
    ) -> S:
        """The states after each row of controls, each held for `steps` time steps; a leading axis on every leaf."""
        ...

    def qpos(self, state: S) -> Float[Array, " nq"]:
        """Joint positions."""
        ...

    def qvel(self, state: S) -> Float[Array, " nv"]:
        """Joint velocities."""
        ...

    def sensors(self, theta: Float[Array, " d"], state: S, ctrl: Float[Array, " nu"]) -> Float[Array, " ns"]:
        """`sensordata` in a state, under a control; engines without sensors raise `NotImplementedError`."""
        ...

    def inertia(self, theta: Float[Array, " d"], qpos: Float[Array, " nq"], dof: int) -> Scalar:
        """1/(M⁻¹)ⱼⱼ at a pose (kg or kg m²): what a degree of freedom shows of inertia while the others are free."""
        ...
