"""Sigma points: few θ with weights that integrate a function over a belief."""

from __future__ import annotations

import math
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from bayessim_jax.beliefs import GaussianMixture, Truncated

__all__ = ["components", "sigma_points"]


def sigma_points(mixture: GaussianMixture) -> tuple[Float[Array, "points d"], Float[Array, " points"]]:
    """Points and probabilities that integrate polynomials up to the third degree exactly over every component.

        μₖ with αₖ κ/(d + κ),   μₖ ± √(d + κ) Lₖ eᵢ with αₖ/(2(d + κ)) each,   κ = max(3 − d, 0)

    κ = 3 − d matches the fourth moments along the axes too. From three parameters on it would make the weight of the
    centre negative, and so the mean of costs that are not: there the centre is left out, which is the cubature rule.

    Source: Julier and Uhlmann 2004; Arasaratnam and Haykin 2009
    """
    d = mixture.means.shape[1]
    kappa = max(3 - d, 0)
    reach = math.sqrt(d + kappa) * jnp.swapaxes(mixture.scale_trils, -1, -2)
    offsets = jnp.concatenate([reach, -reach, jnp.zeros_like(reach[:, : min(kappa, 1)])], axis=1)
    share = jnp.array([0.5 / (d + kappa)] * (2 * d) + [kappa / (d + kappa)] * min(kappa, 1))
    points = mixture.means[:, None] + offsets
    return points.reshape(-1, d), (mixture.weights[:, None] * share).ravel()


def components(belief: Any) -> GaussianMixture:
    """A belief as Gaussians: its own components, cut to the prior's box where it is, or one with its two moments."""
    if isinstance(belief, GaussianMixture):
        return belief
    if isinstance(belief, Truncated):
        return belief.components()
    scale_tril = jnp.linalg.cholesky(belief.covariance())
    return GaussianMixture(jnp.zeros(1), belief.mean()[None], scale_tril[None])
