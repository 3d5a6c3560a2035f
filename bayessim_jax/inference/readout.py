"""The posterior of a set of recordings, read by small networks from what the evidence of its recordings adds up to."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float, Int, PRNGKeyArray

from bayessim_jax.beliefs import GaussianMixture
from bayessim_jax.beliefs.triangular import solve_lower
from bayessim_jax.contracts import Scalar
from bayessim_jax.inference.fit import Schedule, fit
from bayessim_jax.inference.heads import MixtureHead
from bayessim_jax.inference.recalibration import SCALES, Recalibration, best_scale, credible_levels, regress

__all__ = ["Readout", "read_sets"]

HEAD = MixtureHead(components=5, hidden=32)
MEMBERS, FOLDS = 2, 5
"""Networks, and parts of the sets: network m holds out part m."""
FARTHEST = 30.0
"""Standardized errors beyond which they count as that."""


@struct.dataclass
class Readout:
    """θ given the moments (μ, L) of a set's combined evidence: those of a corrected Gaussian, and a shape in its units.

        θ = μ' + L' ρ,   μ' = μ + L shift(μ),   L' = L stretch,   ρ ~ Σₖ αₖ N(mₖ, Sₖ)

    The mixture is what networks say at (μ, L), spread by a factor about its mean; with weights of zero it is N(0, I).
    """

    recalibration: Recalibration
    origin: Float[Array, " features"]
    unit: Float[Array, " features"]
    params: Any
    """Weights of `HEAD`, one set for each network (leading axis)."""
    scale: Scalar

    @classmethod
    def none(cls, d: int) -> Readout:
        """The Gaussian with the moments of what is read."""
        features = 2 * d + d * (d - 1) // 2
        params = jax.tree.map(jnp.zeros_like, HEAD.init(jax.random.key(0), features, d))
        several = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (MEMBERS, *leaf.shape)), params)
        return cls(Recalibration.none(d), jnp.zeros(features), jnp.ones(features), several, jnp.ones(()))

    def apply(self, evidence: GaussianMixture) -> GaussianMixture:
        """The average of what the networks say of one Gaussian."""
        every = jax.vmap(lambda params: self.said(params, evidence))(self.params)
        return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), every)

    def said(self, params: Any, evidence: GaussianMixture) -> GaussianMixture:
        """What the network with these weights says."""
        mean, tril = self.correct(evidence)
        shape = HEAD.mixture(params, self.read(evidence)).widen(self.scale)
        return GaussianMixture(shape.log_weights, mean + shape.means @ tril.T, tril @ shape.scale_trils)

    def correct(self, evidence: GaussianMixture) -> tuple[Float[Array, " d"], Float[Array, "d d"]]:
        """μ' and L'."""
        mean, tril = evidence.means[0], evidence.scale_trils[0]
        return mean + tril @ self.recalibration.shift(mean), tril @ self.recalibration.stretch

    def read(self, evidence: GaussianMixture) -> Float[Array, " features"]:
        """What networks see: (μ, L), standardized."""
        return jnp.clip((_moments(evidence) - self.origin) / self.unit, -3.0, 3.0)


def read_sets(
    key: PRNGKeyArray,
    evidence: GaussianMixture,
    truths: Float[Array, "n d"],
    low: Float[Array, " d"],
    high: Float[Array, " d"],
) -> tuple[Readout, Float[Array, " held"], Int[Array, ""]]:
    """Learn θ of n sets from their combined evidence, a Gaussian each, and make the credible sets hold their share.

    The product of the evidence of many recordings is a summary of the set, not its posterior: an error that networks
    make at one θ for every recording alike is counted in it as often as there are recordings, and where evidence is
    weak, or bent, or cut by the prior's box, the posterior is no Gaussian. So θ is regressed on the summary by
    conditional density estimation: `regress` takes out what is linear, and networks learn the law of what is left. A
    network that predicts the sets that it did not see no better than N(0, I) does, by more than the standard error of
    the difference, is left at N(0, I). Of `SCALES` the one is taken at which credible sets that are cut to the box
    hold their share of the truths: those of the average of the networks, which is wider than each where they differ,
    for sets that one of them and the regression have not seen.

    Returns the readout, the credible levels of the truths of these sets, the first ones, and how many updates were
    skipped because loss or gradient was not finite.

    Source: Blum and François 2010; Papamakarios and Murray 2016
    """
    fit_key, level_key = jax.random.split(key)
    n, d = truths.shape
    part = FOLDS * jnp.arange(n) // n
    moments = jax.vmap(_moments)(evidence)
    readout = replace(
        Readout.none(d),
        recalibration=regress(evidence, truths, (part >= MEMBERS).astype(truths.dtype)),
        origin=moments.mean(0),
        unit=moments.std(0) + 1e-6,
    )

    def standardize(evidence: GaussianMixture, truth: Array) -> Array:
        mean, tril = readout.correct(evidence)
        return jnp.clip(solve_lower(tril, truth - mean), -FARTHEST, FARTHEST)

    x, left = jax.vmap(readout.read)(evidence), jax.vmap(standardize)(evidence, truths)
    schedule = Schedule(
        epochs=60,
        draws=n,
        batch=min(64, n),
        check_every=2,
        patience=20,
        validation_draws=max(n // FOLDS, 1),
        weight_decay=1e-3,
    )

    def member(args: Any) -> Any:
        key, unseen, nothing = args
        start = HEAD.init(key, x.shape[1], d)
        start |= {"out": 0.1 * start["out"]}
        params, info = fit(key, start, HEAD.log_prob, x, left, jnp.ones(n), unseen, schedule)
        gain = HEAD.log_prob(params, x, left) - HEAD.log_prob(nothing, x, left)
        count = unseen.sum()
        mean = jnp.where(unseen, gain, 0.0).sum() / count
        variance = jnp.where(unseen, (gain - mean) ** 2, 0.0).sum() / count
        better = mean > jnp.sqrt(variance / count)
        return jax.tree.map(lambda a, b: jnp.where(better, a, b), params, nothing), info.nonfinite

    unseen = part == jnp.arange(MEMBERS)[:, None]
    params, skipped = jax.lax.map(member, (jax.random.split(fit_key, MEMBERS), unseen, readout.params))
    readout = replace(readout, params=params)

    held = -(-n * MEMBERS // FOLDS)
    sets, z = jax.tree.map(lambda leaf: leaf[:held], (evidence, truths))
    levels = credible_levels(level_key, jax.vmap(readout.apply)(sets), z, low, high, jnp.array(SCALES))
    best = best_scale(levels, jnp.ones(held))
    return replace(readout, scale=jnp.array(SCALES)[best]), levels[:, best], skipped.sum()


def _moments(evidence: GaussianMixture) -> Float[Array, " features"]:
    """Mean, logarithms of L's diagonal, and what is below it in units of it."""
    mean, tril = evidence.means[0], evidence.scale_trils[0]
    rows, columns = jnp.tril_indices(mean.size, -1)
    diagonal = jnp.diagonal(tril)
    return jnp.concatenate([mean, jnp.log(diagonal), tril[rows, columns] / diagonal[rows]])
