"""Random numbers, as few draws as possible: each is a loop of its own that a compiler has to make."""

from __future__ import annotations

import math
from typing import Any

import jax
from jaxtyping import Array, PRNGKeyArray

__all__ = ["draw", "normal"]


def draw(key: PRNGKeyArray, shape: tuple[int, ...]) -> Array:
    """Uniform numbers in (0, 1), neither end included; drawn as one line, which compiles several times faster."""
    return jax.random.uniform(key, (math.prod(shape),), minval=1e-7).reshape(shape)


def normal(uniform: Any) -> Any:
    """The standard normal number that a uniform one in (0, 1) is the quantile of."""
    return jax.scipy.special.ndtri(uniform)
