"""Draws of a posterior, as every way to infer the parameters of a case returns them."""

from __future__ import annotations

import dataclasses

from flax import struct
from jaxtyping import Array, Float

from bayessim_jax.inference.shooting import Fit

__all__ = ["Coverage", "PosteriorDraws"]


@dataclasses.dataclass(frozen=True)
class Coverage:
    """Of posteriors of simulated recordings: how many hold the truth in their 50 % and 90 % credible sets."""

    half: float
    most: float
    sets: int
    """Simulated sets of recordings, none of which a network was trained on."""

    def as_table(self) -> dict[str, float]:
        """The block of `inference.json`."""
        return {"coverage50": self.half, "coverage90": self.most, "sets": self.sets}


@struct.dataclass
class PosteriorDraws:
    """Draws of θ, and the fit of noise and initial states that goes with them."""

    draws: Float[Array, "draws d"]
    """In raw units."""
    z: Float[Array, "draws d"]
    fit: Fit
    sampler: str = struct.field(pytree_node=False)
    efficiency: float | None = struct.field(pytree_node=False, default=None)
    """Effective share of Laplace's draws as an importance sample: 1 where the posterior is Gaussian in z."""
    coverage: Coverage | None = struct.field(pytree_node=False, default=None)
    doubts: tuple[str, ...] = struct.field(pytree_node=False, default=())
    """What stands in the way of believing the draws, in sentences."""

    def marginal(self, d: int) -> PosteriorDraws:
        """Of the first d parameters alone."""
        return dataclasses.replace(self, draws=self.draws[:, :d], z=self.z[:, :d], fit=self.fit.marginal(d))
