"""Numbers that are possible but look like a slip in the unit: degrees, millimetres, milliseconds, a reversed sign."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float

from bayessim_jax.recordings.layout import HINGE, SLIDE
from bayessim_jax.recordings.wording import Finding

if TYPE_CHECKING:
    from bayessim_jax.recordings.layout import Layout
    from bayessim_jax.recordings.recording import CaseRecording

__all__ = ["check_units", "velocity_ratio"]

DEGREES = 180 / np.pi
SEEN = 1_000_000
"""Rows that are looked at."""
SLIPS = {
    HINGE: (
        (DEGREES, "qpos looks like degrees", "qpos", "scale = 0.017453292519943295"),
        (1 / DEGREES, "qvel looks like degrees per second", "qvel", "scale = 0.017453292519943295"),
        (np.pi / 30, "qvel looks like turns per minute", "qvel", "scale = 0.10471975511965977"),
        (1 / (2 * np.pi), "qpos looks like turns", "qpos", "scale = 6.283185307179586"),
        (1000.0, "time or qvel looks a thousand times too small", "qvel", "scale = 1000"),
        (0.001, "qvel looks a thousand times too large", "qvel", "scale = 0.001"),
    ),
    SLIDE: (
        (1000.0, "qpos looks like millimetres", "qpos", "scale = 0.001"),
        (0.001, "qvel looks like millimetres per second", "qvel", "scale = 0.001"),
        (100.0, "qpos looks like centimetres", "qpos", "scale = 0.01"),
    ),
}
BOUNDS = {
    HINGE: (25.0, "rad", DEGREES, "degrees", "0.017453292519943295"),
    SLIDE: (20.0, "m", 1e3, "millimetres", "0.001"),
}


def check_units(recording: CaseRecording, layout: Layout) -> list[Finding]:
    """Suspicions about the units of a recording's channels; nothing is changed."""
    found = _time(recording)
    for name, kind, q, v in layout.joints:
        if kind not in (SLIDE, HINGE) or found:  # speeds say nothing while the time is in doubt
            continue
        suspicion = _ratio(recording, name, kind, q, v) or _range(recording, layout, name, kind, q)
        found += [suspicion] if suspicion else []
    for i, channel in enumerate(layout.sensors):
        if layout.units[channel] == "rad" and not layout.joints:
            suspicion = _travel(recording.name, channel, HINGE, recording.sensors[:SEEN, i])
            found += [suspicion] if suspicion else []
    return found + _commands(recording, layout)


def velocity_ratio(
    time: Float[np.ndarray, " rows"],
    position: Float[np.ndarray, " rows"],
    velocity: Float[np.ndarray, " rows"],
    valid: Bool[np.ndarray, " steps"],
) -> float | None:
    """How many times farther a joint went than its measured velocity says; None where they are not related.

    The slope of displacements over integrated velocities, both over 10 rows.
    """
    dt = np.where(valid, np.diff(time), 0.0)
    went = np.concatenate([[0.0], np.cumsum(np.where(valid, np.diff(position), 0.0))])
    told = np.concatenate([[0.0], np.cumsum((velocity[:-1] + velocity[1:]) / 2 * dt)])
    stride = min(10, max(len(time) // 20, 1))
    moved, said = (x[stride:] - x[:-stride] for x in (went, told))
    power, across, total = float(said @ said), float(said @ moved), float(moved @ moved)
    if not (power > 0 and total > 0) or abs(across) < 0.9 * np.sqrt(power * total):
        return None
    return across / power


def _ratio(recording: CaseRecording, name: str, kind: int, q: int, v: int) -> Finding | None:
    rows = slice(0, SEEN)
    measured = recording.qpos_measured[rows, q] & recording.qvel_measured[rows, v]
    if measured.sum() < 20:
        return None
    valid = recording.valid[: SEEN - 1] & measured[:-1] & measured[1:]
    ratio = velocity_ratio(recording.time[rows], recording.qpos[rows, q], recording.qvel[rows, v], valid)
    if ratio is None or 0.67 < ratio < 1.5:
        return None
    what = f"joint/{name} moves {ratio:.4g} times as far as its qvel says"
    if -1.5 < ratio < -0.67:
        return _suspect(recording.name, what + ", the other way", f"joint/{name}/qvel", "scale = -1")
    for factor, looks, field, change in SLIPS[kind]:
        if 0.8 < ratio / factor < 1.25:
            return _suspect(recording.name, f"{what}: {looks}", f"joint/{name}/{field}", change)
    return _suspect(recording.name, what, f"joint/{name}/qvel", f"scale = {ratio:.4g}")


def _range(recording: CaseRecording, layout: Layout, name: str, kind: int, q: int) -> Finding | None:
    channel, values = f"joint/{name}/qpos", recording.qpos[:SEEN, q]
    if layout.joint_range is None or np.isnan(layout.joint_range[q]).any():
        return _travel(recording.name, channel, kind, values)
    low, high = layout.joint_range[q]
    excess = max(low - values.min(), values.max() - high)
    _, unit, factor, other, scale = BOUNDS[kind]
    if excess <= 0.1 * (high - low):
        return None
    what = f"{channel} goes from {values.min():.4g} to {values.max():.4g} {unit}, its range is {low:.4g} to {high:.4g}"
    reaches = max(abs(values.min()), abs(values.max()))
    if reaches > 3 * max(abs(low), abs(high)) and reaches < 1.2 * factor * max(abs(low), abs(high)):
        return _suspect(recording.name, f"{what}: it looks like {other}", channel, f"scale = {scale}")
    return Finding("suspicion", recording.name, what, f"correct the model's range, or zero and unit of {channel}")


def _travel(file: str, channel: str, kind: int, values: np.ndarray) -> Finding | None:
    most, unit, _, other, scale = BOUNDS[kind]
    travel = float(np.ptp(values))
    if travel < most or np.abs(np.diff(values)).sum() < 1.5 * travel:
        return None  # a wheel turns on and on; what comes back after several turns is no joint's angle
    return _suspect(
        file, f"{channel} swings over {travel:.4g} {unit}: it looks like {other}", channel, f"scale = {scale}"
    )


def _commands(recording: CaseRecording, layout: Layout) -> list[Finding]:
    found = []
    if layout.ctrl_range is None:
        return found
    for i, channel in enumerate(layout.ctrl):
        low, high = layout.ctrl_range[i]
        values = recording.ctrl[:, i]
        if not np.isnan(low) and max(low - values.min(), values.max() - high) > 0.01 * (high - low):
            what = f"{channel} goes from {values.min():.4g} to {values.max():.4g}, its ctrlrange is {low:g} to {high:g}"
            found.append(
                Finding(
                    "suspicion",
                    recording.name,
                    what,
                    f"the simulator clips it; check the unit of {channel} and the model",
                )
            )
    return found


def _time(recording: CaseRecording) -> list[Finding]:
    step = recording.step
    if step < 0.5:
        return []
    scale, unit = (
        (1e-3, "milliseconds") if step < 500 else (1e-6, "microseconds") if step < 5e5 else (1e-9, "nanoseconds")
    )
    return [
        _suspect(recording.name, f"rows are {step:.4g} s apart: time looks like {unit}", "time", f"scale = {scale:g}")
    ]


def _suspect(file: str, what: str, channel: str, change: str) -> Finding:
    return Finding("suspicion", file, what, f'if so, set {change} under [channels."{channel}"] in case.toml')
