"""Evidence of several recordings, and recalibration of what came of it."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from bayessim_jax.beliefs import GaussianMixture, moment_match
from bayessim_jax.contracts import Scalar

__all__ = ["Recalibration", "combine_evidence", "credible_level", "recalibrate"]


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
    """A correction of a posterior in the coordinates that its own moments whiten: a shift and a stretch.

    The shift is linear in where the posterior sits, shift = (1, x) · slopes with x = (mean − origin)/unit, |x| ≤ 3.
    """

    origin: Float[Array, " d"]
    unit: Float[Array, " d"]
    slopes: Float[Array, "1+d d"]
    stretch: Float[Array, "d d"]
    """Lower triangular."""

    @classmethod
    def none(cls, d: int) -> Recalibration:
        """The identity."""
        return cls(jnp.zeros(d), jnp.ones(d), jnp.zeros((1 + d, d)), jnp.eye(d))

    def shift(self, mean: Float[Array, " d"]) -> Float[Array, " d"]:
        """By how many of its own standard deviations a posterior with this mean is off."""
        return self._features(mean) @ self.slopes

    def apply(self, mixture: GaussianMixture) -> GaussianMixture:
        """θ ↦ μ + L (shift + stretch L⁻¹ (θ − μ)), with μ and L Lᵀ the mean and covariance of the mixture."""
        mean, tril = moment_match(mixture)
        inverse = jax.scipy.linalg.solve_triangular(tril, jnp.eye(mean.size), lower=True)
        linear = tril @ self.stretch @ inverse
        return GaussianMixture(
            mixture.log_weights,
            mean + tril @ self.shift(mean) + (mixture.means - mean) @ linear.T,
            linear @ mixture.scale_trils,
        )

    def _features(self, mean: Float[Array, " d"]) -> Float[Array, " 1+d"]:
        return jnp.concatenate([jnp.ones(1), jnp.clip((mean - self.origin) / self.unit, -3.0, 3.0)])


def recalibrate(
    mixtures: GaussianMixture, truths: Float[Array, "n d"], weights: Float[Array, " n"], pseudo: float = 3.0
) -> Recalibration:
    """The correction that makes held-out truths look like draws of their posteriors; a weight of 0 leaves a pair out.

    r = L⁻¹ (θ − μ) of a calibrated posterior has mean zero and covariance I wherever μ is, and ‖r‖² has the quantiles
    of χ²(d). The shift is the regression of r on μ, with bounded residuals and shrunk by `pseudo` observations: it
    takes out what the networks get wrong as a function of θ. The stretch has the shape of the covariance of what is
    left, shrunk towards isotropy, and the size at which the quantiles at 50 % and 90 % agree (geometric mean of their
    ratios) with the error of the regression added. It never narrows: a mixture with a sharp core and wide tails has
    small quantiles without being too wide.

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

    def regress(w: Array) -> tuple[Array, Array, Array]:
        gram = (x * w[:, None]).T @ x
        ridge = gram + pseudo * jnp.eye(1 + d)
        slopes = jnp.linalg.solve(ridge, (x * w[:, None]).T @ r)
        return slopes, r - x @ slopes, jnp.trace(jnp.linalg.solve(ridge, gram))

    _, left, _ = regress(weights)
    spread = jnp.sqrt((share * left**2).sum(0))
    bound = jnp.minimum(1.0, 3.0 * jnp.sqrt(d) / jnp.maximum(jnp.linalg.norm(left / spread, axis=-1), 1e-6))
    slopes, left, freedom = regress(weights * bound)
    covariance = (left * (weights * bound)[:, None]).T @ left / n
    shape = (n * covariance + 10.0 * jnp.trace(covariance) / d * jnp.eye(d)) / (n + 10.0)
    tril = jnp.linalg.cholesky(shape + 1e-6 * jnp.eye(d))
    squared = (jax.scipy.linalg.solve_triangular(tril, left.T, lower=True) ** 2).sum(0)
    levels = jnp.array([0.5, 0.9])
    quantiles = jnp.nanquantile(jnp.where(weights > 0, squared, jnp.nan), levels)
    factor = jnp.exp(0.5 * (jnp.log(quantiles) - jnp.log(_chi2_quantile(levels, d))).mean())
    stretch = factor * jnp.sqrt((n + freedom) / (n - freedom)) * tril
    stretch = stretch / jnp.minimum(1.0, jnp.exp(jnp.log(jnp.diagonal(stretch)).mean()))
    found = replace(where, slopes=slopes, stretch=stretch)
    sound = jnp.isfinite(slopes).all() & jnp.isfinite(stretch).all()
    return jax.tree.map(lambda a, b: jnp.where(sound, a, b), found, plain)


def _chi2_quantile(levels: Float[Array, " n"], d: int) -> Float[Array, " n"]:
    """Quantiles of χ²(d) by bisection of the regularized incomplete gamma function."""

    def halve(_: int, bounds: tuple[Array, Array]) -> tuple[Array, Array]:
        low, high = bounds
        middle = 0.5 * (low + high)
        below = jax.scipy.special.gammainc(d / 2, middle / 2) < levels
        return jnp.where(below, middle, low), jnp.where(below, high, middle)

    low, high = jax.lax.fori_loop(0, 40, halve, (jnp.zeros_like(levels), jnp.full_like(levels, 10.0 * d + 20.0)))
    return 0.5 * (low + high)


def credible_level(
    key: PRNGKeyArray, mixtures: GaussianMixture, truths: Float[Array, "n d"], draws: int = 128
) -> Float[Array, " n"]:
    """Smallest highest-density credible level that holds the truth, estimated from draws; uniform if calibrated."""

    def one(key: PRNGKeyArray, mixture: GaussianMixture, truth: Array) -> Scalar:
        samples = jax.vmap(mixture.sample)(jax.random.split(key, draws))
        return (jax.vmap(mixture.log_prob)(samples) > mixture.log_prob(truth)).mean()

    return jax.vmap(one)(jax.random.split(key, truths.shape[0]), mixtures, truths)
