"""Proposals: where to simulate next, and how the network's answer there becomes a posterior.

The network learns q(θ | X) ∝ p̃(θ) p(X | θ) from θ drawn from the proposal p̃. For the prior p the posterior is

    p(θ | X) ∝ q(θ | X) p(θ) / p̃(θ)

The modes differ in p̃, in how they divide by it, in which simulations of earlier rounds they can use again, and in
whether X is every recording so far or this round's alone.
"""

from __future__ import annotations

import math
from typing import Any, Protocol

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float

from bayessim_jax.beliefs import Ellipsoid, GaussianMixture, Truncated, quotient, reduce
from bayessim_jax.contracts import Belief
from bayessim_jax.spelling import find_named

__all__ = ["PROPOSALS", "Corrected", "Paper", "ProposalMode", "TruncatedPrior", "lookup_proposal", "pool_weights"]


class ProposalMode(Protocol):
    """Chooses where to simulate, and combines the network's answer with the belief so far."""

    reuse: bool
    """Whether simulations of earlier rounds are used again, weighted by `pool_weights`."""
    accumulate: bool
    """Whether the posterior is that of all recordings so far, recalibrated, or of this round's alone, as it comes."""

    def propose(self, belief: Truncated) -> Any:
        """The proposal of this round: a belief whose type never changes."""
        ...

    def combine(self, belief: Truncated, proposal: Any, q: GaussianMixture) -> Truncated:
        """The new belief from the network's answer under the proposal."""
        ...


@struct.dataclass
class Paper:
    """Algorithm 1 taken literally: simulate from the last posterior, and let q replace it.

    With p̃ the posterior of the rounds before and X this round's recordings that is Bayes' rule, if the network is
    perfect. Only this round's simulations are usable, and a posterior that is too narrow becomes the next proposal.

    Source: Possas et al. 2020
    """

    reuse: bool = struct.field(pytree_node=False, default=False)
    accumulate: bool = struct.field(pytree_node=False, default=False)

    def propose(self, belief: Truncated) -> Truncated:
        """The belief itself."""
        return belief

    def combine(self, belief: Truncated, proposal: Truncated, q: GaussianMixture) -> Truncated:
        """The network's answer on the prior's box."""
        return _fitted(q, belief)


@struct.dataclass
class Corrected:
    """Simulate from one Gaussian, the belief's moments widened, and divide it out.

    p̃ = N(m, c² S) on the prior's box, m and S the moments of the belief in the box. The division is exact, component by
    component, where a component of q is narrower than p̃ in every direction; one that is not stays as it is, which is
    the cautious reading of recordings that said less than the proposal.

    Source: Papamakarios and Murray 2016
    """

    widening: float | Array = 2.0
    """c: standard deviations of the proposal over those of the belief."""
    reuse: bool = struct.field(pytree_node=False, default=True)
    accumulate: bool = struct.field(pytree_node=False, default=True)

    def propose(self, belief: Truncated) -> Truncated:
        """The widened Gaussian; the prior itself while the belief is the prior."""
        scale_tril = jnp.linalg.cholesky(belief.covariance())
        wide = GaussianMixture(jnp.zeros(1), belief.mean()[None], self.widening * scale_tril[None])
        return Truncated.create(wide, belief.box, jnp.where(belief.prior_share > 0.5, belief.prior_share, 0.0))

    def combine(self, belief: Truncated, proposal: Truncated, q: GaussianMixture) -> Truncated:
        """The quotient q / p̃ on the prior's box; q itself where p̃ was the prior."""
        divided = quotient(q, proposal.mixture.means[0], proposal.mixture.scale_trils[0])
        first = proposal.prior_share > 0.5
        return _fitted(jax.tree.map(lambda a, b: jnp.where(first, a, b), q, divided), belief)


@struct.dataclass
class TruncatedPrior:
    """Simulate from the prior cut to an ellipsoid around the belief.

    p̃ is constant on {θ : |L⁻¹ (θ − m)| ≤ c √(d + 2)}, m and L Lᵀ the moments of the belief in the prior's box, so that
    its own standard deviations are c times those of the belief, as far as the box leaves it whole. Nothing is divided
    out, and simulations of all rounds that fall in it are alike.

    Source: Deistler et al. 2022
    """

    widening: float | Array = 2.5
    """c: standard deviations of the proposal over those of the belief."""
    reuse: bool = struct.field(pytree_node=False, default=True)
    accumulate: bool = struct.field(pytree_node=False, default=True)

    def propose(self, belief: Truncated) -> Ellipsoid:
        """The prior on the ellipsoid; the prior itself while the belief is the prior."""
        half_axes = self.widening * math.sqrt(belief.box.size + 2) * jnp.linalg.cholesky(belief.covariance())
        return Ellipsoid.create(belief.mean(), half_axes, belief.box, belief.prior_share > 0.5)

    def combine(self, belief: Truncated, proposal: Ellipsoid, q: GaussianMixture) -> Truncated:
        """The network's answer on the prior's box."""
        return _fitted(q, belief)


def _fitted(mixture: GaussianMixture, belief: Truncated, most: int = 32) -> Truncated:
    """A belief of the same shape: the lightest components beyond `most` are dropped, then pairs are merged."""
    count = belief.mixture.log_weights.size
    if mixture.log_weights.size > most:
        _, heaviest = jax.lax.top_k(mixture.log_weights, most)
        mixture = jax.tree.map(lambda leaf: leaf[heaviest], mixture)
    if mixture.log_weights.size < count:
        copies = -(-count // mixture.log_weights.size)
        mixture = jax.tree.map(lambda leaf: jnp.repeat(leaf, copies, axis=0), mixture)
    return Truncated.create(reduce(mixture, count), belief.box)


def pool_weights(
    thetas: Float[Array, "rounds n d"], proposals: Any, filled: Bool[Array, " rounds"], target: Belief
) -> Float[Array, "rounds n"]:
    """Weights that make pooled draws of several proposals stand for draws of one, scaled to at most one.

        w = p̃(θ) / (1/R Σᵣ p̃ᵣ(θ))

    The denominator is the mixture of all proposals that filled the pool, so no weight exceeds R. `proposals` is the
    stack of them, `filled[r]` says whether round r has been simulated.

    Source: Veach and Guibas 1995
    """
    points = thetas.reshape(-1, thetas.shape[-1])
    log_each = jax.vmap(lambda p: jax.vmap(p.log_prob)(points))(proposals)
    log_filled = jnp.where(filled, 0.0, -jnp.inf)
    log_mixture = jax.nn.logsumexp(log_each + log_filled[:, None], axis=0)
    log_weights = jax.vmap(target.log_prob)(points) - log_mixture
    used = filled[:, None] & jnp.isfinite(log_weights).reshape(thetas.shape[:2])
    return jnp.where(used, jnp.exp(jnp.minimum(log_weights, 0.0)).reshape(thetas.shape[:2]), 0.0)


PROPOSALS: dict[str, ProposalMode] = {"corrected": Corrected(), "paper": Paper(), "truncated": TruncatedPrior()}


def lookup_proposal(name: str) -> ProposalMode:
    """Find a proposal mode by name, or raise `ValueError` with the near miss."""
    return find_named(name, PROPOSALS, "unknown proposal")
