"""The mass of a Gaussian in a box, by sequential conditioning on a fixed set of quasi-random points."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from bayessim_jax.beliefs.interval import log_mass, quantile
from bayessim_jax.contracts import Scalar

__all__ = ["box_probability", "condition", "lattice"]


def box_probability(
    means: Float[Array, "components d"],
    scale_trils: Float[Array, "components d d"],
    low: Float[Array, " d"],
    high: Float[Array, " d"],
    points: int = 128,
) -> Float[Array, " components"]:
    """log P(low ≤ θ ≤ high) under each N(μₖ, Lₖ Lₖᵀ); exact for d = 1, finite however small the mass is.

    Source: Genz 1992
    """
    d = means.shape[-1]
    u = lattice(points if d > 1 else 1, d - 1)

    def log_probability(mean: Float[Array, " d"], scale_tril: Float[Array, "d d"]) -> Scalar:
        log_weights, _, _ = jax.vmap(lambda v: condition(mean, scale_tril, low, high, v))(u)
        return jax.nn.logsumexp(log_weights) - jnp.log(u.shape[0])

    return jax.vmap(log_probability)(means, scale_trils)


def condition(
    mean: Float[Array, " d"],
    scale_tril: Float[Array, "d d"],
    low: Float[Array, " d"],
    high: Float[Array, " d"],
    u: Float[Array, " drawn"],
) -> tuple[Scalar, list[Scalar], list[Scalar]]:
    """Walk along the axes: the mass of axis j given the earlier ones, and z_j drawn within it where u names one.

    θ = μ + L z. Returns the log product of the d masses, the z drawn, and where each θ_j lies between its bounds
    (0 … 1). Averaged over uniform u in d − 1 dimensions, the product is the mass of the box.

    Source: Genz 1992
    """
    log_weight, drawn, fractions = jnp.zeros((), mean.dtype), [], []
    for j in range(mean.size):
        centre = mean[j] + sum((scale_tril[j, i] * drawn[i] for i in range(j)), jnp.zeros((), mean.dtype))
        left, right = (low[j] - centre) / scale_tril[j, j], (high[j] - centre) / scale_tril[j, j]
        log_weight = log_weight + log_mass(left, right)
        if j < u.size:
            z, fraction = quantile(u[j], left, right)
            drawn.append(z)
            fractions.append(fraction)
    return log_weight, drawn, fractions


def lattice(points: int, d: int) -> Float[Array, "points d"]:
    """Richtmyer's points {i √p_j + ½} in the open unit cube, p_j the j-th prime, folded by the tent map |2x − 1|.

    Source: Genz and Bretz 2009
    """
    primes: list[int] = []
    candidate = 2
    while len(primes) < d:
        if all(candidate % p for p in primes):
            primes.append(candidate)
        candidate += 1
    rows = [[abs(2 * math.fmod(i * math.sqrt(p) + 0.5, 1.0) - 1) for p in primes] for i in range(1, points + 1)]
    return jnp.array(rows, dtype=float).reshape(points, d)
