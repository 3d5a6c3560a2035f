"""A target that is paid for another task than its own."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float, PRNGKeyArray

from bayessim_jax.contracts import Policy, Recording, Restartable, Task

__all__ = ["Rescored"]


@struct.dataclass
class Rescored:
    """A target with hidden θ*, whose rewards are those of a task for the states that `system.restart` makes of what was
    measured.

    The noise of the sensors is in them, and the task must not need what the sensors do not see. Only the target ends
    its episodes.
    """

    target: Any
    system: Restartable[Any]
    task: Task[Any]
    theta: Float[Array, " d"]

    def record(self, key: PRNGKeyArray, policy: Policy, steps: int) -> Recording:
        """Let the policy act for at most `steps` control periods and return what was measured."""
        seen: Any = self.target.replace(theta=self.theta).record(key, policy, steps)
        middle = 0.5 * (self.system.parameters.low + self.system.parameters.high)
        states = jax.vmap(self.system.restart, (None, 0))(middle, seen.observations)
        before, after = jax.tree.map(lambda x: x[:-1], states), jax.tree.map(lambda x: x[1:], states)
        rewards = jax.vmap(self.task.reward)(before, seen.actions, after)
        return seen.replace(rewards=jnp.where(seen.valid, rewards, 0.0))
