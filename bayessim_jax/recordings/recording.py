"""A recording as arrays in the simulator's order and in SI units, with masks that say what was measured."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

__all__ = ["CaseRecording", "Span", "resample"]

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


def resample(recording: CaseRecording, dt: float) -> CaseRecording:
    """The same recording on rows `dt` seconds apart, restarted after every break.

    Measurements are interpolated on a line between the rows around them, and count as measured where both were. A
    command is averaged over the step that it is held for, which keeps its impulse.
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
    share = ((new - old[left]) / (old[left + 1] - old[left]))[:, None]

    def between(x: np.ndarray) -> np.ndarray:
        x = x[rows]
        if x.dtype == bool:
            first, second = share.reshape(-1, *[1] * (x.ndim - 1)) == 0, share.reshape(-1, *[1] * (x.ndim - 1)) == 1
            return np.where(first, x[left], np.where(second, x[left + 1], x[left] & x[left + 1]))
        return x[left] * (1 - share) + x[left + 1] * share

    held = recording.ctrl[rows]
    impulse = np.concatenate([np.zeros((1, held.shape[1])), np.cumsum(held[:-1] * np.diff(old)[:, None], 0)])
    reached = impulse[left] + held[left] * (new - old[left])[:, None]
    ctrl = np.concatenate([np.diff(reached, axis=0) / dt, held[left[-1:] + 1]])
    names = ("qpos", "qvel", "sensors", "qpos_measured", "qvel_measured", "sensors_measured", "known")
    return {"time": new, "ctrl": ctrl, **{name: between(getattr(recording, name)) for name in names}}
