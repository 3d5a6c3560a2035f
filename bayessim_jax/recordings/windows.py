"""Windows of a fixed length, each restarted from the recording; none of them spans a gap."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float, Int

if TYPE_CHECKING:
    from collections.abc import Sequence

    from bayessim_jax.recordings.recording import CaseRecording, Span

__all__ = ["Windows", "cut_windows", "find_windows", "stack_windows"]


@dataclass(frozen=True)
class Windows:
    """Windows of one or several recordings, padded with zeros to the longest.

    Row 0 of a window is where the simulation starts. `valid[w, t]` is false on padded transitions; the masks
    `*_measured` are false on padded rows.
    """

    recording: Int[np.ndarray, " windows"]
    """Which recording each window is of."""
    start: Float[np.ndarray, " windows"]
    """When it begins, in the recording's own time, s."""
    time: Float[np.ndarray, "windows rows"]
    """s since the window's start."""
    ctrl: Float[np.ndarray, "windows steps nu"]
    qpos: Float[np.ndarray, "windows rows nq"]
    qvel: Float[np.ndarray, "windows rows nv"]
    sensors: Float[np.ndarray, "windows rows ns"]
    qpos_measured: Bool[np.ndarray, "windows rows nq"]
    qvel_measured: Bool[np.ndarray, "windows rows nv"]
    sensors_measured: Bool[np.ndarray, "windows rows ns"]
    valid: Bool[np.ndarray, "windows steps"]

    def __len__(self) -> int:
        return len(self.start)


def find_windows(
    recording: CaseRecording, horizon: float, stride: float | None = None, lead: float = 0.0
) -> list[Span]:
    """First and last row of every window of `horizon` seconds in a recording.

    The next window starts where the last one ended, or `stride` seconds after its start. A window ends at the row
    nearest to its nominal end; where rows lie so far apart that it would be half as long again, it is not made. The
    first `lead` seconds are left out, unless that costs more than a quarter of the windows.
    """
    found = _find_windows(recording, horizon, stride, 0.0)
    late = _find_windows(recording, horizon, stride, lead) if lead else found
    return late if 4 * len(late) >= 3 * len(found) else found


def _find_windows(recording: CaseRecording, horizon: float, stride: float | None, lead: float) -> list[Span]:
    found, time = [], recording.time
    begin = int(np.searchsorted(time, time[0] + lead * (1 - 1e-6))) if lead else 0
    starts = np.append(np.flatnonzero(recording.known), len(time))
    for first, last in recording.spans:
        if last - first < 2 or np.median(np.diff(time[first : last + 1])) > horizon:
            continue
        slack = float(np.median(np.diff(time[first : last + 1]))) / 2 * (1 + 1e-6)
        row = int(starts[np.searchsorted(starts, max(first, begin))])
        while row < last:
            end = time[row] + horizon
            if end > time[last] + slack:
                break
            stop = int(np.searchsorted(time[: last + 1], end))
            stop = min(stop, last)
            if stop > row + 1 and end - time[stop - 1] < time[stop] - end:
                stop -= 1
            if time[stop] - time[row] <= 1.5 * horizon:
                found.append((row, stop))
            row = stop if stride is None else max(int(np.searchsorted(time, time[row] + stride - slack)), row + 1)
            row = int(starts[np.searchsorted(starts, row)])
    return found


def stack_windows(
    recordings: Sequence[CaseRecording], horizon: float, stride: float | None = None, lead: float = 0.0
) -> Windows:
    """Every window of several recordings in padded arrays; `lead` is that of `find_windows`."""
    found = [(i, r, span) for i, r in enumerate(recordings) for span in find_windows(r, horizon, stride, lead)]
    if not found:
        raise ValueError(f"no recording holds {horizon:g} s without a gap; choose a shorter horizon.")
    rows = max(stop - start for _, _, (start, stop) in found) + 1

    def stacked(name: str, length: int) -> np.ndarray:
        example = getattr(found[0][1], name)
        out = np.zeros((len(found), length, *example.shape[1:]), example.dtype)
        for w, (_, recording, (start, stop)) in enumerate(found):
            part = getattr(recording, name)[start : stop + (length == rows)]
            out[w, : len(part)] = part
        return out

    starts = np.array([r.time[start] for _, r, (start, _) in found])
    time = stacked("time", rows)
    inside = np.arange(rows) <= np.array([stop - start for _, _, (start, stop) in found])[:, None]
    names = ("qpos", "qvel", "sensors", "qpos_measured", "qvel_measured", "sensors_measured")
    return Windows(
        recording=np.array([i for i, _, _ in found]),
        start=starts,
        time=np.where(inside, time - starts[:, None], 0.0),
        ctrl=stacked("ctrl", rows - 1),
        valid=stacked("valid", rows - 1),
        **{name: stacked(name, rows) for name in names},
    )


def cut_windows(windows: Windows, rows: int) -> Windows:
    """Windows in equal pieces of about so many rows each; what is left over at the end of a window is dropped."""
    steps = windows.valid.shape[1]
    length = steps // max(round(steps / rows), 1)
    parts = []
    for first in range(0, steps - length + 1, length):
        each = {}
        for f in dataclasses.fields(windows):
            values = getattr(windows, f.name)
            if values.ndim > 1:
                more = length if f.name in ("ctrl", "valid") else length + 1
                values = values[:, first : first + more]
            each[f.name] = values
        time = each["time"]
        each["start"] = each["start"] + time[:, 0]
        each["time"] = np.where(time >= time[:, :1], time - time[:, :1], 0.0)
        parts.append(each)
    joined = {name: np.stack([part[name] for part in parts], 1) for name in parts[0]}
    flat = {name: values.reshape(len(windows) * len(parts), *values.shape[2:]) for name, values in joined.items()}
    held = flat["valid"].any(axis=1)
    return Windows(**{name: values[held] for name, values in flat.items()})
