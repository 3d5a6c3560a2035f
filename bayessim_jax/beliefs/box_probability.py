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
    points: int = 256,
) -> Float[Array, " components"]:
    """Log P(low ≤ θ ≤ high) under each N(μₖ, Lₖ Lₖᵀ); exact for d = 1, finite however small the mass is.

    Source: Genz 1992
    """
    d = means.shape[-1]
    u = lattice(points if d > 1 else 1, d)

    def log_probability(mean: Float[Array, " d"], scale_tril: Float[Array, "d d"]) -> Scalar:
        log_weights, _ = jax.vmap(lambda v: condition(mean, scale_tril, low, high, v))(u)
        return jax.nn.logsumexp(log_weights) - jnp.log(u.shape[0])

    return jax.vmap(log_probability)(means, scale_trils)


@jax.jit
def condition(
    mean: Float[Array, " d"],
    scale_tril: Float[Array, "d d"],
    low: Float[Array, " d"],
    high: Float[Array, " d"],
    u: Float[Array, " d"],
) -> tuple[Scalar, Float[Array, " d"]]:
    """Walk along the axes of θ = μ + L z: the mass of each given the earlier ones, and z_j drawn within it by u_j.

    Returns the log product of the masses, and where each θ_j lies between its bounds (0 … 1). Averaged over u uniform
    in the cube the product is the mass of the box, whatever the last u is.

    Source: Genz 1992
    """

    def step(carry: tuple[Scalar, Array], axis: tuple[Array, ...]) -> tuple[tuple[Scalar, Array], Scalar]:
        log_weight, z = carry
        j, centre, row, bottom, top, share = axis
        centre = centre + row @ z
        left, right = (bottom - centre) / row[j], (top - centre) / row[j]
        drawn, fraction = quantile(share, left, right)
        return (log_weight + log_mass(left, right), z.at[j].set(drawn)), fraction

    start = (jnp.zeros((), mean.dtype), jnp.zeros_like(mean))
    (log_weight, _), fractions = jax.lax.scan(step, start, (jnp.arange(mean.size), mean, scale_tril, low, high, u))
    return log_weight, fractions


def lattice(points: int, d: int) -> Float[Array, "points d"]:
    """Even points in the open unit cube: (i − ½)/N along the first axis, Richtmyer's {i √p_j + ½} along the others.

    p_j is the j-th prime; the latter are folded by the tent map |2x − 1|, so that an integrand need not be periodic.

    Source: Genz and Bretz 2009
    """
    primes: list[int] = []
    candidate = 2
    while len(primes) < d - 1:
        if all(candidate % p for p in primes):
            primes.append(candidate)
        candidate += 1
    rows = [
        [(i - 0.5) / points, *(abs(2 * math.fmod(i * math.sqrt(p) + 0.5, 1.0) - 1) for p in primes)]
        for i in range(1, points + 1)
    ]
    return jnp.array(rows, dtype=float)
