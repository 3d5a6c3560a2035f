"""A recording as arrays in the simulator's order and in SI units, with masks that say what was measured."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

__all__ = ["CaseRecording", "Span", "resample"]

AROUND, UNMEASURED = 7, 1e-2
"""Rows that say how a measurement moves between rows, and the weight of numbers that were filled in among them."""
AT_ONCE = 65_536
"""Rows whose derivatives are found at once."""
Span = tuple[int, int]
"""First and last row of a stretch without a break."""


@dataclass(frozen=True)
class CaseRecording:
    """One file: row i holds what was measured at `time[i]`; `ctrl[i]` is held until `time[i + 1]`.

    Every number is finite: what was not measured is filled in from its neighbours and marked as such, so that only
    what a mask names may be compared with a prediction. `valid[t]` says that the transition from row t to row t + 1
    can be simulated: there is no gap in it and its command is known.
    """

    name: str
    """Name of the file, for messages and reports."""
    time: Float[np.ndarray, " rows"]
    """s, strictly increasing, as the file has it."""
    ctrl: Float[np.ndarray, "rows nu"]
    qpos: Float[np.ndarray, "rows nq"]
    qvel: Float[np.ndarray, "rows nv"]
    sensors: Float[np.ndarray, "rows ns"]
    qpos_measured: Bool[np.ndarray, "rows nq"]
    qvel_measured: Bool[np.ndarray, "rows nv"]
    """False where a velocity was estimated from positions, or filled in."""
    sensors_measured: Bool[np.ndarray, "rows ns"]
    valid: Bool[np.ndarray, " steps"]
    known: Bool[np.ndarray, " rows"]
    """Rows whose whole state is measured, estimated, or lies between measurements close by: a simulation may start."""
    half_widths: tuple[int, ...] = ()
    """Rows to each side that an estimated velocity was taken from, for each of `qvel`; 0 where it was measured."""

    @property
    def qvel_estimated(self) -> Bool[np.ndarray, " nv"]:
        """Which velocities were not measured at all."""
        return np.array([half > 0 for half in self.half_widths], bool)

    @property
    def step(self) -> float:
        """Median time between rows, s."""
        return float(np.median(np.diff(self.time)))

    @property
    def spans(self) -> list[Span]:
        """Stretches of rows without a break, of two rows at least."""
        edges = np.diff(np.concatenate([[False], self.valid, [False]]).astype(np.int8))
        return list(zip(np.flatnonzero(edges == 1).tolist(), np.flatnonzero(edges == -1).tolist(), strict=True))

    def row_at(self, time: float) -> int:
        """The row nearest to a time."""
        return int(np.argmin(np.abs(self.time - time)))


def resample(recording: CaseRecording, dt: float) -> CaseRecording:
    """The same recording on rows `dt` seconds apart, restarted after every break.

    A row takes the measurement nearest to it, moved along the cubic through the seven around it. Its noise stays that
    of one measurement: on a line between two it would be smaller, and that of neighbours alike, which looks like a
    mismatch. A measurement that is nearest to several rows counts as measured in the nearest of them. A command is
    averaged over the step that it is held for, which keeps its impulse.
    """
    if not dt > 0:
        raise ValueError(f"dt is {dt:g}; it must be above 0.")
    parts = [_uniform(recording, span, dt) for span in recording.spans]
    parts = [part for part in parts if len(part["time"]) > 1]
    if not parts:
        raise ValueError(f"{recording.name}: no stretch without a gap is as long as {dt:g} s; choose a shorter step.")
    joined = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    valid = np.concatenate([np.append(np.ones(len(part["time"]) - 1, bool), False) for part in parts])[:-1]
    return CaseRecording(recording.name, valid=valid, half_widths=recording.half_widths, **joined)


def _uniform(recording: CaseRecording, span: Span, dt: float) -> dict[str, np.ndarray]:
    rows = slice(span[0], span[1] + 1)
    old = recording.time[rows]
    count = int(np.floor((old[-1] - old[0]) / dt * (1 + 1e-9))) + 1
    new = np.minimum(old[0] + dt * np.arange(count), old[-1])
    left = np.clip(np.searchsorted(old, new, side="right") - 1, 0, len(old) - 2)
    near = left + (new - old[left] > old[left + 1] - new)
    shift = new - old[near]
    order = np.lexsort((np.abs(shift), near))
    first = np.zeros(len(new), bool)
    first[order[np.unique(near[order], return_index=True)[1]]] = True

    def move(x: np.ndarray, measured: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        x, measured = x[rows], measured[rows]
        slope, bend = _derivatives(old, x, measured)
        moved = x[near] + slope[near] * shift[:, None] + 0.5 * bend[near] * shift[:, None] ** 2
        return moved, measured[near] & first[:, None]

    parts = {"known": recording.known[rows][near] & first}
    for name in ("qpos", "qvel", "sensors"):
        mask = f"{name}_measured"
        parts[name], parts[mask] = move(getattr(recording, name), getattr(recording, mask))
    held = recording.ctrl[rows]
    impulse = np.concatenate([np.zeros((1, held.shape[1])), np.cumsum(held[:-1] * np.diff(old)[:, None], 0)])
    reached = impulse[left] + held[left] * (new - old[left])[:, None]
    ctrl = np.concatenate([np.diff(reached, axis=0) / dt, held[left[-1:] + 1]])
    return {"time": new, "ctrl": ctrl, **parts}


def _derivatives(
    time: Float[np.ndarray, " rows"], x: Float[np.ndarray, "rows k"], measured: Bool[np.ndarray, "rows k"]
) -> tuple[Float[np.ndarray, "rows k"], Float[np.ndarray, "rows k"]]:
    """First and second derivatives of columns, from the cubic through what was measured in seven rows around each."""
    if len(time) < AROUND:
        return np.gradient(x, time, axis=0), np.zeros_like(x)
    unit = np.median(np.diff(time))
    slope, bend = np.zeros(x.shape), np.zeros(x.shape)
    for start in range(0, len(time), AT_ONCE):
        some = np.arange(start, min(start + AT_ONCE, len(time)))
        around = np.clip(some - AROUND // 2, 0, len(time) - AROUND)[:, None] + np.arange(AROUND)
        powers = ((time[around] - time[some, None]) / unit)[..., None] ** np.arange(4)
        weight = np.where(measured[around], 1.0, UNMEASURED)
        normal = np.einsum("rak,rai,raj->rkij", weight, powers, powers)
        target = np.einsum("rak,rai,rak->rki", weight, powers, x[around])
        found = np.linalg.solve(normal, target[..., None])[..., 0]
        slope[some], bend[some] = found[..., 1] / unit, 2.0 * found[..., 2] / unit**2
    return slope, bend
