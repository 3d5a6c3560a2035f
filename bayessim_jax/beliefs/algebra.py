"""Products, quotients and reductions of Gaussian mixtures: evidence combines by algebra, not by averages."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from bayessim_jax.beliefs.mixture import GaussianMixture
from bayessim_jax.beliefs.triangular import factor, invert, log_normal
from bayessim_jax.contracts import Scalar

__all__ = ["product", "quotient", "reduce"]


def product(a: GaussianMixture, b: GaussianMixture) -> GaussianMixture:
    """The pointwise product a(θ) b(θ), exact, with one component for each pair (a's index runs slowest).

    A pair weighs αᵢ βⱼ N(μᵢ; μⱼ, Σᵢ + Σⱼ), so the log-sum-exp of the weights returned is log ∫ a b.
    """

    def multiply(
        log_a: Scalar, mean_a: Array, tril_a: Array, log_b: Scalar, mean_b: Array, tril_b: Array
    ) -> tuple[Scalar, Array, Array]:
        gap, precise = mean_b - mean_a, invert(tril_b)
        roots = jnp.concatenate([invert(tril_a), precise])  # rowsᵀ rows is the precision of the product
        tril = invert(jnp.flip(factor(jnp.flip(roots.T, 0))).T)
        mean = mean_a + tril @ (tril.T @ (precise.T @ (precise @ gap)))
        return log_a + log_b + log_normal(gap, factor(jnp.concatenate([tril_a, tril_b], axis=1))), mean, tril

    pairs = jax.vmap(jax.vmap(multiply, (None, None, None, 0, 0, 0)), (0, 0, 0, None, None, None))
    log_weights, means, trils = pairs(*_leaves(a), *_leaves(b))
    return GaussianMixture(
        log_weights.ravel(), means.reshape(-1, *means.shape[2:]), trils.reshape(-1, *trils.shape[2:])
    )


def quotient(
    numerator: GaussianMixture,
    mean: Float[Array, " d"],
    scale_tril: Float[Array, "d d"],
    spread: float | Scalar = 1.0,
    reach: float | Scalar = 3.0,
) -> GaussianMixture:
    """The quotient by one Gaussian N(mean, L Lᵀ), exact as far as it stays where that Gaussian has its mass.

    In the coordinates L⁻¹ (θ − mean), turned so that a component's covariance is diagonal, each of its axes has a
    variance λ and a mean c, and is divided by the power κ of the divisor's:

        N(x; c, λ) / exp(−κ x²/2)  ∝  N(x; c/g, λ/g),   g = 1 − κ λ

    κ is 1, or the most that leaves λ/g at or below spread² and |c|/g at or below `reach`: a component that is almost as
    wide as the divisor would have its quotient far outside, and one that is wider has none. Such an axis stays nearer
    to what it was; with κ = 0 it is as it was. The log-sum-exp of the weights returned is log ∫ of the quotient.
    """

    def divide(log_weight: Scalar, mu: Array, tril: Array) -> tuple[Scalar, Array, Array]:
        tiny = jnp.finfo(tril.dtype).tiny
        relative, gap = invert(scale_tril) @ tril, invert(scale_tril) @ (mu - mean)
        turn = jnp.linalg.eigh(relative.T @ relative)[1]
        axes = relative @ turn
        variance = (axes**2).sum(0) + tiny
        pull = axes.T @ gap
        least = jnp.maximum(variance / spread**2, jnp.abs(pull) / jnp.sqrt(variance) / reach)
        power = jnp.clip((1 - least) / variance, 0.0, 1.0)
        left = 1 - power * variance
        gain = 0.5 * (power * pull**2 / (variance * left) - jnp.log(left)).sum()
        return (
            log_weight + gain - log_normal(jnp.zeros_like(mean), scale_tril),
            mu + tril @ turn @ (power * pull / left),
            factor(tril @ (turn / jnp.sqrt(left))),
        )

    return GaussianMixture(*jax.vmap(divide)(*_leaves(numerator)))


def reduce(mixture: GaussianMixture, count: int) -> GaussianMixture:
    """Merge pairs until `count` components are left; the mean, the covariance and the mass of the whole stay.

    Each step merges the pair whose merging costs least by the bound on the Kullback-Leibler divergence

        B(i, j) = ½ [(wᵢ + wⱼ) log|Pᵢⱼ| − wᵢ log|Pᵢ| − wⱼ log|Pⱼ|]

    with Pᵢⱼ the covariance of the merged pair. A mixture that has no more than `count` is returned as it is.

    Source: Runnalls 2007
    """
    size = mixture.log_weights.size
    if count < 1:
        raise ValueError(f"reduce: count is {count}; keep at least 1 component.")
    if count >= size:
        return mixture
    tiny = jnp.finfo(mixture.means.dtype).tiny

    def merge(i: Array, j: Array, parts: tuple[Array, Array, Array]) -> tuple[Scalar, Array, Array]:
        w, mu, tril = parts
        total = w[i] + w[j]
        share_i, share_j = w[i] / jnp.maximum(total, tiny), w[j] / jnp.maximum(total, tiny)
        gap = (jnp.sqrt(share_i * share_j) * (mu[i] - mu[j]))[:, None]
        rows = jnp.concatenate([jnp.sqrt(share_i) * tril[i], jnp.sqrt(share_j) * tril[j], gap], axis=1)
        empty = total < tiny
        mean = jnp.where(empty, mu[i], share_i * mu[i] + share_j * mu[j])
        return total, mean, factor(jnp.where(empty, jnp.pad(tril[i], ((0, 0), (0, mu.shape[1] + 1))), rows))

    def costs(i: Array, parts: tuple[Array, Array, Array], alive: Array) -> Array:
        w, _, tril = parts
        log_det = jnp.log(jnp.diagonal(tril, axis1=-2, axis2=-1)).sum(-1)

        def cost(j: Array) -> Scalar:
            total, _, merged = merge(i, j, parts)
            return total * jnp.log(jnp.diagonal(merged)).sum() - w[i] * log_det[i] - w[j] * log_det[j]

        other = jnp.arange(size)
        bound = jax.vmap(cost)(other)
        return jnp.where(alive & (other != i) & ~jnp.isnan(bound), bound, jnp.inf)

    def step(_: int, carry: tuple[Array, ...]) -> tuple[Array, ...]:
        w, mu, tril, alive, table = carry
        i, j = jnp.unravel_index(jnp.argmin(table), table.shape)
        total, mean, merged = merge(i, j, (w, mu, tril))
        parts = (w.at[i].set(total).at[j].set(0.0), mu.at[i].set(mean), tril.at[i].set(merged))
        alive = alive.at[j].set(False)
        row = costs(i, parts, alive)
        table = table.at[j].set(jnp.inf).at[:, j].set(jnp.inf).at[i].set(row).at[:, i].set(row)
        return (*parts, alive, table)

    parts, alive = (mixture.weights, mixture.means, mixture.scale_trils), jnp.ones(size, bool)
    table = jax.vmap(lambda i: costs(i, parts, alive))(jnp.arange(size))
    w, mu, tril, alive, _ = jax.lax.fori_loop(0, size - count, step, (*parts, alive, table))
    kept = jnp.argsort(~alive, stable=True)[:count]
    log_weights = jnp.log(jnp.maximum(w[kept], tiny)) + jax.nn.logsumexp(mixture.log_weights)
    return GaussianMixture(log_weights, mu[kept], tril[kept])


def _leaves(mixture: GaussianMixture) -> tuple[Array, Array, Array]:
    return jax.nn.log_softmax(mixture.log_weights), mixture.means, mixture.scale_trils
