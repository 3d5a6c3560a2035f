"""Windows of recordings replayed by a simulator: what `inference.shooting` compares with what was measured."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

from bayessim_jax.beliefs.margins import Margins
from bayessim_jax.systems.mjcf import MjcfSystem, displace

__all__ = ["Inputs", "Replay", "Restarted", "replay_window"]


@struct.dataclass
class Inputs:
    """What the simulation of one window needs."""

    qpos: Float[Array, " nq"]
    """As recorded in the window's first row."""
    qvel: Float[Array, " nv"]
    ctrl: Float[Array, "steps nu"]
    past: Float[Array, "before nu"]
    """Commands of the rows before the window, the last one just before it."""
    time: Float[Array, ""]
    """When the window begins, s in its recording."""
    motion: tuple[Float[Array, "before nq"], Float[Array, "before nv"]] | None = None
    """Positions and velocities in the rows before the window, at rest before the recording begins."""


@dataclass(frozen=True, eq=False)
class Restarted:
    """A system that is restarted from what its sensors show: how recordings of a registered system are replayed.

    θ are some of its parameters; the others stay at `others`. Its engine is itself.
    """

    system: Any
    others: Float[Array, " e"]
    index: tuple[int, ...]
    """Place of each of θ among the system's parameters."""

    name = "analytic"
    reason = "analytic, the registered system's own equations"
    substeps = 1

    @property
    def dt(self) -> float:
        """One control period, s."""
        return self.system.dt

    def replay(self, theta: Array, observation: Float[Array, " obs"], ctrl: Array) -> Float[Array, "rows obs"]:
        """Observations of every row, from the one that the first row shows."""
        full = self.others.at[jnp.asarray(self.index)].set(theta)

        def once(state: Any, action: Array) -> tuple[Any, Array]:
            after = self.system.step(full, state, action)
            return after, self.system.observe(full, after)

        state = self.system.restart(full, observation)
        after = jax.lax.scan(once, state, ctrl)[1]
        return jnp.concatenate([self.system.observe(full, state)[None], after])


def replay_window(system: Any, theta: Array, delta: Float[Array, " n"], window: Inputs) -> Float[Array, "rows obs"]:
    """What the sensors show in every row of a window that begins δ beside the recorded state.

    `system` is an `MjcfSystem`, one with effects, or `Restarted`, whose observations stand under `qpos`.
    """
    if isinstance(system, Restarted):
        return system.replay(theta, window.qpos + delta, window.ctrl)
    nv = system.engine.model.nv
    qpos, qvel = displace(system.engine.model, window.qpos, delta[:nv]), window.qvel + delta[nv:]
    commanded = window.ctrl.shape[-1] > 0
    if isinstance(system, MjcfSystem):
        state = system.begin(theta, qpos, qvel)
        state = dataclasses.replace(state, ctrl=window.ctrl[0]) if commanded else state
    else:
        past = window.past if commanded and window.past.shape[0] else None
        state = system.begin(theta, qpos, qvel, window.ctrl[0] if commanded else None, window.time, past, window.motion)
    first = system.observe(theta, state)
    after = jax.vmap(system.observe, in_axes=(None, 0))(theta, system.replay(theta, state, window.ctrl))
    return jnp.concatenate([first[None], after])


@dataclass(frozen=True, eq=False)
class Replay:
    """`predict(z, δ, window)` of a system whose parameters have these priors.

    Two of the same system and priors are equal, so that what was compiled for one serves the other.
    """

    system: Any
    margins: Margins

    def __call__(self, z: Float[Array, " d"], delta: Float[Array, " n"], window: Inputs) -> Float[Array, "rows obs"]:
        """What the sensors show in every row."""
        return replay_window(self.system, self.margins.theta(z), delta, window)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Replay) and other.system is self.system and other.margins == self.margins

    def __hash__(self) -> int:
        return hash((id(self.system), self.margins))
