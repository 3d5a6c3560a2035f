"""The state of a simulator at every row: gaps between measurements filled in, velocities that were not measured."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from bayessim_jax.recordings.checks import gap_limit
from bayessim_jax.recordings.layout import BALL, FREE
from bayessim_jax.recordings.velocity import estimate_slopes

if TYPE_CHECKING:
    from bayessim_jax.recordings.layout import Layout

__all__ = ["fill_in", "joint_velocities", "slopes_between"]


def fill_in(time: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Values on a line between those measured, and which rows lie on or between measurements close by."""
    rows = np.flatnonzero(np.isfinite(values))
    if len(rows) == len(time):
        return values, np.ones(len(time), bool)
    close = np.diff(time[rows]) <= max(gap_limit(time[rows]), 0.0)
    after = np.searchsorted(rows, np.arange(len(time)), side="left")
    between = (after > 0) & (after < len(rows))
    near = np.zeros(len(time), bool)
    if len(rows) > 1:
        near = between & close[np.clip(after - 1, 0, len(close) - 1)]
    near[rows] = True
    return np.interp(time, time[rows], values[rows]), near


def joint_velocities(
    time: np.ndarray,
    qpos: np.ndarray,
    measured: np.ndarray,
    data: dict[str, np.ndarray],
    layout: Layout,
    wide: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, tuple[int, ...]]:
    """Velocities as measured, or from the positions; NaN where there is neither."""
    qvel, seen = np.full((len(time), len(layout.qvel)), np.nan), np.zeros((len(time), len(layout.qvel)), bool)
    halves = [0] * len(layout.qvel)
    given = {name: data.pop(name) for name in layout.qvel if name in data}
    turning = {v + k: (q, k) for q, v in layout.quaternions for k in range(3)}
    place = {}
    for _, kind, q, v in layout.joints:
        place |= {v + k: q + k for k in range({FREE: 3, BALL: 0}.get(kind, 1))}
    rates: dict[int, tuple[np.ndarray, int]] = {}
    for i, name in enumerate(layout.qvel):
        values = given.get(name)
        if values is not None and np.isfinite(values).any():
            qvel[:, i], near = fill_in(time, values)
            seen[:, i] = np.isfinite(values)
            qvel[~near, i] = np.nan
        elif i in turning:
            q, k = turning[i]
            if q not in rates:
                whole = np.asarray(measured[:, q : q + 4].all(1))
                rates[q] = _angular(time, qpos[:, q : q + 4], whole, wide)
            qvel[:, i], halves[i] = rates[q][0][:, k], rates[q][1]
        else:
            qvel[:, i], halves[i] = slopes_between(time, qpos[:, place[i]], measured[:, place[i]], wide)
    return qvel, seen, tuple(halves)


def slopes_between(
    time: np.ndarray, values: np.ndarray, measured: np.ndarray, wide: np.ndarray
) -> tuple[np.ndarray, int]:
    """Slopes at every row from the rows that were measured."""
    rows = np.flatnonzero(measured)
    if len(rows) < 2:
        return np.full(len(time), np.nan), 1
    own = time[rows]
    broken = np.concatenate([[0], np.cumsum(wide)])[rows]
    slopes, half = estimate_slopes(own, values[rows], (np.diff(broken) > 0) | (np.diff(own) > gap_limit(own)))
    out = np.full(len(time), np.nan)
    out[rows] = slopes
    filled, near = fill_in(time, out) if np.isfinite(out).any() else (out, np.zeros(len(time), bool))
    return np.where(near, filled, np.nan), half


def _angular(
    time: np.ndarray, quaternion: np.ndarray, measured: np.ndarray, wide: np.ndarray
) -> tuple[np.ndarray, int]:
    """Angular velocity in the body's frame, ω = 2 vec(q̄ ⊗ dq/dt), of a unit quaternion w, x, y, z."""
    slopes = [slopes_between(time, quaternion[:, k], measured, wide) for k in range(4)]
    (w, x, y, z), (dw, dx, dy, dz) = quaternion.T, (s for s, _ in slopes)
    turn = (w * dx - x * dw - y * dz + z * dy, w * dy - y * dw - z * dx + x * dz, w * dz - z * dw - x * dy + y * dx)
    return 2 * np.stack(turn, 1), max(half for _, half in slopes)
