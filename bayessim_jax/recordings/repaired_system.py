"""A case's simulator as a system to train on: its episodes begin where its recordings were."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float, PRNGKeyArray

from bayessim_jax.contracts import Box, Discrete
from bayessim_jax.effects.augmented import AugmentedMjcf
from bayessim_jax.systems.mjcf import MjcfSystem, displace

__all__ = ["RepairedSystem", "Starts"]


@struct.dataclass
class Starts:
    """Recorded states, with the command that followed each and when that was, s in its recording."""

    qpos: Float[Array, "starts nq"]
    qvel: Float[Array, "starts nv"]
    ctrl: Float[Array, "starts nu"]
    time: Float[Array, " starts"]


@struct.dataclass
class RepairedSystem:
    """A simulator with or without effects as a `System`: with the recordings' starts, ranges and control period.

    Actuators and sensors with a memory begin as if the recorded command of the start had been held for long.
    """

    parameters: Box
    actions: Box | Discrete
    observations: Box
    noise: Float[Array, " obs"]
    simulator: MjcfSystem | AugmentedMjcf
    starts: Starts
    scatter: Float[Array, " 2nv"]
    """Episodes begin beside a recorded state by this times a uniform number in ±1: positions, then velocities."""
    rows: int = struct.field(pytree_node=False)
    """Of a recording, in one control period."""
    dt: float = struct.field(pytree_node=False)

    def reset(self, key: PRNGKeyArray, theta: Float[Array, " d"]) -> Any:
        """One of the recorded states, scattered."""
        pick, spread = jax.random.split(key)
        row = jax.random.randint(pick, (), 0, self.starts.time.shape[0])
        start = jax.tree.map(lambda x: x[row], self.starts)
        move = self.scatter * jax.random.uniform(spread, self.scatter.shape, minval=-1.0, maxval=1.0)
        model = self.simulator.engine.model
        qpos, qvel = displace(model, start.qpos, move[: model.nv]), start.qvel + move[model.nv :]
        if isinstance(self.simulator, MjcfSystem):
            return self.simulator.begin(theta, qpos, qvel)
        return self.simulator.begin(theta, qpos, qvel, start.ctrl, start.time)

    def restart(self, theta: Float[Array, " d"], observation: Float[Array, " obs"]) -> Any:
        """The state that shows this observation; raises `ValueError` where a position or velocity is not observed."""
        return self.simulator.restart(theta, observation)

    def step(self, theta: Float[Array, " d"], state: Any, action: Float[Array, " act"]) -> Any:
        """Advance by one control period, the command held."""
        rows = jnp.broadcast_to(action, (self.rows, *action.shape))
        return jax.tree.map(lambda x: x[-1], self.simulator.replay(theta, state, rows))

    def observe(self, theta: Float[Array, " d"], state: Any) -> Float[Array, " obs"]:
        """What was measured in the recordings, in the same order."""
        return self.simulator.observe(theta, state)
