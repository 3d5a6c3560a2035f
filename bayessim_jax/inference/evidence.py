"""Evidence of several recordings, as one Gaussian."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from bayessim_jax.beliefs import GaussianMixture, moment_match
from bayessim_jax.beliefs.triangular import invert

__all__ = ["combine_evidence"]


def combine_evidence(each: GaussianMixture, use: Bool[Array, " set"]) -> GaussianMixture:
    """One Gaussian from the posteriors of single recordings, under a proposal of mean 0 and variance 1 on every axis.

    What recording i adds to the proposal is Jᵢ = Λᵢ − I and hᵢ = Λᵢ μᵢ, from the moments of its posterior; directions
    in which it would add negative precision are left out. The product of the evidence is

        Λ = I + Σ Jᵢ,   μ = Λ⁻¹ Σ hᵢ

    Evidence adds up; posteriors are neither averaged nor multiplied with the proposal counted more than once.
    """

    def evidence(mixture: GaussianMixture) -> tuple[Array, Array]:
        mean, tril = moment_match(mixture)
        inverse = invert(tril)
        precision = inverse.T @ inverse
        values, axes = jnp.linalg.eigh(precision)
        added = jnp.maximum(values - 1.0, 0.0)
        weighed = jnp.where(added > 0, values * (axes.T @ mean), 0.0)
        return (axes * added) @ axes.T, axes @ weighed

    j, h = jax.vmap(evidence)(each)
    precision = jnp.eye(h.shape[-1]) + jnp.where(use[:, None, None], j, 0.0).sum(0)
    # Λ = U Uᵀ, U upper triangular, from the factor of Λ read backwards; Λ⁻¹ = U⁻ᵀ U⁻¹
    root = jnp.flip(invert(jnp.linalg.cholesky(jnp.flip(precision)))).T
    mean = root @ (root.T @ jnp.where(use[:, None], h, 0.0).sum(0))
    return GaussianMixture(jnp.zeros(1), mean[None], root[None])
