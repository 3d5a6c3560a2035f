"""The small networks of the learners."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

__all__ = ["Mlp", "evaluate_critics"]


class Mlp(nn.Module):
    """Fully connected layers, x ← activation(W x + b), and a linear output.

    Initial weights are normal with the variance that an orthogonal matrix has, gain²/max(inputs, outputs), and a gain
    of √2 before an activation.
    """

    widths: tuple[int, ...]
    outputs: int
    activation: Callable[[Any], Any] = nn.tanh
    output_gain: float = 1.0

    @nn.compact
    def __call__(self, x: Float[Array, "*batch inputs"]) -> Float[Array, "*batch outputs"]:
        """Apply the network to the last axis."""
        for width in self.widths:
            x = self.activation(nn.Dense(width, kernel_init=_normal(2**0.5))(x))
        return nn.Dense(self.outputs, kernel_init=_normal(self.output_gain))(x)


def evaluate_critics(
    critic: Mlp, critics: Sequence[Any], seen: Float[Array, "batch obs"], action: Float[Array, "batch act"]
) -> Float[Array, "batch critics"]:
    """Q(y, u) of every critic, one network with several weights."""
    both = jnp.concatenate([seen, action], -1)
    values: Any = [critic.apply(weights, both) for weights in critics]
    return jnp.concatenate(values, -1)


def _normal(gain: float) -> Callable[..., Any]:
    return lambda key, shape, dtype: gain / max(shape) ** 0.5 * jax.random.normal(key, shape, dtype or jnp.float32)
