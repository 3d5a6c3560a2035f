"""Is a posterior as wide as it should be: simulation-based calibration, coverage, TARP and the classifier test.

Every tool takes n pairs of a truth drawn from the prior and draws (or densities) of the posterior that its recording
gave. A posterior that equals the prior passes the first three: they judge width, log q(θ*) judges sharpness.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import optax
from flax import linen as nn
from jax.scipy.special import gammaincc
from jaxtyping import Array, Float, PRNGKeyArray

from bayessim_jax.contracts import Scalar

__all__ = ["c2st", "expected_coverage", "sbc_ranks", "tarp", "uniformity_test"]

_EXPECTED_PER_BIN = 5


def sbc_ranks(samples: Float[Array, "n draws d"], truths: Float[Array, "n d"]) -> Float[Array, "n d"]:
    """Rank of each truth among the posterior's draws, axis by axis: 0 … draws.

    Good: uniform over the n pairs. Crowded at both ends says too narrow, in the middle too wide, at one end shifted.
    NaN: the truth or one of its draws is not a number.

    Source: Talts et al. 2018
    """
    ranks = (samples < truths[:, None]).sum(1).astype(samples.dtype)
    return jnp.where(jnp.isnan(samples).any(1) | jnp.isnan(truths), jnp.nan, ranks)


def uniformity_test(
    ranks: Float[Array, "n *axes"], draws: int, bins: int = 10
) -> tuple[Float[Array, "*axes"], Float[Array, "*axes"]]:
    """Pearson's χ² of the ranks 0 … draws against the uniform law, and its p-value, axis by axis.

        χ² = Σ_b (count_b − expected_b)²/expected_b,   p = Q((bins − 1)/2, χ²/2)

    Bins hold as many of the draws + 1 ranks as they can evenly; where that is uneven, `expected` is too. Good: p above
    0.01. NaN: a rank is NaN.
    """
    if not 2 <= bins <= draws + 1:
        raise ValueError(f"uniformity_test: bins is {bins}; choose 2 to draws + 1 = {draws + 1}.")
    if ranks.shape[0] < _EXPECTED_PER_BIN * bins:
        raise ValueError(
            f"uniformity_test: {ranks.shape[0]} ranks in {bins} bins are fewer than {_EXPECTED_PER_BIN} a bin; "
            f"take at most {max(ranks.shape[0] // _EXPECTED_PER_BIN, 1)} bins or more pairs."
        )

    def counts(values: Float[Array, " m"]) -> Float[Array, " bins"]:
        index = jnp.floor(values * bins / (draws + 1))
        return (index == jnp.arange(bins)[:, None]).sum(1).astype(values.dtype)

    expected = counts(jnp.arange(draws + 1, dtype=ranks.dtype)) * ranks.shape[0] / (draws + 1)

    def test(column: Float[Array, " n"]) -> tuple[Scalar, Scalar]:
        chi2 = ((counts(column) - expected) ** 2 / expected).sum()
        chi2 = jnp.where(jnp.isnan(column).any(), jnp.nan, chi2)
        return chi2, gammaincc(0.5 * (bins - 1), 0.5 * chi2)

    chi2, p = jax.vmap(test, 1)(ranks.reshape(ranks.shape[0], -1))
    return chi2.reshape(ranks.shape[1:]), p.reshape(ranks.shape[1:])


def expected_coverage(
    log_prob_truth: Float[Array, " n"],
    log_prob_samples: Float[Array, "n draws"],
    levels: Float[Array, " levels"],
) -> Float[Array, " levels"]:
    """Share of the n truths inside the highest-density region that holds each level of the posterior's mass.

    The region that just holds a truth has the mass of the draws that are denser than it (ties count half). Good: the
    level itself, within √(level (1 − level)/n); below says overconfident, above says too wide. NaN: a log density is
    NaN; −∞ for a truth outside the support is a truth not covered.

    Source: Hermans et al. 2022
    """
    denser = (log_prob_samples > log_prob_truth[:, None]).sum(1)
    tied = (log_prob_samples == log_prob_truth[:, None]).sum(1)
    unsound = jnp.isnan(log_prob_truth) | jnp.isnan(log_prob_samples).any(1)
    return _covered(denser + 0.5 * tied, log_prob_samples.shape[1], unsound, levels)


def tarp(
    key: PRNGKeyArray,
    samples: Float[Array, "n draws d"],
    truths: Float[Array, "n d"],
    levels: Float[Array, " levels"],
) -> Float[Array, " levels"]:
    """Share of the n truths inside balls about random points that hold each level of the posterior's mass.

    The points are uniform over the range of the truths, in which every axis is scaled to 0 … 1. It needs draws only
    and sees what axis-wise ranks cannot: wrong correlations. Good: the level itself, within √(level (1 − level)/n).
    NaN: a truth or a draw is not a number, or all truths agree along an axis.

    Source: Lemos et al. 2023
    """
    low, high = truths.min(0), truths.max(0)
    points = jax.random.uniform(key, truths.shape, truths.dtype)

    def distance(theta: Float[Array, "... n d"]) -> Float[Array, "... n"]:
        return (((theta - low) / (high - low) - points) ** 2).sum(-1)

    to_truth = distance(truths)
    to_draws = distance(jnp.moveaxis(samples, 1, 0))
    unsound = jnp.isnan(to_truth) | jnp.isnan(to_draws).any(0)
    return _covered((to_draws < to_truth).sum(0), samples.shape[1], unsound, levels)


def c2st(key: PRNGKeyArray, x: Float[Array, "n d"], y: Float[Array, "n d"], folds: int = 5, steps: int = 300) -> Scalar:
    """How often a classifier that was trained on other folds tells a draw of x from a draw of y.

    A network with two hidden layers of max(32, 10 d) units, full batches, Adam, inputs standardized by x. Good: 0.5,
    not to be told apart, within 0.5/√n or so; 1.0: always told apart. NaN: a draw is not a number, or x has no spread.

    Source: Lopez-Paz and Oquab 2017
    """
    if x.shape != y.shape:
        raise ValueError(f"c2st: x has shape {x.shape}, y has {y.shape}; give as many draws of each.")
    if not 2 <= folds <= x.shape[0]:
        raise ValueError(f"c2st: folds is {folds}; choose 2 to the number of draws, {x.shape[0]}.")
    n, d = x.shape
    order_key, init_key = jax.random.split(key)
    fold = jax.vmap(lambda k: jax.random.permutation(k, n) % folds)(jax.random.split(order_key)).ravel()
    inputs = (jnp.concatenate([x, y]) - x.mean(0)) / x.std(0)
    labels = jnp.repeat(jnp.array([0.0, 1.0], x.dtype), n)
    width = max(32, 10 * d)
    network = nn.Sequential([nn.Dense(width), nn.relu, nn.Dense(width), nn.relu, nn.Dense(1)])
    optimizer = optax.adamw(optax.cosine_decay_schedule(1e-2, steps), weight_decay=1e-3)

    def held_out(key: PRNGKeyArray, this: Array) -> Scalar:
        training = (fold != this).astype(x.dtype)

        def loss(weights: optax.Params) -> Scalar:
            logits = network.apply(weights, inputs)[:, 0]  # pyright: ignore
            return (training * optax.sigmoid_binary_cross_entropy(logits, labels)).sum() / training.sum()

        def step(carry: tuple, _: None) -> tuple[tuple, None]:
            weights, state = carry
            updates, state = optimizer.update(jax.grad(loss)(weights), state, weights)
            return (optax.apply_updates(weights, updates), state), None

        weights = network.init(key, inputs)
        (weights, _), _ = jax.lax.scan(step, (weights, optimizer.init(weights)), length=steps)
        right = (network.apply(weights, inputs)[:, 0] > 0) == (labels > 0.5)  # pyright: ignore
        return (right & (fold == this)).sum().astype(x.dtype)

    right = jax.vmap(held_out)(jax.random.split(init_key, folds), jnp.arange(folds)).sum()
    return jnp.where(jnp.isfinite(inputs).all(), right / (2 * n), jnp.nan)


def _covered(
    inside: Float[Array, " n"], draws: int, unsound: Array, levels: Float[Array, " levels"]
) -> Float[Array, " levels"]:
    """Share of pairs whose region, which holds `inside` of the draws, is no larger than each level."""
    mass = (inside + 0.5) / (draws + 1)
    share = (mass[:, None] <= levels).mean(0)
    return jnp.where(unsound.any(), jnp.nan, share)
