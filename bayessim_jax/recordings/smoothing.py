"""The motion behind noisy recordings: positions, velocities and accelerations of every joint, smoothed together."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from bayessim_jax.recordings.recording import CaseRecording

__all__ = ["smooth_recordings"]

LEVELS = 10.0 ** np.arange(-1.0, 3.1, 0.5)
"""Root mean square jerks that are tried, in units of the motion's own."""
WARM = 20
"""Rows of a recording that do not count when the level is chosen: the filter is still finding the motion."""


def smooth_recordings(
    recordings: Sequence[CaseRecording], joints: Sequence[tuple[int, int]]
) -> tuple[CaseRecording, ...]:
    """The same recordings with smoothed positions and velocities of joints, given by their places in qpos and qvel.

    State (q, v, a) of every joint, driven by white jerk; the filter's likelihood chooses the jerk of every joint, over
    all recordings; noise comes from third differences. Nothing is smoothed across a break. Rows have to be evenly
    spaced.

    Source: Rauch, Tung and Striebel 1965
    """
    if not joints:
        return tuple(recordings)
    spans = [(i, span) for i, r in enumerate(recordings) for span in r.spans if span[1] - span[0] >= 4]
    rows = max((stop - start + 1 for _, (start, stop) in spans), default=0)
    if not rows:
        return tuple(recordings)
    shape = (len(spans), len(joints), rows)
    y, seen = np.zeros((*shape, 2)), np.zeros((*shape, 2), bool)
    for s, (i, (start, stop)) in enumerate(spans):
        r, part, count = recordings[i], slice(start, stop + 1), stop - start + 1
        for j, (q, v) in enumerate(joints):
            y[s, j, :count, 0], seen[s, j, :count, 0] = r.qpos[part, q], r.qpos_measured[part, q]
            y[s, j, :count, 1], seen[s, j, :count, 1] = r.qvel[part, v], r.qvel_measured[part, v]
    dt = recordings[0].step
    noise = np.maximum(_noise(y, seen), 1e-9)
    usual = _usual_jerk(y, seen, dt, noise)
    level = np.argmax(_filter(y, seen, dt, noise, LEVELS[:, None, None] * usual)[0], axis=0)
    smooth = _smooth(y, seen, dt, noise, LEVELS[level] * usual)
    out = [dataclasses.replace(r, qpos=r.qpos.copy(), qvel=r.qvel.copy()) for r in recordings]
    for s, (i, (start, stop)) in enumerate(spans):
        part, count = slice(start, stop + 1), stop - start + 1
        for j, (q, v) in enumerate(joints):
            out[i].qpos[part, q], out[i].qvel[part, v] = smooth[s, j, :count, 0], smooth[s, j, :count, 1]
    return tuple(out)


def _noise(y: np.ndarray, seen: np.ndarray) -> Float[np.ndarray, "joints 2"]:
    """√(mean (Δ³y)²/20) of positions and velocities."""
    third = np.diff(y, 3, axis=2)
    known = seen[:, :, 3:] & seen[:, :, 2:-1] & seen[:, :, 1:-2] & seen[:, :, :-3]
    counts = np.maximum(known.sum((0, 2)), 1)
    return np.sqrt((np.where(known, third, 0.0) ** 2).sum((0, 2)) / (20 * counts))


def _usual_jerk(y: np.ndarray, seen: np.ndarray, dt: float, noise: np.ndarray) -> Float[np.ndarray, " joints"]:
    """Jerk's order of size: the spread of positions times the third power of the rate at which they swing."""
    known = seen[..., 0]
    counts = np.maximum(known.sum((0, 2)), 1)
    mean = np.where(known, y[..., 0], 0.0).sum((0, 2)) / counts
    spread = np.sqrt(np.where(known, (y[..., 0] - mean[:, None]) ** 2, 0.0).sum((0, 2)) / counts)
    lag = max(round(0.02 / dt), 1)
    pairs = known[:, :, lag:] & known[:, :, :-lag]
    rise = np.where(pairs, y[:, :, lag:, 0] - y[:, :, :-lag, 0], 0.0) ** 2
    square = rise.sum((0, 2)) / np.maximum(pairs.sum((0, 2)), 1) - 2 * noise[:, 0] ** 2
    speed = np.sqrt(np.maximum(square, 1e-18)) / (lag * dt)
    rate = np.clip(speed / np.maximum(spread, 1e-9), 1.0, 0.5 / dt)
    return np.maximum(spread, noise[:, 0]) * rate**3


