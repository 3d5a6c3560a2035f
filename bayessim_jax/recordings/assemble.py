"""From the columns of a file to a recording, and everything that was noticed on the way."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from bayessim_jax.recordings.checks import (
    MASKED,
    SPARSE,
    check_columns,
    check_missing,
    check_time,
    gap_limit,
    gaps,
)
from bayessim_jax.recordings.readers import Table, read_table
from bayessim_jax.recordings.recording import CaseRecording
from bayessim_jax.recordings.states import fill_in, joint_velocities
from bayessim_jax.recordings.units import check_units
from bayessim_jax.recordings.wording import CaseError, Finding

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from bayessim_jax.recordings.case import ChannelSpec
    from bayessim_jax.recordings.layout import Layout

__all__ = ["read_recording"]


def read_recording(
    path: Path, layout: Layout, channels: Mapping[str, ChannelSpec], horizon: float = np.inf
) -> tuple[CaseRecording | None, list[Finding]]:
    """Read one file into the simulator's arrays; without a recording where an error was found. Never raises for it.

    Gaps that are longer than `horizon` are told as holes.
    """
    with np.errstate(all="ignore"):  # absurd numbers overflow in what is computed of them only
        return _read(path, layout, channels, horizon)


def _read(
    path: Path, layout: Layout, channels: Mapping[str, ChannelSpec], horizon: float
) -> tuple[CaseRecording | None, list[Finding]]:
    file = path.name
    columns = {name: channels[name].column if name in channels else name for name in ("time", *layout.channels)}
    try:
        table = read_table(path, frozenset(columns.values()))
    except CaseError as error:
        return None, [error.finding]
    found = check_columns(file, table, layout, columns)
    if any(f.severity == "error" for f in found):
        return None, found
    data = {}
    for name, column in columns.items():
        if column in table.columns:
            spec = channels.get(name)
            values = table.columns[column]
            data[name] = values if spec is None else spec.scale * values + spec.offset
    time = data.pop("time")
    if errors := check_time(file, time):
        return None, found + errors
    for name, values in data.items():
        found += check_missing(file, name, values, name not in layout.qvel, _remedy(name, values, table, layout))
    if any(f.severity == "error" for f in found):
        return None, found
    recording, more = _assemble(file, time, data, layout, table.asynchronous, horizon)
    found += more
    if not recording.valid.any():
        what = "holds no two rows without a gap and with known commands"
        return None, [*found, Finding("error", file, what, "record again or remove it")]
    return recording, found + check_units(recording, layout)


def _remedy(name: str, values: np.ndarray, table: Table, layout: Layout) -> str:
    """What to do about numbers that are missing; nothing where they were not due."""
    if table.asynchronous:
        return ""
    if name not in layout.ctrl:
        return MASKED
    if np.isfinite(values).mean() < 1 - SPARSE:
        return "it is held where it is missing; fill it in where it changed"
    return "no window is compared there; fill in what was commanded"


def _assemble(
    file: str, time: np.ndarray, data: dict[str, np.ndarray], layout: Layout, asynchronous: bool, horizon: float
) -> tuple[CaseRecording, list[Finding]]:
    wide, found = gaps(file, time, horizon=horizon)
    valid = ~wide
    ctrl = np.zeros((len(time), len(layout.ctrl)))
    for i, name in enumerate(layout.ctrl):
        ctrl[:, i], unknown, more = _held(file, name, data.pop(name), time, asynchronous)
        valid &= ~unknown[:-1]
        found += more
    qpos, qpos_measured = np.zeros((len(time), len(layout.qpos))), np.zeros((len(time), len(layout.qpos)), bool)
    known = np.ones(len(time), bool)
    turning = {q for q, _ in layout.hinges}
    for i, name in enumerate(layout.qpos):
        values = data.pop(name)
        if i in turning:
            values, more = _unwrapped(file, name, values)
            found += more
        qpos_measured[:, i] = np.isfinite(values)
        if asynchronous:
            found += gaps(file, time[qpos_measured[:, i]], name, horizon)[1]
        qpos[:, i], near = fill_in(time, values)
        known &= near
    found += _normalized(file, qpos, layout)
    qvel, qvel_measured, half_widths = joint_velocities(time, qpos, qpos_measured, data, layout, wide)
    known &= np.isfinite(qvel).all(1)
    sensors, seen = np.zeros((len(time), len(layout.sensors))), np.zeros((len(time), len(layout.sensors)), bool)
    for i, name in enumerate(layout.sensors):
        values = data.pop(name, None)
        if values is not None and np.isfinite(values).any():
            seen[:, i] = np.isfinite(values)
            found += gaps(file, time[seen[:, i]], name, horizon)[1] if asynchronous else []
            sensors[:, i], near = fill_in(time, values)
            known &= near | bool(layout.qpos)
    parts = (time, ctrl, qpos, np.nan_to_num(qvel), sensors, qpos_measured, qvel_measured, seen, valid, known)
    return CaseRecording(file, *parts, half_widths=half_widths), found


def _held(
    file: str, name: str, values: np.ndarray, time: np.ndarray, asynchronous: bool
) -> tuple[np.ndarray, np.ndarray, list[Finding]]:
    """A command at every row, held between rows of a slower log; where it is unknown, and what is to be said."""
    given = np.isfinite(values)
    if given.all():
        return values, ~given, []
    last = np.maximum.accumulate(np.where(given, np.arange(len(time)), -1))
    held = np.where(last >= 0, values[np.maximum(last, 0)], 0.0)
    if not asynchronous and given.mean() >= 1 - SPARSE:
        return held, ~given, []
    unknown = last < 0
    if not asynchronous:
        unknown |= time - time[np.maximum(last, 0)] > gap_limit(time[given])
    found = []
    if unknown.any():
        row = int(np.flatnonzero(unknown)[0]) + 1
        what = f"{name} is not known in {unknown.sum()} rows, first here"
        found.append(Finding("warning", file, what, "no window is compared there; log it from the start", row))
    return held, unknown, found


def _unwrapped(file: str, name: str, values: np.ndarray) -> tuple[np.ndarray, list[Finding]]:
    """An angle whose sensor starts again after a turn, made continuous."""
    rows = np.flatnonzero(np.isfinite(values))
    jumps = np.diff(values[rows])
    sizes = np.pad(np.abs(jumps), 1)
    lonely = sizes[1:-1] > 3 * np.maximum(sizes[:-2], sizes[2:])  # a fast joint in another unit jumps again and again
    turns = np.where(lonely & (np.abs(np.abs(jumps) / (2 * np.pi) - 1) < 0.1), np.sign(jumps), 0.0)
    if not turns.any() or np.ptp(values[rows]) > 2.02 * np.pi:
        return values, []
    out = values.copy()
    out[rows[1:]] -= 2 * np.pi * np.cumsum(turns)
    row = int(rows[1:][turns != 0][0]) + 1
    what = f"{name} jumps by a whole turn {int(np.abs(turns).sum())} times, first here"
    return out, [Finding("warning", file, what, "it is made continuous; log it without wrapping", row)]


def _normalized(file: str, qpos: np.ndarray, layout: Layout) -> list[Finding]:
    """Unit quaternions without jumps between q and −q, which turn alike, in place; a warning for other lengths."""
    found = []
    for q, _ in layout.quaternions:
        norm = np.linalg.norm(qpos[:, q : q + 4], axis=1)
        row = int(np.abs(norm - 1).argmax())
        if abs(norm[row] - 1) > 0.01:
            what = f"quaternion {layout.qpos[q]} … /{layout.qpos[q + 3][-1]} has length {norm[row]:.3g}"
            found.append(Finding("warning", file, what, "it is normalized; log w, x, y, z", row + 1))
        flips = np.concatenate([[False], (qpos[1:, q : q + 4] * qpos[:-1, q : q + 4]).sum(1) < 0])
        sign = np.where(np.cumsum(flips) % 2, -1.0, 1.0)
        qpos[:, q : q + 4] *= (sign / np.maximum(norm, 1e-9))[:, None]
    return found
