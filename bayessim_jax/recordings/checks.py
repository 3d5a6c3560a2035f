"""What a recording's times and columns are checked for before they are used."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float

from bayessim_jax.recordings.wording import Finding, hint, quote

if TYPE_CHECKING:
    from collections.abc import Mapping

    from bayessim_jax.recordings.layout import Layout
    from bayessim_jax.recordings.readers import Table

__all__ = ["MASKED", "SPARSE", "check_columns", "check_missing", "check_time", "gap_limit", "gaps"]

SPARSE = 0.2
"""Share of missing numbers from which a channel is a slower log than the file."""
MASKED = "it is masked there; fill it in where you know it"
GAP = 5.0
"""A step longer than this many median steps is a gap."""
LISTED = 8


def check_columns(file: str, table: Table, layout: Layout, columns: Mapping[str, str]) -> list[Finding]:
    """Columns that are needed and not there, and columns that are there and not used.

    `columns` says for each channel, `time` included, which column it is read from.
    """
    found, names = [], table.names
    unused = [name for name in names if name not in columns.values()]
    needed = ("time", *layout.qpos, *layout.ctrl, *(() if layout.qpos else layout.sensors))
    for channel, column in columns.items():
        if column in names:
            continue
        if column != channel:
            what = f"column {quote(column)}, which case.toml names for {channel}, is missing"
            found.append(Finding("error", file, what, hint(column, names)))
        elif channel in needed:
            what, remedy = f"column {quote(channel)} is missing", _remedy(channel, layout)
            if "did you mean" in (near := hint(channel, unused)):
                remedy = f'{near} Then set column under [channels."{channel}"] in case.toml'
            found.append(Finding("error", file, what, remedy))
    for name in unused[:LISTED]:
        near = hint(name, [c for c in ("time", *layout.channels) if columns.get(c) not in names], 1)
        remedy = f"{near} Otherwise remove it or leave it" if near.startswith("did") else "remove it, or leave it"
        absent = ": the simulator has no such channel" if name.startswith(("joint/", "actuator/", "sensor/")) else ""
        found.append(Finding("warning", file, f"unknown column {quote(name)} is not used{absent}", remedy))
    if more := unused[LISTED:]:
        shown = ", ".join(quote(name) for name in more[:LISTED]) + (", …" if len(more) > LISTED else "")
        what = f"{len(more)} more unknown columns are not used ({shown})"
        found.append(Finding("warning", file, what, "remove them, or leave them"))
    return found


def _remedy(channel: str, layout: Layout) -> str:
    if channel == "time":
        return "add the time of each row in s"
    if channel in layout.ctrl:
        return "add what was commanded; zeros where the actuator was off"
    return "add it; a simulation cannot be started without it"


def check_time(file: str, time: Float[np.ndarray, " rows"]) -> list[Finding]:
    """Errors in the times of a file: they have to be finite and to increase."""
    if len(time) < 3:
        return [Finding("error", file, f"has {len(time)} rows of numbers", "record at least 3 or remove the file")]
    if not np.isfinite(time).all():
        row = int(np.flatnonzero(~np.isfinite(time))[0])
        return [Finding("error", file, "time is not a finite number", "give it, or remove the row", row + 1)]
    steps = np.diff(time)
    for wrong, what, remedy in (
        (steps < 0, "time runs backwards", "sort the rows, or split the file where the clock was set"),
        (steps == 0, "time occurs twice", "keep one row for each time"),
    ):
        if wrong.any():
            row = int(np.flatnonzero(wrong)[0]) + 1
            count = int(wrong.sum())
            more = f" ({count} times in the file)" if count > 1 else ""
            values = (
                f"from {time[row - 1]:.9g} to {time[row]:.9g} s"
                if time[row] != time[row - 1]
                else f"at {time[row]:.9g} s"
            )
            return [Finding("error", file, f"{what}, {values}{more}", remedy, row + 1)]
    return []


def check_missing(
    file: str,
    channel: str,
    values: Float[np.ndarray, " rows"],
    needed: bool = True,
    remedy: str = MASKED,
) -> list[Finding]:
    """NaN and infinite numbers in a channel: a hole where there are some, an error where nothing is left.

    In a channel of a slower log, where many are missing, they are a warning.
    """
    bad = ~np.isfinite(values)
    count, rows = int(bad.sum()), len(values)
    if count == rows:
        severity = "error" if needed else "warning"
        return [Finding(severity, file, f"{channel} holds no number", "record it, or remove the column")]
    if not count or not remedy:
        return []
    row = int(np.flatnonzero(bad)[0])
    word = "is empty or NaN" if np.isnan(values[bad]).all() else "is not finite"
    what = f"{channel} {word} in {count} of {rows} rows, first here" if count > 1 else f"{channel} {word}"
    severity = "hole" if count <= SPARSE * rows else "warning"
    return [Finding(severity, file, what, remedy, row + 1)]


def gap_limit(time: Float[np.ndarray, " rows"]) -> float:
    """The longest step that is still jitter, s."""
    return GAP * float(np.median(np.diff(time))) if len(time) > 1 else np.inf


def gaps(
    file: str, time: Float[np.ndarray, " rows"], channel: str = "", horizon: float = np.inf
) -> tuple[Bool[np.ndarray, " steps"], list[Finding]]:
    """Which steps are gaps, and a line for each of the first ones; `channel` where it is one channel's own times.

    A gap that is longer than a window is a hole: there are two recordings in the file.
    """
    steps = np.diff(time)
    wide = steps > gap_limit(time)
    rows = np.flatnonzero(wide)
    of = f"{channel} has a gap" if channel else "gap"
    found = [
        Finding(
            "hole" if long else "warning",
            file,
            f"{of} of {steps[row]:.4g} s from {time[row]:.9g} to {time[row + 1]:.9g} s",
            "no window is compared across it; " + ("split the file there" if long else "record again if it matters"),
            None if channel else int(row) + 2,
        )
        for row, long in zip(rows[:LISTED], steps[rows] > horizon, strict=False)
    ]
    if len(rows) > LISTED:
        what = f"{len(rows) - LISTED} more gaps, {steps[rows[LISTED:]].sum():.4g} s in all"
        found.append(Finding("warning", file, what, "no window is compared across them"))
    return wide, found