def _model(dt: float, jerk: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Transition of (q, v, a) and the covariance that white jerk, 1 s long in correlation, adds in a row."""
    f = np.array([[1, dt, dt**2 / 2], [0, 1, dt], [0, 0, 1]])
    powers = np.array(
        [
            [dt**5 / 20, dt**4 / 8, dt**3 / 6],
            [dt**4 / 8, dt**3 / 3, dt**2 / 2],
            [dt**3 / 6, dt**2 / 2, dt],
        ]
    )
    return f, powers * (jerk**2)[..., None, None] * 0.1


def _start(y: np.ndarray, seen: np.ndarray, noise: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A wide prior around the first row."""
    state = np.zeros((*y.shape[:2], 3))
    state[..., 0], state[..., 1] = y[:, :, 0, 0], np.where(seen[:, :, 0, 1], y[:, :, 0, 1], 0.0)
    wide = np.stack([np.full(len(noise), 1.0), np.full(len(noise), 100.0), np.full(len(noise), 1e4)], -1)
    return state, np.broadcast_to(np.einsum("jk,kl->jkl", wide, np.eye(3)), (*y.shape[:2], 3, 3)).copy()


def _filter(
    y: np.ndarray, seen: np.ndarray, dt: float, noise: np.ndarray, jerk: np.ndarray, keep: bool = False
) -> tuple[np.ndarray, list[tuple[np.ndarray, ...]]]:
    """Log likelihood of every joint, and means and covariances before and after every row.

    `jerk` may be several ones of each joint, with axes (levels, 1, joints): all are filtered at once.
    """
    f, q = _model(dt, jerk)
    x, p = _start(y, seen, noise)
    x, p = (np.broadcast_to(a, (*jerk.shape[:-2], *a.shape)) for a in (x, p))
    total, kept = np.zeros((*jerk.shape[:-2], y.shape[1])), []
    for t in range(y.shape[2]):
        before = (x, p)
        for k in range(2):
            gain = p[..., k] / (p[..., k, k] + noise[:, k] ** 2)[..., None]
            used = seen[:, :, t, k]
            miss = np.where(used, y[:, :, t, k] - x[..., k], 0.0)
            if t >= WARM:
                s = p[..., k, k] + noise[:, k] ** 2
                total += np.where(used, -0.5 * (miss**2 / s + np.log(s)), 0.0).sum(-2)
            x = x + gain * miss[..., None]
            p = np.where(used[..., None, None], p - gain[..., :, None] * p[..., None, k, :], p)
        if keep:
            kept.append((*before, x, p))
        x, p = x @ f.T, f @ p @ f.T + q
    return total, kept


def _smooth(y: np.ndarray, seen: np.ndarray, dt: float, noise: np.ndarray, jerk: np.ndarray) -> np.ndarray:
    """Means of every row given all rows."""
    f, _ = _model(dt, jerk)
    _, kept = _filter(y, seen, dt, noise, jerk, keep=True)
    out = np.zeros((*y.shape[:3], 3))
    state = kept[-1][2]
    out[:, :, -1] = state
    for t in range(y.shape[2] - 2, -1, -1):
        _, _, x, p = kept[t]
        ahead, spread = kept[t + 1][0], kept[t + 1][1]
        gain = np.swapaxes(np.linalg.solve(spread, f @ p), -1, -2)
        state = x + np.einsum("sjkl,sjl->sjk", gain, state - ahead)
        out[:, :, t] = state
    return out
