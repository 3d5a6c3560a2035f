"""How often posteriors hold the truth, on simulated sets that no network has seen, and what is done about it."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray
from scipy.special import chdtr, chdtri

from bayessim_jax.beliefs import GaussianMixture, moment_match
from bayessim_jax.beliefs.triangular import invert, solve_lower, solve_positive
from bayessim_jax.chance import draw
from bayessim_jax.contracts import Scalar

__all__ = [
    "LEVELS",
    "SCALES",
    "CalibrationInfo",
    "Recalibration",
    "best_scale",
    "by_number",
    "credible_levels",
    "judge",
    "nearness",
    "recalibrate",
    "regress",
]

SCALES = tuple(2.5 ** (k / 12) for k in range(-12, 13))
"""Factors on the standard deviations of a recalibrated posterior among which its coverage chooses."""
LEVELS = tuple(k / 20 for k in range(1, 20))
"""Credible levels at which coverage is looked at."""


@struct.dataclass
class CalibrationInfo:
    """How the posterior of simulated sets did, before it was recalibrated and after."""

    coverage90_network: Scalar
    """Share of truths inside the 90 % credible set of the networks' posterior, before recalibration."""
    coverage50: Scalar
    """The same for 50 % sets after recalibration, each half of the sets corrected by a regression on the other half."""
    coverage90: Scalar
    """And for 90 % sets."""
    widen: Scalar
    """Factor on the posterior's standard deviations (geometric mean over axes) that recalibration asked for."""
    overconfident: Bool[Array, ""]
    """The recalibrated 90 % sets hold so few truths that chance does not explain it (five standard errors)."""
    collapsed: Bool[Array, ""]
    """The networks' 90 % sets hold fewer truths than those of a Gaussian with half the standard deviations it should
    have, by more than chance (three standard errors): most of the evidence that they see is not there."""
    nonfinite: Int[Array, ""]
    """Updates of the networks that read sets which were skipped because loss or gradient was not finite."""


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
        """θ ↦ μ + L (shift + stretch L⁻¹ (θ − μ))."""
        mean, tril = moment_match(mixture)
        inverse = invert(tril)
        linear = tril @ self.stretch @ inverse
        return GaussianMixture(
            mixture.log_weights,
            mean + tril @ self.shift(mean) + (mixture.means - mean) @ linear.T,
            linear @ mixture.scale_trils,
        )

    def _features(self, mean: Float[Array, " d"]) -> Float[Array, " 1+d"]:
        return jnp.concatenate([jnp.ones(1), jnp.clip((mean - self.origin) / self.unit, -3.0, 3.0)])


def nearness(mixtures: GaussianMixture, observed: GaussianMixture, share: float = 0.5) -> Float[Array, " n"]:
    """Weights of simulated posteriors by how near their means lie to that of what was observed, Σ w = (Σ w)² / Σ w².

    Epanechnikov's kernel max(0, 1 − ‖μᵢ − μ‖²/h²), with h the distance within which a `share` of them lie. Networks are
    worse far from where most simulations are; what they get wrong there says nothing about the posterior at hand.

    Source: Rodrigues et al. 2018
    """
    gaps = ((jax.vmap(GaussianMixture.mean)(mixtures) - observed.mean()) ** 2).sum(-1)
    reach = jnp.sort(gaps)[int(share * (gaps.size - 1))]
    weights = jnp.maximum(1.0 - gaps / jnp.maximum(reach, 1e-12), 0.0)
    return by_number(jnp.where(weights.sum() > 0, weights, 1.0))


def by_number(weights: Float[Array, " n"]) -> Float[Array, " n"]:
    """The same weights scaled so that their sum is the number of pairs that they stand for, Σ w = (Σ w)² / Σ w²."""
    return weights * weights.sum() / jnp.maximum((weights**2).sum(), 1e-12)


def regress(
    mixtures: GaussianMixture, truths: Float[Array, "n d"], weights: Float[Array, " n"], pseudo: float = 3.0
) -> Recalibration:
    """The shift and the stretch that fit held-out truths to their posteriors; a weight of 0 leaves a pair out.

    r = L⁻¹ (θ − μ) of a calibrated posterior has mean zero and covariance I wherever μ is. The shift is the regression
    of r on μ, with bounded residuals and shrunk by `pseudo` observations: it takes out what the networks get wrong as
    a function of θ. The stretch is the root of the covariance of what is left, shrunk towards isotropy, with the
    error of the regression added. Where this says nothing sound, nothing is corrected.

    Source: Blum and François 2010
    """

    def whiten(mixture: GaussianMixture, truth: Array) -> tuple[Array, Array]:
        mean, tril = moment_match(mixture)
        return mean, solve_lower(tril, truth - mean)

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
        solved = solve_positive(ridge, jnp.concatenate([(x * w[:, None]).T @ r, gram], axis=1))
        slopes = solved[:, : r.shape[1]]
        return slopes, r - x @ slopes, jnp.trace(solved[:, r.shape[1] :])

    _, left, _ = solve(weights)
    spread = jnp.sqrt((share * left**2).sum(0))
    bound = jnp.minimum(1.0, 3.0 * jnp.sqrt(d) / jnp.maximum(jnp.linalg.norm(left / spread, axis=-1), 1e-6))
    slopes, left, freedom = solve(weights * bound)
    covariance = (left * (weights * bound)[:, None]).T @ left / n
    shape = (n * covariance + 10.0 * jnp.trace(covariance) / d * jnp.eye(d)) / (n + 10.0)
    tril = jnp.linalg.cholesky(shape + 1e-6 * jnp.eye(d))
    stretch = jnp.sqrt((n + freedom) / (n - freedom)) * tril
    found = replace(where, slopes=slopes, stretch=stretch)
    sound = jnp.isfinite(slopes).all() & jnp.isfinite(stretch).all()
    return jax.tree.map(lambda a, b: jnp.where(sound, a, b), found, plain)


