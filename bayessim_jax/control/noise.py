"""What perturbs a plan: independent steps, coloured noise, or smooth splines through few random points."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float, PRNGKeyArray
from scipy.interpolate import BSpline

__all__ = ["NOISES", "PlanNoise", "coloured_noise", "spline_noise", "white_noise"]


@struct.dataclass
class PlanNoise:
    """ε = B z, z ~ N(0, I), with rows of B of length one, so that every ε has variance 1.

    `precision` is the pseudo-inverse of B Bᵀ, the covariance along the horizon. White noise has B = I, which is left
    out.
    """

    horizon: int = struct.field(pytree_node=False)
    basis: Float[Array, "horizon points"] | None = None
    precision: Float[Array, "horizon horizon"] | None = None

    def draw(self, key: PRNGKeyArray, actions: int, samples: int) -> Float[Array, "horizon act samples"]:
        """Perturbations of unit variance."""
        if self.basis is None:
            return jax.random.normal(key, (self.horizon, actions, samples))
        z = jax.random.normal(key, (self.basis.shape[1], actions, samples))
        return jnp.einsum("hm,mak->hak", self.basis, z)

    def whiten(self, plan: Float[Array, "horizon act"]) -> Float[Array, "horizon act"]:
        """(B Bᵀ)⁺ u: the inner product of this with ε is uᵀ Σ⁻¹ ε."""
        return plan if self.precision is None else self.precision @ plan


def white_noise(horizon: int) -> PlanNoise:
    """Every step by itself."""
    return PlanNoise(horizon)


def coloured_noise(horizon: int, exponent: float = 1.0) -> PlanNoise:
    """Power ∝ 1/f^exponent: 0 is white, 1 pink, 2 nearly a random walk.

    It is a stretch of a periodic process twice as long, so that the end of a plan is not tied to its beginning.

    Source: Pinneri et al. 2021
    """
    frequency = np.maximum(np.abs(np.fft.fftfreq(2 * horizon)), 0.5 / horizon)
    covariance = np.fft.ifft(frequency**-exponent).real
    steps = np.arange(horizon)
    toeplitz = covariance[np.abs(steps[:, None] - steps)] / covariance[0]
    return _shaped(np.linalg.cholesky(toeplitz + 1e-9 * np.eye(horizon)))


def spline_noise(horizon: int, knots: int | None = None) -> PlanNoise:
    """Cubic splines with few random coefficients, one for four steps of the horizon unless told."""
    count = max(4, horizon // 4) if knots is None else knots
    if not 4 <= count <= horizon:
        raise ValueError(f"spline noise: knots is {count}; it must be from 4 to the horizon, {horizon}.")
    grid = np.concatenate([np.zeros(3), np.linspace(0.0, 1.0, count - 2), np.ones(3)])
    basis = BSpline.design_matrix(np.linspace(0.0, 1.0, horizon), grid, 3).toarray()
    return _shaped(basis)


def _shaped(basis: np.ndarray) -> PlanNoise:
    basis = basis / np.linalg.norm(basis, axis=1, keepdims=True)
    precision = np.linalg.pinv(basis @ basis.T, rcond=1e-6, hermitian=True)
    return PlanNoise(len(basis), jnp.asarray(basis, float), jnp.asarray(precision, float))


NOISES: dict[str, Callable[[int], PlanNoise]] = {
    "white": white_noise,
    "coloured": coloured_noise,
    "spline": spline_noise,
}
