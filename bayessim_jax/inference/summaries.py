"""Hand-made summary statistics of a recording, and random Fourier features of them: the baselines' encoders."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, PRNGKeyArray

__all__ = ["FourierSummary", "Summary", "cross_correlations"]


def cross_correlations(
    x: Float[Array, "steps features"], valid: Bool[Array, " steps"], observed: int
) -> Float[Array, " summaries"]:
    """The statistics of BayesSim: ⟨Δyᵢ, (y, u)ⱼ⟩ per valid step, and mean and variance of every Δyᵢ.

    `x` holds (y, Δy, u) with `observed` channels y.

    Source: Ramos et al. 2019
    """
    count = jnp.maximum(valid.sum(), 1)
    y, dy, u = jnp.split(jnp.where(valid[:, None], x, 0.0), [observed, 2 * observed], axis=-1)
    correlations = dy.T @ jnp.concatenate([y, u], axis=-1) / count
    mean = dy.sum(0) / count
    variance = (dy**2).sum(0) / count - mean**2
    return jnp.concatenate([correlations.ravel(), mean, variance, valid.mean(keepdims=True)])


@struct.dataclass
class Summary:
    """Cross-correlations of state differences with states and actions, in place of a learned embedding."""

    actions: int = struct.field(pytree_node=False, default=1)
    """Length of the action vector: the last so many features."""

    def init(self, key: PRNGKeyArray, features: int) -> dict[str, Array]:
        """Nothing to learn."""
        return {}

    def apply(
        self, params: Any, x: Float[Array, "batch steps features"], valid: Bool[Array, "batch steps"]
    ) -> Float[Array, "batch size"]:
        """Summarize every sequence."""
        observed = (x.shape[-1] - self.actions) // 2
        return jax.vmap(lambda a, b: cross_correlations(a, b, observed))(x, valid)


@struct.dataclass
class FourierSummary:
    """Random Fourier features of the summaries s: √(1/m) [cos ωᵀs/ℓ, sin ωᵀs/ℓ], m frequencies ω.

    The frequencies are normal quantiles of a Richtmyer sequence (quasi-Monte Carlo), fixed; the length scale ℓ of the
    squared-exponential kernel that they stand for is learned with the outputs.

    Source: Ramos et al. 2019
    """

    features: int = struct.field(pytree_node=False, default=300)
    actions: int = struct.field(pytree_node=False, default=1)

    def init(self, key: PRNGKeyArray, features: int) -> dict[str, Array]:
        """One length scale."""
        return {"log_scale": jnp.log(jnp.array(3.0))}

    def apply(
        self, params: Any, x: Float[Array, "batch steps features"], valid: Bool[Array, "batch steps"]
    ) -> Float[Array, "batch size"]:
        """Cosines and sines."""
        s = Summary(self.actions).apply({}, x, valid)
        omega = quasi_normal(self.features, s.shape[-1])
        angle = s @ omega.T * jnp.exp(-params["log_scale"])
        return jnp.concatenate([jnp.cos(angle), jnp.sin(angle)], axis=-1) / jnp.sqrt(self.features)


def quasi_normal(n: int, d: int) -> Float[Array, "n d"]:
    """Normal quantiles of the Richtmyer sequence: fractional parts of multiples of the roots of primes.

    Source: Niederreiter 1992
    """
    primes = [p for p in range(2, 20 * d + 20) if all(p % q for q in range(2, int(p**0.5) + 1))][:d]
    roots = [p**0.5 % 1 for p in primes]
    points = [[(0.5 + i * r) % 1 for r in roots] for i in range(1, n + 1)]
    return jax.scipy.special.ndtri(jnp.clip(jnp.array(points), 1e-6, 1 - 1e-6))
