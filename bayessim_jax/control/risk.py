"""Risk: one number from the costs of a plan under several θ."""

from __future__ import annotations

from typing import Protocol

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

__all__ = ["RISKS", "ConditionalValueAtRisk", "Mean", "Risk", "WorstCase"]


class Risk(Protocol):
    """What a plan is judged by. It lies between the least and the greatest of the costs, so it is never negative where
    they are not.
    """

    def __call__(
        self, costs: Float[Array, "points samples"], weights: Float[Array, " points"]
    ) -> Float[Array, " samples"]:
        """Reduce the costs of every sampled plan under θ₁, θ₂, … with probabilities that add up to one."""
        ...


@struct.dataclass
class Mean:
    """E S = Σ wᵢ Sᵢ."""

    def __call__(
        self, costs: Float[Array, "points samples"], weights: Float[Array, " points"]
    ) -> Float[Array, " samples"]:
        """The expected cost."""
        return weights @ costs


@struct.dataclass
class ConditionalValueAtRisk:
    """The expected cost in the worst `tail` of the belief: the mean at 1, the worst case as it goes to 0.

    Source: Rockafellar and Uryasev 2000
    """

    tail: float = 0.2

    def __call__(
        self, costs: Float[Array, "points samples"], weights: Float[Array, " points"]
    ) -> Float[Array, " samples"]:
        """Fill the tail from the dearest θ on."""
        order = jnp.argsort(-costs, axis=0)
        ordered, mass = jnp.take_along_axis(costs, order, 0), weights[order]
        before = jnp.cumsum(mass, axis=0) - mass
        return (jnp.clip(self.tail - before, 0.0, mass) * ordered).sum(0) / self.tail


@struct.dataclass
class WorstCase:
    """The cost under the dearest θ that has any probability."""

    def __call__(
        self, costs: Float[Array, "points samples"], weights: Float[Array, " points"]
    ) -> Float[Array, " samples"]:
        """The greatest cost."""
        return jnp.where(weights[:, None] > 0, costs, -jnp.inf).max(0)


RISKS: dict[str, type[Mean] | type[ConditionalValueAtRisk] | type[WorstCase]] = {
    "mean": Mean,
    "cvar": ConditionalValueAtRisk,
    "worst": WorstCase,
}