def recalibrate(
    key: PRNGKeyArray,
    mixtures: GaussianMixture,
    truths: Float[Array, "n d"],
    weights: Float[Array, " n"],
    low: Float[Array, " d"],
    high: Float[Array, " d"],
) -> tuple[Recalibration, Float[Array, " n"]]:
    """The correction that makes held-out truths look like draws of their posteriors, and the levels that show it.

    `regress` on all pairs, and of `SCALES` the factor on its stretch at which the credible levels c of the truths, in
    posteriors cut to the box, are nearest to uniform (`best_scale`). Second moments alone do not say that: a sharp core
    with wide tails, and what the box cuts off, change the mass of a set. The factor is chosen, and the levels returned
    are taken, on each half of the pairs with the regression on the other.
    """
    even = jnp.arange(truths.shape[0]) % 2 == 0
    parts = jnp.stack([weights, jnp.where(even, 0.0, weights), jnp.where(even, weights, 0.0)])
    found = jax.vmap(regress, (None, None, 0))(mixtures, truths, parts)
    whole = jax.tree.map(lambda leaf: leaf[0], found)
    other = jax.tree.map(lambda leaf: leaf[jnp.where(even, 1, 2)], found)
    crossed = jax.vmap(lambda correction, mixture: correction.apply(mixture))(other, mixtures)
    levels = credible_levels(key, crossed, truths, low, high, jnp.array(SCALES))
    best = best_scale(levels, weights)
    return replace(whole, stretch=jnp.array(SCALES)[best] * whole.stretch), levels[:, best]


def best_scale(levels: Float[Array, "n scales"], weights: Float[Array, " n"]) -> Int[Array, ""]:
    """Which column of credible levels c is nearest to uniform: the least Σₐ (P(c ≤ a) − a)² / (a (1 − a)).

    Source: Anderson and Darling 1952
    """
    asked = jnp.array(LEVELS)
    covered = jnp.einsum("n,nsa->sa", weights / weights.sum(), levels[..., None] <= asked)
    return jnp.argmin(((covered - asked) ** 2 / (asked * (1 - asked))).sum(-1))


def credible_levels(
    key: PRNGKeyArray,
    mixtures: GaussianMixture,
    truths: Float[Array, "n d"],
    low: Float[Array, " d"],
    high: Float[Array, " d"],
    scales: Float[Array, " scales"],
    draws: int = 64,
) -> Float[Array, "n scales"]:
    """Smallest highest-density credible level that holds the truth; uniform if calibrated.

    For each factor on the standard deviations of the whole mixture, its mean kept. The mixtures are cut to the box from
    `low` to `high`; the level is estimated from the draws that fall in it, the same ones for every factor.
    """

    def one(uniform: Array, mixture: GaussianMixture, truth: Array) -> Array:
        samples = jax.vmap(mixture.made_of)(uniform)
        densities, mean = jax.vmap(mixture.log_prob)(samples), mixture.mean()

        def at(scale: Scalar) -> Scalar:
            moved = mean + scale * (samples - mean)
            inside = ((moved >= low) & (moved <= high)).all(-1)
            denser = densities > mixture.log_prob(mean + (truth - mean) / scale)
            return (denser & inside).sum() / jnp.maximum(inside.sum(), 1)

        return jax.vmap(at)(scales)

    n, d = truths.shape
    return jax.vmap(one)(draw(key, (n, draws, 1 + d), truths.dtype), mixtures, truths)


def judge(
    before: Float[Array, " n"],
    after: Float[Array, " n"],
    weights: Float[Array, " n"],
    d: int,
    widen: Scalar,
    nonfinite: Int[Array, ""] | int = 0,
) -> CalibrationInfo:
    """What the credible levels of n truths say, before and after recalibration; Σ w = (Σ w)² / Σ w²."""
    share, count = weights / weights.sum(), weights.sum()
    network, coverage90 = share @ (before <= 0.9), share @ (after <= 0.9)
    halved = chdtr(d, chdtri(d, 0.1) / 4)  # P(χ² ≤ a/4) where P(χ² ≤ a) = 0.9
    return CalibrationInfo(
        coverage90_network=network,
        coverage50=share @ (after <= 0.5),
        coverage90=coverage90,
        widen=widen,
        overconfident=coverage90 < 0.9 - 5.0 * jnp.sqrt(0.09 / count),
        collapsed=network < halved - 3.0 * jnp.sqrt(halved * (1.0 - halved) / count),
        nonfinite=jnp.array(nonfinite),
    )
