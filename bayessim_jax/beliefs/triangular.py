"""Small triangular factors: covariances are kept as L with Σ = L Lᵀ and never squared, which float32 would not bear."""

from __future__ import annotations

import jax.numpy as jnp
from jax.scipy.linalg import cho_solve
from jaxtyping import Array, Float

from bayessim_jax.contracts import Scalar

__all__ = ["factor", "invert", "log_normal", "solve_lower", "solve_positive"]


def factor(a: Float[Array, "d m"]) -> Float[Array, "d d"]:
    """Lower triangular L with L Lᵀ = A Aᵀ and a positive diagonal, through a QR factorization of Aᵀ.

    Where A Aᵀ is singular the diagonal is raised to the rounding error of its row, so that log det stays finite.
    """
    lower = jnp.linalg.qr(a.T, mode="r").T
    lower = lower * jnp.where(jnp.diagonal(lower) < 0, -1.0, 1.0)
    info = jnp.finfo(a.dtype)
    floor = info.eps * jnp.sqrt((a**2).sum(-1) + info.tiny)
    return lower + jnp.diag(jnp.maximum(jnp.diagonal(lower), floor) - jnp.diagonal(lower))


def solve_lower(lower: Float[Array, "d d"], b: Float[Array, "d *m"]) -> Float[Array, "d *m"]:
    """L⁻¹ b of a lower triangular L by forward substitution, written out: d is small.

    In batches this is quicker than LAPACK, and it cannot wait: two batched triangular solves at once can block each
    other for ever on a machine with two cores (jaxlib 0.10).
    """
    rows: list[Array] = []
    for i in range(lower.shape[-1]):
        known = [lower[i, j] * row for j, row in enumerate(rows)]
        rows.append((b[i] - sum(known, jnp.zeros_like(b[i]))) / lower[i, i])
    return jnp.stack(rows)


def invert(lower: Float[Array, "d d"]) -> Float[Array, "d d"]:
    """L⁻¹ of a lower triangular L."""
    return solve_lower(lower, jnp.eye(lower.shape[-1], dtype=lower.dtype))


def solve_positive(a: Float[Array, "*n d d"], b: Float[Array, "*n d m"]) -> Float[Array, "*n d m"]:
    """A⁻¹ b of a symmetric and positive definite A; there is less to compile than in a pivoting solve."""
    return cho_solve((jnp.linalg.cholesky(a), True), b)


def log_normal(difference: Float[Array, " d"], lower: Float[Array, "d d"]) -> Scalar:
    """Log density log N(x; μ, L Lᵀ) for x − μ = `difference`."""
    white = solve_lower(lower, difference)
    scale = jnp.log(jnp.diagonal(lower)).sum() + 0.5 * difference.shape[-1] * jnp.log(2 * jnp.pi)
    return -0.5 * (white**2).sum() - scale
