"""Random numbers, as few draws as possible: each is a loop of its own that a compiler has to make."""

from __future__ import annotations

import math
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

__all__ = ["draw", "normal", "pick"]


def draw(key: PRNGKeyArray, shape: tuple[int, ...], dtype: Any = float) -> Array:
    """Uniform numbers in (0, 1), neither end included; drawn as one line, which compiles several times faster."""
    return jax.random.uniform(key, (math.prod(shape),), dtype, minval=1e-7).reshape(shape)


def normal(uniform: Any) -> Any:
    """The standard normal number that a uniform one in (0, 1) is the quantile of."""
    return jax.scipy.special.ndtri(uniform)


def pick(uniform: Float[Array, ""], log_weights: Float[Array, " n"]) -> Int[Array, ""]:
    """The index below which this share of the weights lies."""
    ladder = jnp.cumsum(jax.nn.softmax(log_weights))
    return jnp.minimum((ladder <= uniform * ladder[-1]).sum(), log_weights.size - 1)
