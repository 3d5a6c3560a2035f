"""Evidence of several recordings, and recalibration of what came of it."""

from __future__ import annotations

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
    """A correction of a posterior in the coordinates that its own moments whiten: a shift and a factor."""

    shift: Float[Array, " d"]
    widen: Scalar

    def apply(self, mixture: GaussianMixture) -> GaussianMixture:
        """Move the whole by L · shift, and stretch it about its mean by `widen`; L Lᵀ is its covariance."""
        mean, tril = moment_match(mixture)
        return GaussianMixture(
            mixture.log_weights,
            mean + tril @ self.shift + self.widen * (mixture.means - mean),
            self.widen * mixture.scale_trils,
        )


def recalibrate(mixtures: GaussianMixture, truths: Float[Array, "n d"], count: Scalar) -> Recalibration:
    """The correction that makes held-out truths look like draws of their posteriors.

    r = L⁻¹ (θ − μ) of a calibrated posterior has mean zero, and ‖r‖² has the quantiles of χ²(d). The shift is the mean
    of r, shrunk by ten pseudo-observations at zero; the factor is the geometric mean of the ratios of the quantiles at
    50 % and 90 %, shrunk likewise towards one, and covers the error of the shift. `count` is the effective number of
    truths.
    """

    def whiten(mixture: GaussianMixture, truth: Array) -> Array:
        mean, tril = moment_match(mixture)
        return jax.scipy.linalg.solve_triangular(tril, truth - mean, lower=True)

    d = truths.shape[-1]
    r = jnp.clip(jax.vmap(whiten)(mixtures, truths), -5.0, 5.0)
    trust = count / (count + 10.0)
    shift = trust * r.mean(0)
    squared = ((r - shift) ** 2).sum(-1)
    levels = jnp.array([0.5, 0.9])
    log_ratio = 0.5 * (jnp.log(jnp.quantile(squared, levels)) - jnp.log(_chi2_quantile(levels, d))).mean()
    widen = jnp.exp(trust * log_ratio) * jnp.sqrt(1.0 + trust / jnp.maximum(count, 1.0))
    sound = jnp.isfinite(widen) & jnp.isfinite(shift).all()
    return Recalibration(jnp.where(sound, shift, 0.0), jnp.where(sound, widen, 1.0))


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
