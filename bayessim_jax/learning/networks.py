"""The small networks of the learners."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import flax.linen as nn
from jaxtyping import Array, Float

__all__ = ["Mlp"]


class Mlp(nn.Module):
    """Fully connected layers, x ← activation(W x + b), and a linear output; orthogonal initial weights."""

    widths: tuple[int, ...]
    outputs: int
    activation: Callable[[Any], Any] = nn.tanh
    output_gain: float = 1.0

    @nn.compact
    def __call__(self, x: Float[Array, "*batch inputs"]) -> Float[Array, "*batch outputs"]:
        """Apply the network to the last axis."""
        for width in self.widths:
            x = self.activation(nn.Dense(width, kernel_init=nn.initializers.orthogonal(2**0.5))(x))
        return nn.Dense(self.outputs, kernel_init=nn.initializers.orthogonal(self.output_gain))(x)
