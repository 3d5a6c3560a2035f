"""How far what bends before it yields was bent before a recording begins."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array

from bayessim_jax.effects.contract import Number

__all__ = ["bent_before"]

BENT = 0.9
"""Of the most that it can be bent: as much as it is taken to be, at most."""


def bent_before(now: Number, most: Number, path: Number, move: Number) -> Array:
    """As far as now if nothing has moved since, and less the longer the path, in reaches of it, and `move` beside that.

    `move` is N(0, 1) a priori, and never leads beyond `most` either way.
    """
    guess = BENT * jnp.clip(now / most, -1.0, 1.0) * jnp.exp(-path)
    return most * jnp.tanh(jnp.arctanh(guess) + move)
