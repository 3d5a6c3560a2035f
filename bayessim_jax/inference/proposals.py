"""Proposals: where to simulate next, and how what was learned there becomes a posterior.

All three obey Bayes' rule for new, independent recordings X when the network is perfect,

    p(θ | X, before) ∝ q(θ | X) p(θ | before) / p̃(θ)

with p̃ the proposal that q was trained on. They differ in p̃, in how they divide by it, and in which simulations of
earlier rounds they can use again.
"""

from __future__ import annotations

import difflib
from typing import Any, Protocol

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

from bayessim_jax.beliefs import GaussianMixture, Truncated, Uniform, moment_match, product, quotient, reduce
from bayessim_jax.contracts import Belief, Box

__all__ = ["PROPOSALS", "Corrected", "Paper", "ProposalMode", "TruncatedPrior", "lookup_proposal", "pool_weights"]


class ProposalMode(Protocol):
    """Chooses where to simulate, and combines the network's answer with the belief so far."""

    reuse: bool
    """Whether simulations of earlier rounds are used again, weighted by `pool_weights`."""

    def propose(self, belief: Truncated) -> Any:
        """The proposal of this round: a belief whose type never changes."""
        ...

    def combine(self, belief: Truncated, proposal: Any, q: GaussianMixture) -> Truncated:
        """The posterior after this round's recordings."""
        ...


@struct.dataclass
class Paper:
    """Algorithm 1 taken literally: simulate from the last posterior, and let q replace it.

    p̃ is the belief, so it cancels. Only this round's simulations are usable, and a posterior that is too narrow
    becomes the next proposal.

    Source: Possas et al. 2020
    """

    reuse: bool = struct.field(pytree_node=False, default=False)

    def propose(self, belief: Truncated) -> Truncated:
        """The belief itself."""
        return belief

    def combine(self, belief: Truncated, proposal: Truncated, q: GaussianMixture) -> Truncated:
        """The network's answer."""
        return Truncated.create(q, belief.box)


@struct.dataclass
class Corrected:
    """Simulate from one Gaussian, the belief's moments widened, and divide it out.

    p̃ = N(m, c² S) on the prior's box, m and S the moments of the belief. Each component of the belief is narrower than
    p̃ in every direction, so the quotient exists for each of them, is exact, and its product with q is a mixture of K²
    Gaussians, merged to K.

    Source: Papamakarios and Murray 2016
    """

    widening: float | Array = 2.0
    """c: standard deviations of the proposal over those of the belief."""
    reuse: bool = struct.field(pytree_node=False, default=True)

    def propose(self, belief: Truncated) -> Truncated:
        """The widened Gaussian; the prior itself while the belief is the prior."""
        mean, scale_tril = moment_match(belief.mixture)
        wide = GaussianMixture(jnp.zeros(1), mean[None], self.widening * scale_tril[None])
        return Truncated(wide, belief.box, belief.prior_share)

    def combine(self, belief: Truncated, proposal: Truncated, q: GaussianMixture) -> Truncated:
        """(belief / p̃) · q, merged to the number of components of q."""
        fresh, _ = quotient(belief.mixture, proposal.mixture.means[0], proposal.mixture.scale_trils[0])
        return _unless_prior(belief, q, product(fresh, q))


@struct.dataclass
class TruncatedPrior:
    """Simulate from the prior cut to a box around the belief, and multiply.

    p̃ is constant on the box, so nothing is divided out and simulations of all rounds that fall in it are alike.

    Source: Deistler et al. 2022
    """

    reach: float | Array = 5.0
    """Half the box, in standard deviations of the belief."""
    reuse: bool = struct.field(pytree_node=False, default=True)

    def propose(self, belief: Truncated) -> Uniform:
        """The prior on mean ± reach · sd."""
        mean, sd = belief.mean(), jnp.sqrt(jnp.diagonal(belief.covariance()))
        low = jnp.maximum(belief.box.low, mean - self.reach * sd)
        high = jnp.minimum(belief.box.high, mean + self.reach * sd)
        return Uniform(Box(low, high, belief.box.names, belief.box.units))

    def combine(self, belief: Truncated, proposal: Uniform, q: GaussianMixture) -> Truncated:
        """Belief · q, merged to the number of components of q."""
        return _unless_prior(belief, q, product(belief.mixture, q))


def _unless_prior(belief: Truncated, q: GaussianMixture, combined: GaussianMixture) -> Truncated:
    """Q alone while the belief is the prior, the combined mixture afterwards."""
    merged = reduce(combined, q.log_weights.shape[0])
    first = belief.prior_share > 0.5
    return Truncated.create(jax.tree.map(lambda a, b: jnp.where(first, a, b), q, merged), belief.box)


def pool_weights(
    thetas: Float[Array, "rounds n d"], proposals: Any, filled: Float[Array, " rounds"], target: Belief
) -> Float[Array, "rounds n"]:
    """Weights that make pooled draws of several proposals stand for draws of one, scaled to at most one.

        w = p̃(θ) / (1/R Σᵣ p̃ᵣ(θ))

    The denominator is the mixture of all proposals that filled the pool, so no weight exceeds R. `proposals` is the
    stack of them, `filled[r]` is 1 where round r has been simulated.

    Source: Veach and Guibas 1995
    """
    points = thetas.reshape(-1, thetas.shape[-1])
    log_each = jax.vmap(lambda p: jax.vmap(p.log_prob)(points))(proposals)
    log_filled = jnp.where(filled > 0, 0.0, -jnp.inf)
    log_mixture = jax.nn.logsumexp(log_each + log_filled[:, None], axis=0)
    log_weights = jax.vmap(target.log_prob)(points) - log_mixture
    used = (filled > 0)[:, None] & jnp.isfinite(log_weights).reshape(thetas.shape[:2])
    return jnp.where(used, jnp.exp(jnp.minimum(log_weights, 0.0)).reshape(thetas.shape[:2]), 0.0)


PROPOSALS: dict[str, ProposalMode] = {"corrected": Corrected(), "paper": Paper(), "truncated": TruncatedPrior()}


def lookup_proposal(name: str) -> ProposalMode:
    """Find a proposal mode by name, or raise `ValueError` with the near miss."""
    if name in PROPOSALS:
        return PROPOSALS[name]
    near = difflib.get_close_matches(name, PROPOSALS, n=1, cutoff=0.4)
    hint = f"did you mean {near[0]!r}?" if near else f"choose one of {', '.join(PROPOSALS)}."
    raise ValueError(f"unknown proposal {name!r}: {hint}")
