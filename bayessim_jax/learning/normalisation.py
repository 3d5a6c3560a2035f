"""Fixed scaling of what a network sees, from the box of the observations."""

from __future__ import annotations

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

from bayessim_jax.contracts import Box

__all__ = ["Scaling"]


@struct.dataclass
class Scaling:
    """n = clip((y − shift) / scale, ±10), dimensionless; a box maps onto [−1, 1]."""

    shift: Float[Array, " obs"]
    scale: Float[Array, " obs"]

    @classmethod
    def from_box(cls, box: Box) -> Scaling:
        """Centre and half-width of a box; axes without finite bounds stay as they are."""
        bounded = jnp.isfinite(box.width)
        return cls(
            shift=jnp.where(bounded, (box.low + box.high) / 2, 0.0),
            scale=jnp.where(bounded, box.width / 2, 1.0),
        )

    def normalise(self, observation: Float[Array, "*batch obs"]) -> Float[Array, "*batch obs"]:
        """Scaled observations, without unit."""
        return jnp.clip((observation - self.shift) / self.scale, -10.0, 10.0)
