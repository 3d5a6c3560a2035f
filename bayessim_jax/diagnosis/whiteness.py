"""Is there a mismatch at all: a simulator that explains a recording leaves white residuals, another one smooth ones.

The statistic is the power of the residuals in the slowest cosines of every window, in units of the noise that their
second differences show. Its null distribution needs no simulation: what a fit leaves of white noise is the noise minus
its projection on what the initial states can absorb, to first order; the few numbers of θ hardly count beside them.

Source: von Neumann 1941 (noise from differences); Davison and Hinkley 1997 (parametric bootstrap)
"""

from __future__ import annotations

from dataclasses import dataclass

import jax
import numpy as np
from jaxtyping import Bool, Float, PRNGKeyArray

__all__ = ["Misfit", "difference_noise", "judge_misfit"]

MODES = 8
"""Cosines of a window that count as slow, beside the mean: a sensor or a base that is off shows there alone."""
ROUNDED = 1e3
"""Times the precision of numbers: a column that is no longer beside the others is nothing but rounding."""
FEW = 10
"""Second differences that tell nothing of the noise."""
BOOTSTRAPS = 400
TINY = 1e-9
"""Of the noise's power: what is added where initial states can explain all of a cosine."""
FALSE_ALARMS = 0.05


@dataclass(frozen=True)
class Misfit:
    """What is left in the residuals of a fit."""

    p_value: float
    excess: Float[np.ndarray, "windows obs"]
    """Slow power of each window and channel above what noise leaves there, in units of σ²: 0 on average if clean."""
    noise: Float[np.ndarray, " obs"]
    """White noise of each channel."""
    judged: Bool[np.ndarray, " windows"]
    """Windows that count; in others there is no excess."""

    def size(self, measured: Bool[np.ndarray, "windows rows obs"]) -> float:
        """Power of the misfit over that of the noise, over all that was measured."""
        return float(self.excess.sum() / max(measured.sum(), 1))


def difference_noise(residual: Float[np.ndarray, "windows rows obs"], measured: Bool[np.ndarray, "..."]) -> np.ndarray:
    """Standard deviation of white noise: √(mean (r_t − 2 r_{t+1} + r_{t+2})² / 6), where three rows were measured."""
    second, known = _second_differences(residual, measured)
    counts = known.sum((0, 1))
    squares = np.where(known, second, 0.0) ** 2
    overall = np.sqrt((np.where(measured, residual, 0.0) ** 2).sum((0, 1)) / np.maximum(measured.sum((0, 1)), 1))
    return np.where(counts > FEW, np.sqrt(squares.sum((0, 1)) / np.maximum(6 * counts, 1)), overall)


def _second_differences(
    x: Float[np.ndarray, "windows rows ..."], measured: Bool[np.ndarray, "windows rows ..."]
) -> tuple[Float[np.ndarray, "windows rows-2 ..."], Bool[np.ndarray, "windows rows-2 ..."]]:
    """x_t − 2 x_{t+1} + x_{t+2} along the rows, and where all three were measured."""
    known = measured[:, :-2] & measured[:, 1:-1] & measured[:, 2:]
    return x[:, :-2] - 2 * x[:, 1:-1] + x[:, 2:], known


def _cosines(rows: int) -> Float[np.ndarray, "modes rows"]:
    t = (np.arange(rows) + 0.5) / rows
    modes = np.sqrt(2.0 / rows) * np.cos(np.pi * np.arange(MODES + 1)[:, None] * t)
    modes[0] /= np.sqrt(2.0)
    return modes


def _slow(r: Float[np.ndarray, "windows rows obs"], cosines: np.ndarray) -> Float[np.ndarray, "windows obs"]:
    """Power in the slow cosines, for every window and channel."""
    return (np.einsum("mr,wro->wmo", cosines, r) ** 2).sum(1)


def _basis(columns: Float[np.ndarray, "windows k c"]) -> Float[np.ndarray, "windows k c"]:
    """Orthonormal columns with the span of some, and zeros where these depend on others, as what is known does.

    Of no other directions, as a factorization without pivots has where a column is zero.
    """
    directions, size, _ = np.linalg.svd(columns, full_matrices=False)
    least = ROUNDED * np.finfo(size.dtype).eps * size.max(-1, keepdims=True)
    return directions * (size > least)[:, None]


