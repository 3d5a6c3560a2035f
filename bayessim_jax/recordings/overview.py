"""What was found in a case, in lines for a person."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from bayessim_jax.recordings.windows import find_windows
from bayessim_jax.recordings.wording import quote

if TYPE_CHECKING:
    from collections.abc import Iterator

    from bayessim_jax.recordings.loading import LoadedCase
    from bayessim_jax.recordings.recording import CaseRecording

__all__ = ["describe"]

LISTED = 12


def describe(loaded: LoadedCase) -> Iterator[str]:
    """The model, each unknown, each recording: what will be used, and what was estimated."""
    case, layout = loaded.case, loaded.layout
    source = f"system {case.system}" if loaded.model is None else case.model
    sizes = (
        (
            _count(len(layout.joints), "joint"),
            _count(len(layout.ctrl), "actuator"),
            _count(len(layout.sensors), "sensor value"),
        )
        if loaded.model is not None
        else (_count(len(layout.sensors), "observation"), _count(len(layout.ctrl), "action"))
    )
    yield f"case        {quote(case.name)[1:-1]}: {source} with {', '.join(sizes)}"
    for parameter in loaded.parameters:
        value = "" if parameter.nominal is None else f"; {parameter.nominal:.4g} in the model"
        unit = f" {quote(parameter.unit)[1:-1]}" if parameter.unit else ""
        yield f"parameter   {parameter.name} = {', '.join(map(str, parameter.targets))}: {parameter.prior}{unit}{value}"
    counts = [len(find_windows(recording, case.horizon)) for recording in loaded.recordings]
    for recording, count in list(zip(loaded.recordings, counts, strict=True))[:LISTED]:
        yield "recording   " + _recording(recording, count, loaded)
    if more := loaded.recordings[LISTED:]:
        rows, windows = sum(len(r.time) for r in more), _count(sum(counts[LISTED:]), "window")
        yield f"            and {len(more)} more with {rows} rows, {windows}"
    for name, channel in case.channels.items():
        change = f"{channel.scale:g} * {quote(channel.column)}" + (f" + {channel.offset:g}" if channel.offset else "")
        yield f"channel     {quote(name)[1:-1]} = {change}"
    for line in _velocities(loaded):
        yield f"velocity    {line}"
    number = _count(len(loaded.recordings), "recording")
    yield f"windows     {sum(counts)} of {case.horizon:g} s, from {number}{_rest(loaded)}"


def _rest(loaded: LoadedCase) -> str:
    """How much of the recordings lies in no window."""
    total = used = 0.0
    for recording in loaded.recordings:
        time = recording.time
        total += float(np.diff(time)[recording.valid].sum())
        used += float(sum(time[stop] - time[start] for start, stop in find_windows(recording, loaded.case.horizon)))
    return f"; {total - used:.4g} of {total:.4g} s lie in none of them"


def _recording(recording: CaseRecording, count: int, loaded: LoadedCase) -> str:
    steps = np.diff(recording.time)[recording.valid]
    length = recording.time[-1] - recording.time[0]
    jitter = (
        f" (steps {steps.min() * 1e3:.3g} to {steps.max() * 1e3:.3g} ms)"
        if np.ptp(steps) > 0.02 * recording.step
        else ""
    )
    layout = loaded.layout
    measured = (
        ("qpos", layout.qpos, recording.qpos_measured),
        ("qvel", layout.qvel, recording.qvel_measured),
        ("sensors" if layout.qpos else "observations", layout.sensors, recording.sensors_measured),
    )
    parts = [f"{kind} {int(mask.any(0).sum())}/{len(names)}" for kind, names, mask in measured if names]
    parts += [f"ctrl {len(layout.ctrl)}/{len(layout.ctrl)}"] if layout.ctrl else []
    return (
        f"{recording.name}: {len(recording.time)} rows, {length:.4g} s at {1 / recording.step:.4g} Hz{jitter}; "
        f"{', '.join(parts)} measured; {_count(count, 'window')}"
    )


def _velocities(loaded: LoadedCase) -> Iterator[str]:
    """Which velocities were estimated, and over how many rows."""
    for i, name in enumerate(loaded.layout.qvel):
        halves = sorted({r.half_widths[i] for r in loaded.recordings if r.qvel_estimated[i]})
        if halves:
            width = f"{2 * halves[0] + 1}" + (f" to {2 * halves[-1] + 1}" if len(halves) > 1 else "")
            many = _count(sum(bool(r.qvel_estimated[i]) for r in loaded.recordings), "recording")
            yield f"{name} is not measured in {many}: parabolas through {width} rows of its position"


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}{'s' * (number != 1)}"
