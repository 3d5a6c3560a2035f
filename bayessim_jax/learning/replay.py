"""A replay buffer as one table of numbers: the oldest rows are written over, so old dynamics fade."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float, Int, PRNGKeyArray

__all__ = ["Replay"]


@struct.dataclass
class Replay:
    """Rows of equal width; the first `filled` hold data and the next block goes to row `cursor`."""

    table: Float[Array, "capacity width"]
    cursor: Int[Array, ""]
    filled: Int[Array, ""]

    @classmethod
    def create(cls, capacity: int, width: int) -> Replay:
        """An empty buffer."""
        zero = jnp.zeros((), jnp.int32)
        return cls(jnp.zeros((capacity, width)), zero, zero)

    def add(self, rows: Float[Array, "rows width"]) -> Replay:
        """Write a block over the oldest one; its length must divide the capacity."""
        capacity, count = self.table.shape[0], rows.shape[0]
        if capacity % count:
            raise ValueError(f"capacity {capacity} is no multiple of the {count} rows added at once; choose one.")
        return Replay(
            table=jax.lax.dynamic_update_slice_in_dim(self.table, rows.astype(self.table.dtype), self.cursor, 0),
            cursor=(self.cursor + count) % capacity,
            filled=jnp.minimum(self.filled + count, capacity),
        )

    def sample_later(
        self, key: PRNGKeyArray, batch: tuple[int, ...], weights: Float[Array, " capacity"], length: int
    ) -> tuple[Float[Array, "*batch width"], Float[Array, "*batch width"]]:
        """Rows drawn by their weights, and for each a row drawn evenly from itself and those after it in its episode.

        Episodes are blocks of `length` rows that fill the table.
        """
        row_key, later_key = jax.random.split(key)
        heaped = jnp.cumsum(jnp.where(jnp.arange(weights.size) < self.filled, weights, 0.0))
        picks = heaped[-1] * jax.random.uniform(row_key, (math.prod(batch),))
        row = jnp.clip(jnp.searchsorted(heaped, picks, side="right"), 0, weights.size - 1)
        left = (length - row % length) * jax.random.uniform(later_key, row.shape)
        now, later = (self.table[r] for r in (row, row + left.astype(row.dtype)))
        return now.reshape(*batch, -1), later.reshape(*batch, -1)

    def sample(self, key: PRNGKeyArray, batch: tuple[int, ...]) -> Float[Array, "*batch width"]:
        """Rows drawn evenly, with replacement, from those that hold data."""
        rows = jax.random.randint(key, (math.prod(batch),), 0, jnp.maximum(self.filled, 1))
        return self.table[rows].reshape(*batch, -1)