def _noise_left(
    q: Float[np.ndarray, "windows k c"], measured: Bool[np.ndarray, "windows rows obs"], cosines: np.ndarray
) -> tuple[Float[np.ndarray, "windows mo c"], Float[np.ndarray, "windows mo mo"]]:
    """The slow part of what initial states can explain, and a root of the covariance of that of noise less it.

    With C the cosines where something was measured, and Q = `q`, which is zero elsewhere, they are G = Cᵀ Q and a root
    of Cᵀ (I − Q Qᵀ) C: far fewer numbers are drawn than were measured.
    """
    windows, rows, obs = measured.shape
    modes = len(cosines)
    basis = np.tensordot(cosines, q.reshape(windows, rows, obs, -1), (1, 1))
    slow = np.moveaxis(basis, 0, 1).reshape(windows, modes * obs, -1)
    own = np.zeros((windows, modes, obs, modes, obs))
    for o in range(obs):
        seen = cosines * measured[:, None, :, o]
        own[:, :, o, :, o] = seen @ seen.swapaxes(1, 2)
    left = own.reshape(windows, modes * obs, modes * obs) - slow @ slow.swapaxes(1, 2)
    return slow, np.linalg.cholesky(left + TINY * np.eye(modes * obs))


def judge_misfit(
    key: PRNGKeyArray,
    residual: Float[np.ndarray, "windows rows obs"],
    slopes: Float[np.ndarray, "windows n k"],
    measured: Bool[np.ndarray, "windows rows obs"],
    known: Float[np.ndarray, "windows rows obs"] | float = 0.0,
    judged: Bool[np.ndarray, " windows"] | None = None,
) -> Misfit:
    """Test the residuals of a fit against those of white noise; `slopes` are those of predictions along δ.

    `known` is an error that predictions have for another reason, such as the time step. In a window it explains at most
    what is seen there: where the simulation is chaotic it is large, and is no excuse for what other windows show. Only
    the windows `judged` count, all of them unless told.
    """
    counts = np.ones(len(residual), bool) if judged is None else judged
    noise = np.maximum(difference_noise(residual, measured), 1e-300)
    rows, obs = measured.shape[1:]
    slopes = (slopes.reshape(*slopes.shape[:2], rows, obs) / noise).reshape(slopes.shape)
    q, cosines = _basis(np.swapaxes(slopes, 1, 2)), _cosines(rows)
    power = _slow(np.where(measured, residual / noise, 0.0), cosines)
    slow, root = _noise_left(q, measured, cosines)
    error = np.where(measured, known / noise * np.ones(measured.shape), 0.0)
    explained = np.einsum("wkc,wk->wc", q, error.reshape(len(error), -1))
    left = np.einsum("mr,wro->wmo", cosines, error) - (slow @ explained[..., None]).reshape(len(error), -1, obs)
    share = np.minimum(power.sum(1) / np.maximum((left**2).sum((1, 2)), 1e-30), 1.0)
    left *= np.sqrt(share)[:, None, None]
    random = np.random.default_rng(np.asarray(jax.random.key_data(key)))
    draws = root @ random.standard_normal((*root.shape[:2], BOOTSTRAPS))
    null = (draws.reshape(*left.shape, BOOTSTRAPS) + left[..., None]) ** 2
    null = np.moveaxis(null.sum(1), -1, 0)
    power, null = power * counts[:, None], null * counts[:, None]
    total, mean = null.sum((1, 2)), null.mean(0)
    gain = _doubt_of_noise(measured, cosines, mean.sum(0), counts)
    wide = np.sqrt(max(1.0 + gain / max(float(total.var()), 1e-30), 0.0))
    total = total.mean() + wide * (total - total.mean())
    p_value = (1 + (total >= power.sum()).sum()) / (1 + BOOTSTRAPS)
    return Misfit(float(p_value), power - mean, noise, counts)


def _doubt_of_noise(
    measured: Bool[np.ndarray, "windows rows obs"],
    cosines: Float[np.ndarray, "modes rows"],
    mean: Float[np.ndarray, " obs"],
    counts: Bool[np.ndarray, " windows"],
) -> float:
    """What the variance of the slow power, of this mean in each channel, gains as differences alone tell the noise.

    For the power P of one channel, in units of a noise with variance s² for 1, P/s² ≈ P − E[P] (s² − 1): the variance
    gains E[P]² Var[s²] − 2 E[P] Cov[P, s²]. With P = rᵀ A r and s² = rᵀ B r of white r they are 2 tr(B²) and 2 tr(A B).
    """
    waves = np.where(measured[..., None], cosines.T[:, None], 0.0)
    bends, there = _second_differences(waves, measured[..., None])
    both, known = (np.where(there, bends, 0.0)[counts] ** 2).sum((0, 1, 3)), there[..., 0]
    number = np.maximum(known.sum((0, 1)), 1)
    beside = [(known[:, k:] & known[:, : known.shape[1] - k]).sum((0, 1)) for k in (1, 2)]
    square = 36.0 * number + 32.0 * beside[0] + 2.0 * beside[1]
    gain = mean**2 * 2.0 * square / (6.0 * number) ** 2 - 2.0 * mean * 2.0 * both / (6.0 * number)
    return float(gain[known.sum((0, 1)) > FEW].sum())
