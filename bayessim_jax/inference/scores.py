"""How well a simulator predicts recordings from which it is restarted: errors, scores, and what noise allows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Bool, Float

from bayessim_jax.inference.shooting import FEW_CALLS, Predict, Ridge, Shots
from bayessim_jax.programs import trace_once

__all__ = [
    "Errors",
    "Score",
    "channel_errors",
    "compare",
    "error_spread",
    "nrmse",
    "predict_windows",
    "prediction_errors",
    "score",
    "smallest_error",
]

BINS = 8
"""Stretches of lead time over which the spread of errors is estimated."""
CHUNK = 32
"""Windows that are predicted at a time."""


@dataclass(frozen=True)
class Errors:
    """What predictions missed, and where there was something to compare with."""

    error: Float[np.ndarray, "windows rows obs"]
    measured: Bool[np.ndarray, "windows rows obs"]
    diverged: int = 0
    """Windows whose simulation was not finite: counted, and in no average."""


@dataclass(frozen=True)
class Score:
    """Errors in numbers."""

    nrmse: float
    """Root mean square error over a channel's standard deviation, averaged over channels."""
    log_score: float
    """Mean log density of a measured number under a Gaussian around the prediction, in units of the channel's
    standard deviation; its spread was estimated on other recordings, for each channel and lead time."""
    per_channel: dict[str, float]
    diverged: int = 0

    def as_table(self) -> dict[str, Any]:
        """The block of `inference.json` and `diagnosis.json`."""
        return {"nrmse": self.nrmse, "log_score": self.log_score, "per_channel": self.per_channel}


def predict_windows(
    predict: Predict, shots: Shots, z: Float[Array, " d"], delta: Float[Array, "windows n"] | None = None
) -> Float[np.ndarray, "windows rows obs"]:
    """Predictions of every window from its recorded initial state, or from δ beside it.

    A chunk of windows is simulated at a time, so that one program serves however many there are.
    """
    windows = shots.y.shape[0]
    still = np.zeros((windows, shots.spread.size), np.asarray(shots.spread).dtype)
    every = jax.tree.map(np.asarray, (still if delta is None else delta, _of_each_window(shots)))
    found = [np.zeros((0, *shots.y.shape[1:]))]
    for first in range(0, windows, CHUNK):
        which = np.minimum(np.arange(first, first + CHUNK), windows - 1)
        moved, inputs = jax.tree.map(lambda x, which=which: x[which], every)
        found.append(np.asarray(_predict(predict, inputs, z, moved)))
    return np.concatenate(found)[:windows]


def _of_each_window(shots: Shots) -> Any:
    """Inputs with a leading axis over windows, of what all share as well."""
    count = shots.y.shape[0]
    spread = lambda x: np.broadcast_to(x, (count, *np.shape(x)))  # noqa: E731
    own = lambda axis, part: jax.tree.map(spread, part) if axis is None else part  # noqa: E731
    return jax.tree.map(own, shots.axes, shots.inputs, is_leaf=lambda axis: axis is None)


@trace_once(static_argnames="predict", compiler_options=FEW_CALLS)
def _predict(predict: Predict, inputs: Any, z: Array, delta: Array) -> Float[Array, "windows rows obs"]:
    return jax.vmap(predict, in_axes=(None, 0, 0))(z, delta, inputs)


def prediction_errors(predict: Predict, shots: Shots, z: Float[Array, " d"]) -> Errors:
    """Measured minus predicted in every row after a window's first; windows that diverge are left out and counted."""
    return compare(predict_windows(predict, shots, z), np.asarray(shots.y), np.asarray(shots.measured))


def compare(
    predicted: Float[np.ndarray, "windows rows obs"],
    y: Float[np.ndarray, "windows rows obs"],
    measured: Bool[np.ndarray, "windows rows obs"],
) -> Errors:
    """The same for predictions that are there already."""
    lost = np.asarray(~np.isfinite(np.where(measured, predicted, 0.0)).all((1, 2)))
    measured = measured & ~lost[:, None, None]
    measured[:, 0] = False
    return Errors(np.where(measured, y - np.nan_to_num(predicted), 0.0), measured, int(lost.sum()))


def channel_errors(errors: Errors, scale: Float[np.ndarray, " obs"]) -> Float[np.ndarray, " obs"]:
    """Root mean square errors over their channel's scale; not a number where nothing was measured."""
    counts = errors.measured.sum((0, 1))
    return np.where(counts > 0, np.sqrt((errors.error**2).sum((0, 1)) / np.maximum(counts, 1)) / scale, np.nan)


def nrmse(errors: Errors, scale: Float[np.ndarray, " obs"]) -> float:
    """Their average over the channels where something was measured; not a number if there is none."""
    each = channel_errors(errors, scale)
    return float(each[np.isfinite(each)].mean()) if np.isfinite(each).any() else float("nan")


def error_spread(errors: Errors, scale: Float[np.ndarray, " obs"]) -> Float[np.ndarray, "bins obs"]:
    """Root mean square of errors over their channel's scale, for stretches of lead time; 1 where there are none."""
    spreads = []
    for rows in _stretches(errors):
        counts = errors.measured[:, rows].sum((0, 1))
        squares = (errors.error[:, rows] ** 2).sum((0, 1)) / np.maximum(counts, 1)
        spreads.append(np.where(counts > 0, np.sqrt(squares) / scale, 1.0))
    return np.maximum(np.array(spreads), 1e-6)


def _stretches(errors: Errors) -> list[np.ndarray]:
    return np.array_split(np.arange(errors.error.shape[1]), BINS)


def score(
    errors: Errors,
    spread: Float[np.ndarray, "bins obs"],
    scale: Float[np.ndarray, " obs"],
    channels: tuple[str, ...],
) -> Score:
    """Score errors by a Gaussian of this `spread` (`error_spread`), which comes from other recordings.

    `scale` is the standard deviation of every channel.
    """
    per_channel = {c: float(e) for c, e in zip(channels, channel_errors(errors, scale), strict=True) if np.isfinite(e)}
    logs = 0.0
    for rows, sd in zip(_stretches(errors), spread, strict=True):
        z = errors.error[:, rows] / scale / sd
        logs += float(np.where(errors.measured[:, rows], -0.5 * z**2 - np.log(sd * np.sqrt(2 * np.pi)), 0.0).sum())
    return Score(nrmse(errors, scale), logs / max(int(errors.measured.sum()), 1), per_channel, errors.diverged)


def smallest_error(
    ridge: Ridge,
    shots: Shots,
    noise: Float[np.ndarray, " obs"],
    start: Float[np.ndarray, " n"],
    scale: Float[np.ndarray, " obs"],
) -> float:
    """The nrmse that noise alone leaves at a fit: of the sensors, and of the recorded initial states, propagated.

    Var e = σ² + Σ_j (∂y/∂x_j)² s_j², with σ the `noise` of the sensors and s (`start`) the standard deviation of every
    coordinate of a recorded initial state.
    """
    sigma, spread = np.asarray(ridge.fit.sigma), np.asarray(shots.spread)
    shape = (ridge.slopes.shape[0], ridge.slopes.shape[1], *shots.y.shape[1:])
    grown = np.asarray(ridge.slopes).reshape(shape) * (start / spread)[:, None, None]
    variance = noise**2 + (grown**2).sum(1) * sigma**2
    measured = np.asarray(shots.measured).copy()
    measured[:, 0] = False
    counts = measured.sum((0, 1))
    mean = np.where(measured, variance, 0.0).sum((0, 1)) / np.maximum(counts, 1)
    each = np.sqrt(mean) / scale
    return float(each[counts > 0].mean())
