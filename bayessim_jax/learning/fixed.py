"""A learner that does not learn: for inference alone, and for recordings made by somebody else's controller."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float, Int, PRNGKeyArray

from bayessim_jax.contracts import Belief, Box, Discrete, Policy, Scalar

__all__ = ["Fixed", "FixedInfo", "RandomPolicy", "RecordedActions"]


@struct.dataclass
class RandomPolicy:
    """Actions drawn uniformly from the action space, whatever is observed."""

    actions: Box | Discrete

    def init(self) -> tuple[()]:
        """No memory."""
        return ()

    def act(
        self, key: PRNGKeyArray, memory: tuple[()], observation: Float[Array, " obs"]
    ) -> tuple[Float[Array, " act"], tuple[()]]:
        """One uniform draw."""
        if isinstance(self.actions, Discrete):
            return jax.random.randint(key, (1,), 0, self.actions.count).astype(observation.dtype), memory
        return jax.random.uniform(
            key, self.actions.low.shape, minval=self.actions.low, maxval=self.actions.high
        ), memory


@struct.dataclass
class RecordedActions:
    """The actions of a recording in their order, whatever is observed; its memory is the number of those taken."""

    actions: Float[Array, "steps act"]

    def init(self) -> Int[Array, ""]:
        """None yet."""
        return jnp.zeros((), jnp.int32)

    def act(
        self, key: PRNGKeyArray, memory: Int[Array, ""], observation: Float[Array, " obs"]
    ) -> tuple[Float[Array, " act"], Int[Array, ""]]:
        """The next one; the last is repeated."""
        return self.actions[memory], jnp.minimum(memory + 1, self.actions.shape[0] - 1)


@struct.dataclass
class FixedInfo:
    """Nothing was learned, and nothing went wrong."""

    return_mean: Scalar
    """NaN."""
    nonfinite: Int[Array, ""]
    skipped: Int[Array, ""]


@struct.dataclass
class Fixed:
    """Always the same policy; its state is empty."""

    always: Policy

    def init(self, key: PRNGKeyArray) -> tuple[()]:
        """Nothing to learn."""
        return ()

    def step(self, key: PRNGKeyArray, state: tuple[()], belief: Belief) -> tuple[tuple[()], FixedInfo]:
        """Do nothing."""
        return (), FixedInfo(jnp.array(jnp.nan), jnp.array(0), jnp.array(0))

    def policy(self, state: tuple[()], deterministic: bool = False) -> Any:
        """The policy given."""
        return self.always
