"""Evidence of several recordings, and recalibration of what came of it."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from bayessim_jax.beliefs import GaussianMixture, moment_match
from bayessim_jax.contracts import Scalar

__all__ = ["INFLATIONS", "Recalibration", "combine_evidence", "credible_level", "inflate", "recalibrate", "regress"]

INFLATIONS = (1.0, 1.1, 1.2, 1.35, 1.5, 1.75, 2.0, 2.5)
"""By how much a recalibrated posterior may be widened at the end."""


def combine_evidence(each: GaussianMixture, use: Bool[Array, " set"]) -> GaussianMixture:
    """One Gaussian from the posteriors of single recordings, under a proposal of mean 0 and variance 1 on every axis.

    What recording i adds to the proposal is Jᵢ = Λᵢ − I and hᵢ = Λᵢ μᵢ, from the moments of its posterior; directions
    in which it would add negative precision are left out. The product of the evidence is

        Λ = I + Σ Jᵢ,   μ = Λ⁻¹ Σ hᵢ

    Evidence adds up; posteriors are neither averaged nor multiplied with the proposal counted more than once.
    """

    def evidence(mixture: GaussianMixture) -> tuple[Array, Array]:
        mean, tril = moment_match(mixture)
        precision = jax.scipy.linalg.cho_solve((tril, True), jnp.eye(mean.size))
        values, axes = jnp.linalg.eigh(precision)
        added = jnp.maximum(values - 1.0, 0.0)
        weighed = jnp.where(added > 0, values * (axes.T @ mean), 0.0)
        return (axes * added) @ axes.T, axes @ weighed

    j, h = jax.vmap(evidence)(each)
    precision = jnp.eye(h.shape[-1]) + jnp.where(use[:, None, None], j, 0.0).sum(0)
    covariance = jnp.linalg.inv(precision)
    mean = covariance @ jnp.where(use[:, None], h, 0.0).sum(0)
    return GaussianMixture(jnp.zeros(1), mean[None], jnp.linalg.cholesky(covariance)[None])


@struct.dataclass
class Recalibration:
    """A correction of a posterior in the coordinates that its own moments whiten: a shift, a stretch, an inflation.

    The shift is linear in where the posterior sits, shift = (1, x) · slopes with x = (mean − origin)/unit, |x| ≤ 3.
    """

    origin: Float[Array, " d"]
    unit: Float[Array, " d"]
    slopes: Float[Array, "1+d d"]
    stretch: Float[Array, "d d"]
    """Lower triangular."""
    inflation: Scalar
    """Standard deviations after over before the last step, which adds to the covariance of every component."""

    @classmethod
    def none(cls, d: int) -> Recalibration:
        """The identity."""
        return cls(jnp.zeros(d), jnp.ones(d), jnp.zeros((1 + d, d)), jnp.eye(d), jnp.ones(()))

    def shift(self, mean: Float[Array, " d"]) -> Float[Array, " d"]:
        """By how many of its own standard deviations a posterior with this mean is off."""
        return self._features(mean) @ self.slopes

    def apply(self, mixture: GaussianMixture) -> GaussianMixture:
        """θ ↦ μ + L (shift + stretch L⁻¹ (θ − μ)), then each Σₖ + (inflation² − 1) S, S the covariance so far."""
        mean, tril = moment_match(mixture)
        inverse = jax.scipy.linalg.solve_triangular(tril, jnp.eye(mean.size), lower=True)
        linear = tril @ self.stretch @ inverse
        moved = GaussianMixture(
            mixture.log_weights,
            mean + tril @ self.shift(mean) + (mixture.means - mean) @ linear.T,
            linear @ mixture.scale_trils,
        )
        return inflate(moved, self.inflation)

    def _features(self, mean: Float[Array, " d"]) -> Float[Array, " 1+d"]:
        return jnp.concatenate([jnp.ones(1), jnp.clip((mean - self.origin) / self.unit, -3.0, 3.0)])


def inflate(mixture: GaussianMixture, factor: Scalar) -> GaussianMixture:
    """Each Σₖ + (factor² − 1) S with S the covariance of the mixture: the whole is wider, its details blurred."""
    _, tril = moment_match(mixture)
    parts = mixture.scale_trils @ jnp.swapaxes(mixture.scale_trils, -1, -2)
    return replace(mixture, scale_trils=jnp.linalg.cholesky(parts + (factor**2 - 1.0) * (tril @ tril.T)))


def regress(
    mixtures: GaussianMixture, truths: Float[Array, "n d"], weights: Float[Array, " n"], pseudo: float = 3.0
) -> Recalibration:
    """The shift and the stretch that fit held-out truths to their posteriors; a weight of 0 leaves a pair out.

    r = L⁻¹ (θ − μ) of a calibrated posterior has mean zero and covariance I wherever μ is. The shift is the regression
    of r on μ, with bounded residuals and shrunk by `pseudo` observations: it takes out what the networks get wrong as
    a function of θ. The stretch is the root of the covariance of what is left, shrunk towards isotropy, with the
    error of the regression added. It never narrows on the whole: a mixture with a sharp core and wide tails has small
    residuals without being too wide.

    Source: Blum and François 2010
    """

    def whiten(mixture: GaussianMixture, truth: Array) -> tuple[Array, Array]:
        mean, tril = moment_match(mixture)
        return mean, jax.scipy.linalg.solve_triangular(tril, truth - mean, lower=True)

    d, n = truths.shape[1], weights.sum()
    means, r = jax.vmap(whiten)(mixtures, truths)
    r = jnp.clip(r, -50.0, 50.0)
    share = weights[:, None] / n
    origin = (share * means).sum(0)
    unit = jnp.sqrt((share * (means - origin) ** 2).sum(0)) + 1e-6
    plain = Recalibration.none(d)
    where = replace(plain, origin=origin, unit=unit)
    x = jax.vmap(where._features)(means)

    def solve(w: Array) -> tuple[Array, Array, Array]:
        gram = (x * w[:, None]).T @ x
        ridge = gram + pseudo * jnp.eye(1 + d)
        slopes = jnp.linalg.solve(ridge, (x * w[:, None]).T @ r)
        return slopes, r - x @ slopes, jnp.trace(jnp.linalg.solve(ridge, gram))

    _, left, _ = solve(weights)
    spread = jnp.sqrt((share * left**2).sum(0))
    bound = jnp.minimum(1.0, 3.0 * jnp.sqrt(d) / jnp.maximum(jnp.linalg.norm(left / spread, axis=-1), 1e-6))
    slopes, left, freedom = solve(weights * bound)
    covariance = (left * (weights * bound)[:, None]).T @ left / n
    shape = (n * covariance + 10.0 * jnp.trace(covariance) / d * jnp.eye(d)) / (n + 10.0)
    tril = jnp.linalg.cholesky(shape + 1e-6 * jnp.eye(d))
    stretch = jnp.sqrt((n + freedom) / (n - freedom)) * tril
    stretch = stretch / jnp.minimum(1.0, jnp.exp(jnp.log(jnp.diagonal(stretch)).mean()))
    found = replace(where, slopes=slopes, stretch=stretch)
    sound = jnp.isfinite(slopes).all() & jnp.isfinite(stretch).all()
    return jax.tree.map(lambda a, b: jnp.where(sound, a, b), found, plain)


def recalibrate(
    key: PRNGKeyArray,
    mixtures: GaussianMixture,
    truths: Float[Array, "n d"],
    low: Float[Array, " d"],
    high: Float[Array, " d"],
) -> tuple[Recalibration, Float[Array, " n"]]:
    """The correction that makes held-out truths look like draws of their posteriors, and the levels that show it.

    `regress` on all pairs, then the least inflation of `INFLATIONS` at which the 50 % and the 90 % sets, cut to the
    box, hold at least their share of the truths. It is chosen, and the credible levels returned are taken, on each half
    of the pairs with the regression on the other half.
    """
    n = truths.shape[0]
    even = jnp.arange(n) % 2 == 0
    parts = jnp.stack([jnp.ones(n), ~even, even]).astype(float)
    found = jax.vmap(regress, (None, None, 0))(mixtures, truths, parts)
    whole = jax.tree.map(lambda leaf: leaf[0], found)
    other = jax.tree.map(lambda leaf: leaf[jnp.where(even, 1, 2)], found)
    crossed = jax.vmap(lambda correction, mixture: correction.apply(mixture))(other, mixtures)
    factors = jnp.array(INFLATIONS)
    levels = jax.lax.map(
        lambda factor: credible_level(key, jax.vmap(inflate, (0, None))(crossed, factor), truths, low, high), factors
    )
    enough = ((levels <= 0.5).mean(-1) >= 0.5) & ((levels <= 0.9).mean(-1) >= 0.9)
    least = jnp.where(enough.any(), jnp.argmax(enough), factors.size - 1)
    return replace(whole, inflation=factors[least]), levels[least]


def credible_level(
    key: PRNGKeyArray,
    mixtures: GaussianMixture,
    truths: Float[Array, "n d"],
    low: Float[Array, " d"],
    high: Float[Array, " d"],
    draws: int = 64,
) -> Float[Array, " n"]:
    """Smallest highest-density credible level that holds the truth; uniform if calibrated.

    The mixtures are cut to the box from `low` to `high`; the level is estimated from the draws that fall in it.
    """

    def one(key: PRNGKeyArray, mixture: GaussianMixture, truth: Array) -> Scalar:
        samples = jax.vmap(mixture.sample)(jax.random.split(key, draws))
        inside = ((samples >= low) & (samples <= high)).all(-1)
        denser = jax.vmap(mixture.log_prob)(samples) > mixture.log_prob(truth)
        return (denser & inside).sum() / jnp.maximum(inside.sum(), 1)

    return jax.vmap(one)(jax.random.split(key, truths.shape[0]), mixtures, truths)
