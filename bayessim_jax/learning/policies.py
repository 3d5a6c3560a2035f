"""The policy that the learners hand out."""

from __future__ import annotations

from typing import Any

from flax import struct
from jaxtyping import Array, Float, PRNGKeyArray

from bayessim_jax.chance import draw
from bayessim_jax.learning.heads import Actor
from bayessim_jax.learning.networks import Mlp
from bayessim_jax.learning.normalisation import Scaling

__all__ = ["NetworkPolicy"]


@struct.dataclass
class NetworkPolicy:
    """u ~ head(network(normalise(y))), or the head's mode where `deterministic`; it remembers nothing."""

    weights: Any
    scaling: Scaling
    head: Actor
    network: Mlp = struct.field(pytree_node=False)
    deterministic: bool = struct.field(pytree_node=False, default=False)

    def init(self) -> tuple[()]:
        """No memory."""
        return ()

    def act(
        self, key: PRNGKeyArray, memory: tuple[()], observation: Float[Array, " obs"]
    ) -> tuple[Float[Array, " act"], tuple[()]]:
        """Choose an action for a noisy observation."""
        outputs: Any = self.network.apply(self.weights, self.scaling.normalise(observation))
        if self.deterministic:
            return self.head.action(self.head.mode(outputs)), memory
        noise = self.head.noise(draw(key, (self.head.chances,)))
        return self.head.action(self.head.sample(outputs, noise)), memory
