"""The small networks of the learners."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import flax.linen as nn
from jax.nn.initializers import variance_scaling
from jaxtyping import Array, Float

__all__ = ["Mlp"]


class Mlp(nn.Module):
    """Fully connected layers, x ← activation(W x + b), and a linear output; uniform initial weights.

    The variance of a weight is gain² · 2 / (inputs + outputs), with a gain of √2 before an activation.

    Source: Glorot and Bengio 2010
    """

    widths: tuple[int, ...]
    outputs: int
    activation: Callable[[Any], Any] = nn.tanh
    output_gain: float = 1.0

    @nn.compact
    def __call__(self, x: Float[Array, "*batch inputs"]) -> Float[Array, "*batch outputs"]:
        """Apply the network to the last axis."""
        for width in self.widths:
            x = self.activation(nn.Dense(width, kernel_init=variance_scaling(2.0, "fan_avg", "uniform"))(x))
        return nn.Dense(self.outputs, kernel_init=variance_scaling(self.output_gain**2, "fan_avg", "uniform"))(x)
