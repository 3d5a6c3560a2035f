"""The belief of the outer loop: a Gaussian mixture cut to the prior's box, with a share of the prior kept."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float, PRNGKeyArray

from bayessim_jax.beliefs.algebra import reduce
from bayessim_jax.beliefs.box_probability import box_probability, condition, lattice
from bayessim_jax.beliefs.mixture import GaussianMixture
from bayessim_jax.beliefs.triangular import factor, log_normal, solve_lower, solve_positive
from bayessim_jax.chance import pick
from bayessim_jax.contracts import Box, Scalar

__all__ = ["Truncated"]

_CANDIDATES = 32
_POINTS = 1024
_LEAST = -80.0
"""The log of the least mass in the box that a merged component is taken to have."""


@struct.dataclass
class Truncated:
    """p(θ) = s U(θ; box) + (1 − s) q(θ) 1[θ ∈ box] / ∫_box q, with q a Gaussian mixture and s the prior's share.

    With s = 1 it is the uniform prior: prior, proposal and posterior are one type and one scan carry. Make one with
    `uniform` or `create`: what is integrated over the box is computed once, there, on 1024 quasi-random points for each
    component.
    """

    mixture: GaussianMixture
    box: Box
    prior_share: Scalar
    log_shares: Float[Array, " components"]
    """For each component the log of αₖ Zₖ, with Zₖ its mass in the box."""
    center: Float[Array, " d"]
    scatter: Float[Array, "d d"]
    """Mean and covariance of p, which are not those of the mixture where it leaves the box."""

    @classmethod
    def uniform(cls, box: Box, components: int) -> Truncated:
        """The uniform prior on the box, in the shape of a posterior with that many components."""
        mixture = _idle(box, components)
        within = box.size * math.log(math.erf(math.sqrt(1.5)))  # of N(0, 1) on ±√3, axis by axis
        return cls(
            mixture,
            box,
            jnp.ones((), box.low.dtype),
            jax.nn.log_softmax(mixture.log_weights) + within,
            0.5 * (box.low + box.high),
            jnp.diag(box.width**2 / 12),
        )

    @classmethod
    def create(cls, mixture: GaussianMixture, box: Box, prior_share: float | Scalar = 0.0) -> Truncated:
        """Cut a mixture to the box. One with no representable mass in it gives the prior, told by `prior_share` = 1."""
        log_each, fractions = _spread(mixture, box)
        log_points = jax.nn.log_softmax(mixture.log_weights)[:, None] + log_each
        log_shares = jax.nn.logsumexp(log_points, axis=1) - jnp.log(float(_POINTS))

        share, safe = jnp.asarray(prior_share, box.low.dtype), cls.uniform(box, mixture.log_weights.size)
        weights, theta = jax.nn.softmax(log_points.ravel()), box.low + fractions.reshape(-1, box.size) * box.width
        center = share * safe.center + (1 - share) * weights @ theta
        cut = jnp.einsum("n,ni,nj->ij", weights, theta - center, theta - center)
        gap = safe.center - center
        scatter = share * (safe.scatter + jnp.outer(gap, gap)) + (1 - share) * cut

        sound = jnp.isfinite(jax.nn.logsumexp(log_shares))
        for leaf in jax.tree.leaves(mixture):
            sound &= ~jnp.isnan(leaf).any()
        whole = cls(mixture, box, share, log_shares, center, scatter)
        return jax.tree.map(lambda a, b: jnp.where(sound, a, b), whole, safe)

    def log_mass(self) -> Scalar:
        """The log of ∫_box q(θ) dθ: how much of the mixture the box holds."""
        return jax.nn.logsumexp(self.log_shares)

    def sample(self, key: PRNGKeyArray) -> Float[Array, " d"]:
        """One draw of θ, strictly inside the box and without atoms on its bounds.

        A component is chosen by αₖ Zₖ, then θ is drawn axis by axis from the conditionals cut to the box; one of 32
        candidates on a randomly shifted lattice is kept by its weight, which corrects the order of the axes.

        Source: Genz 1992
        """
        d, low, high = self.box.size, self.box.low, self.box.high
        draws = jax.random.uniform(key, (2 * d + 3,), low.dtype)
        shift, flat, (which, kept, share) = draws[:d], draws[d : 2 * d], draws[2 * d :]
        index = pick(which, self.log_shares)
        edge = jnp.finfo(low.dtype).eps
        u = jnp.mod(lattice(_CANDIDATES if d > 1 else 1, d) + shift, 1.0).clip(edge, 1 - edge)
        mean, scale_tril = self.mixture.means[index], self.mixture.scale_trils[index]
        log_weights, fractions = jax.vmap(lambda v: condition(mean, scale_tril, low, high, v))(u)
        fraction = jnp.where(share < self.prior_share, flat, fractions[pick(kept, log_weights)])
        return jnp.clip(low + fraction * self.box.width, jnp.nextafter(low, high), jnp.nextafter(high, low))

    def log_prob(self, theta: Float[Array, " d"]) -> Scalar:
        """Normalized log density in raw units; −∞ outside the box."""
        cut = self.mixture.log_prob(theta) - self.log_mass()
        flat = -jnp.log(self.box.width).sum()
        return jnp.where(self.box.contains(theta), self._blend(flat, cut), -jnp.inf)

    def mean(self) -> Float[Array, " d"]:
        """E θ of the truncated law."""
        return self.center

    def covariance(self) -> Float[Array, "d d"]:
        """Cov θ of the truncated law."""
        return self.scatter

    def against(self, before: Truncated) -> tuple[Scalar, Scalar]:
        """The log of its volume over an earlier belief's, and the squared distance of their means in its own widths."""
        after, gap = self.covariance(), self.mean() - before.mean()
        log_ratio = 0.5 * (jnp.linalg.slogdet(after)[1] - jnp.linalg.slogdet(before.covariance())[1])
        return log_ratio, gap @ solve_positive(after, gap[:, None])[:, 0]

    def mix(self, other: Truncated, share: float | Scalar) -> Truncated:
        """(1 − share) p + share p′, p′ the other belief on the same box, in as many components as this one has.

        Those that lie nearest each other are merged, weighed by their mass in the box, which stays theirs.

        Source: Stone 1961
        """

        def part(belief: Truncated, weight: float | Scalar) -> GaussianMixture:
            inside = belief.log_shares - belief.log_mass()
            return replace(belief.mixture, log_weights=inside + _log(weight * (1 - belief.prior_share)))

        gap = other.center - self.center
        between = share * (1 - share) * jnp.outer(gap, gap)
        both = jax.tree.map(lambda *x: jnp.concatenate(x), part(self, 1 - share), part(other, share))
        merged = reduce(both, self.log_shares.size)
        held = jax.nn.logsumexp(_spread(merged, self.box)[0], axis=1) - jnp.log(float(_POINTS))
        log_weights = merged.log_weights - jnp.maximum(held, _LEAST)
        total = jax.nn.logsumexp(log_weights)
        return Truncated(
            replace(merged, log_weights=log_weights - total),
            self.box,
            (1 - share) * self.prior_share + share * other.prior_share,
            merged.log_weights - total,
            self.center + share * gap,
            (1 - share) * self.scatter + share * other.scatter + between,
        )

    def loosen(self, share: float | Scalar) -> Truncated:
        """(1 − share) p + share U(θ; box): θ may have been drawn anew from the prior, with that probability."""
        flat = Truncated.uniform(self.box, self.log_shares.size)
        gap = flat.center - self.center
        between = share * (1 - share) * jnp.outer(gap, gap)
        return replace(
            self,
            prior_share=self.prior_share + share * (1 - self.prior_share),
            center=self.center + share * gap,
            scatter=(1 - share) * self.scatter + share * flat.scatter + between,
        )

    def components(self) -> GaussianMixture:
        """A Gaussian for each component, with the mass, mean and covariance of its part in the box.

        The prior's share is left out, unless it is everything.
        """
        log_each, fractions = _spread(self.mixture, self.box)
        inside = self.box.low + fractions * self.box.width
        weights = jax.nn.softmax(log_each, axis=1)[..., None]
        means = (weights * inside).sum(1)
        trils = jax.vmap(factor)(jnp.swapaxes(jnp.sqrt(weights) * (inside - means[:, None]), 1, 2))
        flat = GaussianMixture(
            self.log_shares,
            jnp.broadcast_to(self.center, means.shape),
            jnp.broadcast_to(jnp.linalg.cholesky(self.scatter), trils.shape),
        )
        cut = GaussianMixture(self.log_shares, means, trils)
        return jax.tree.map(lambda a, b: jnp.where(self.prior_share >= 1.0, a, b), flat, cut)

    def marginal_log_prob(self, axes: Sequence[int], points: Float[Array, "n axes"]) -> Float[Array, " n"]:
        """Log density of some axes of θ at n points, in raw units; −∞ outside the box.

        p(θ_A = g) ∝ Σₖ αₖ N(g; μₖ_A, Σₖ_AA) P(the other axes lie in the box | θ_A = g).
        """
        first = len(axes)
        order = jnp.array([*axes, *(j for j in range(self.box.size) if j not in axes)])
        low, high = self.box.low[order], self.box.high[order]
        means = self.mixture.means[:, order]
        trils = jax.vmap(factor)(self.mixture.scale_trils[:, order])

        def unnormalized(g: Float[Array, " axes"]) -> Scalar:
            centred, own = g - means[:, :first], trils[:, :first, :first]
            logs = jax.nn.log_softmax(self.mixture.log_weights) + jax.vmap(log_normal)(centred, own)
            if self.box.size > first:
                moved = jnp.einsum("kij,kj->ki", trils[:, first:, :first], jax.vmap(solve_lower)(own, centred))
                rest = means[:, first:] + moved
                logs = logs + box_probability(rest, trils[:, first:, first:], low[first:], high[first:])
            return jax.nn.logsumexp(logs)

        cut = jax.vmap(unnormalized)(points) - self.log_mass()
        inside = ((points >= low[:first]) & (points <= high[:first])).all(-1)
        return jnp.where(inside, self._blend(-jnp.log((high - low)[:first]).sum(), cut), -jnp.inf)

    def _blend(self, flat: Scalar, cut: Float[Array, "..."]) -> Float[Array, "..."]:
        return jnp.logaddexp(_log(self.prior_share) + flat, _log(1 - self.prior_share) + cut)


def _spread(mixture: GaussianMixture, box: Box) -> tuple[Float[Array, "components n"], Float[Array, "components n d"]]:
    """Points of every component in the box: their log weights, and where they lie between the bounds (0 … 1)."""
    over = jax.vmap(jax.vmap(condition, (None, None, None, None, 0)), (0, 0, None, None, None))
    return over(mixture.means, mixture.scale_trils, box.low, box.high, lattice(_POINTS, box.size))


def _log(share: float | Scalar) -> Scalar:
    """The log of a share, −∞ at zero with a derivative of zero."""
    share = jnp.asarray(share)
    return jnp.where(share > 0, jnp.log(jnp.where(share > 0, share, 1.0)), -jnp.inf)


def _idle(box: Box, components: int) -> GaussianMixture:
    """A mixture with the moments of the uniform law, to fill the place of one that does not exist yet."""
    d, dtype = box.size, box.low.dtype
    return GaussianMixture(
        jnp.zeros(components, dtype),
        jnp.broadcast_to(0.5 * (box.low + box.high), (components, d)),
        jnp.broadcast_to(jnp.diag(box.width / jnp.sqrt(jnp.asarray(12.0, dtype))), (components, d, d)),
    )
