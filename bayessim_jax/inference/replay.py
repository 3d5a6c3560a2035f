"""Windows of recordings replayed by a simulator: what `inference.shooting` compares with what was measured."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from bayessim_jax.beliefs.margins import Margins
from bayessim_jax.contracts import Box, Discrete
from bayessim_jax.effects.commanded import AugmentedSystem
from bayessim_jax.systems.mjcf import MjcfSystem, displace, system_key

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
    unrecorded: Bool[Array, " before"] | None = None
    """Rows before the recording begins, whose commands are not known."""


@dataclass(frozen=True, eq=False)
class Restarted:
    """A system that is restarted from what its sensors show: how recordings of a registered system are replayed.

    θ are some of its parameters; the others stay at `others`. Its engine is itself.
    """

    system: Any
    parameters: Box
    """Of θ."""
    others: Float[Array, " e"]
    index: tuple[int, ...]
    """Place of each of θ among the system's parameters."""

    name = "analytic"
    reason = "analytic, the registered system's own equations"
    substeps = 1

    @property
    def actions(self) -> Box | Discrete:
        """The system's."""
        return self.system.actions

    @property
    def observations(self) -> Box:
        """The system's."""
        return self.system.observations

    @property
    def noise(self) -> Float[Array, " obs"]:
        """The system's."""
        return self.system.noise

    @property
    def dt(self) -> float:
        """One control period, s."""
        return self.system.dt

    def reset(self, key: PRNGKeyArray, theta: Float[Array, " d"]) -> Any:
        """The system's."""
        return self.system.reset(key, self._full(theta))

    def restart(self, theta: Float[Array, " d"], observation: Float[Array, " obs"]) -> Any:
        """The state that shows this observation."""
        return self.system.restart(self._full(theta), observation)

    def step(self, theta: Float[Array, " d"], state: Any, action: Float[Array, " act"]) -> Any:
        """Advance by one control period."""
        return self.system.step(self._full(theta), state, action)

    def observe(self, theta: Float[Array, " d"], state: Any) -> Float[Array, " obs"]:
        """What the sensors show."""
        return self.system.observe(self._full(theta), state)

    def _full(self, theta: Float[Array, " d"]) -> Float[Array, " e"]:
        return self.others.at[jnp.asarray(self.index, int)].set(theta)


def replay_window(system: Any, theta: Array, delta: Float[Array, " n"], window: Inputs) -> Float[Array, "rows obs"]:
    """What the sensors show in every row of a window that begins δ beside the recorded state.

    `system` is an `MjcfSystem` or `Restarted`, or one of them with effects. Observations of a restarted one stand under
    `qpos`; what follows these in δ is added to commands from before the recording. What follows positions and
    velocities in that of a model with effects moves what these are taken to remember.
    """
    if isinstance(system, (Restarted, AugmentedSystem)):
        return _replay_restarted(system, theta, delta, window)
    nv = system.engine.model.nv
    qpos, qvel = displace(system.engine.model, window.qpos, delta[:nv]), window.qvel + delta[nv : 2 * nv]
    commanded = window.ctrl.shape[-1] > 0
    if isinstance(system, MjcfSystem):
        state = system.begin(theta, qpos, qvel)
        state = dataclasses.replace(state, ctrl=window.ctrl[0]) if commanded else state
    else:
        past = window.past if commanded and window.past.shape[0] else None
        first, moves = window.ctrl[0] if commanded else None, delta[2 * nv :] if delta.size > 2 * nv else None
        state = system.begin(theta, qpos, qvel, first, window.time, past, window.motion, moves)
    first = system.observe(theta, state)
    after = jax.vmap(system.observe, in_axes=(None, 0))(theta, system.replay(theta, state, window.ctrl))
    return jnp.concatenate([first[None], after])


def _replay_restarted(
    system: Restarted | AugmentedSystem, theta: Array, delta: Float[Array, " n"], window: Inputs
) -> Float[Array, "rows obs"]:
    """The same for a system without a model."""
    size = system.observations.size
    shown = window.qpos + delta[:size]
    if isinstance(system, Restarted):
        first = system.restart(theta, shown)
    else:
        past = window.past
        if window.unrecorded is not None:
            past = past + jnp.where(window.unrecorded[:, None], delta[size:], 0.0)
        first = system.begin(theta, shown, past, window.time)

    def once(state: Any, action: Array) -> tuple[Any, Array]:
        after = system.step(theta, state, action)
        return after, system.observe(theta, after)

    after = jax.lax.scan(once, first, window.ctrl)[1]
    return jnp.concatenate([system.observe(theta, first)[None], after])


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
        return isinstance(other, Replay) and other._key == self._key

    def __hash__(self) -> int:
        return hash(self._key)

    @cached_property
    def _key(self) -> tuple[Any, ...]:
        return system_key(self.system), self.margins
