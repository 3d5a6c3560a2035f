"""Hold: bring slides and hinges of a MuJoCo model to a pose, and keep them there."""

from __future__ import annotations

from typing import Any, Protocol

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float

from bayessim_jax.contracts import Box, Scalar

__all__ = ["Hold", "Posed"]


class Posed(Protocol):
    """A system whose states have the positions and velocities of a MuJoCo model."""

    def positions(self, state: Any) -> Float[Array, " nq"]:
        """`qpos`."""
        ...

    def velocities(self, state: Any) -> Float[Array, " nv"]:
        """`qvel`."""
        ...


@struct.dataclass
class Hold:
    """Reward −(mean ((q − g)/w)² + a mean (v/s)² + b mean ((u − ū)/r)²) of the state reached; no episode ends early.

    q and v are positions and velocities of the joints concerned, g the goal, w and s what counts as far and as fast;
    ū and r are the middle and the half-width of the actions' box. The cost falls on the way to the goal, so that
    planners and learners take the same one.
    """

    system: Posed
    actions: Box
    goal: Float[Array, " joints"]
    """m or rad."""
    far: Float[Array, " joints"]
    fast: Float[Array, " joints"]
    """m/s or rad/s."""
    places: tuple[int, ...] = struct.field(pytree_node=False)
    """Of the joints in `qpos`."""
    rates: tuple[int, ...] = struct.field(pytree_node=False)
    """Of the joints in `qvel`."""
    turns: tuple[bool, ...] = struct.field(pytree_node=False)
    """Which of them turn freely, so that a whole turn changes nothing."""
    steps: int = struct.field(pytree_node=False, default=200)
    motion_cost: float = 0.05
    """a."""
    command_cost: float = 0.005
    """b."""

    def gap(self, state: Any) -> Float[Array, " joints"]:
        """How far q lies from g, m or rad, the short way around for joints that turn freely."""
        gap = self.system.positions(state)[jnp.asarray(self.places)] - self.goal
        wrapped = jnp.mod(gap + jnp.pi, 2 * jnp.pi) - jnp.pi
        return jnp.where(jnp.asarray(self.turns), wrapped, gap)

    def reward(self, state: Any, action: Float[Array, " act"], next_state: Any) -> Scalar:
        """Minus the cost of the state that the action led to, and of the action."""
        rate = self.system.velocities(next_state)[jnp.asarray(self.rates)]
        effort = (2.0 * action - self.actions.low - self.actions.high) / self.actions.width
        place = jnp.mean((self.gap(next_state) / self.far) ** 2)
        motion = self.motion_cost * jnp.mean((rate / self.fast) ** 2)
        return -(place + motion + self.command_cost * jnp.mean(effort**2))

    def terminated(self, state: Any) -> Bool[Array, ""]:
        """Never."""
        return jnp.zeros((), bool)
