"""Windows of recordings put back in a row, for the plots that answer to the mouse."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from bayessim_jax.recordings.shots import CaseModel
from bayessim_jax.recordings.windows import Windows
from bayessim_jax.report.style import quantity
from bayessim_jax.report.viewer import compact, traces

__all__ = ["channel_labels", "window_traces"]

MOST_ROWS = 2400
"""Rows of a recording that are drawn; longer ones are thinned out."""
MOST_RECORDINGS = 8


def window_traces(
    model: CaseModel,
    windows: Windows,
    shown: Int[np.ndarray, " some"],
    values: Mapping[str, Float[np.ndarray, "windows rows obs"]],
    series: Sequence[Mapping[str, Any]],
    caption: str,
) -> str:
    """Some of the windows, recording by recording: for every key of a series what it has in every row."""
    recordings = []
    for index in sorted(set(windows.recording[shown].tolist()))[:MOST_RECORDINGS]:
        parts: dict[str, list[np.ndarray]] = {key: [] for key in ("time", "start", *values)}
        for w in (w for w in shown if windows.recording[w] == index):
            rows = np.concatenate([[True], windows.valid[w]])
            parts["time"].append((windows.start[w] + windows.time[w])[rows])
            parts["start"].append(np.arange(rows.sum()) == 0)
            for key, x in values.items():
                parts[key].append(x[w][rows])
        joined = {key: np.concatenate(x) for key, x in parts.items()}
        thin = max(len(joined["time"]) // MOST_ROWS, 1)
        keep = joined["start"] | (np.arange(len(joined["time"])) % thin == 0)
        data: dict[str, Any] = {key: compact(joined[key][keep].T) for key in values}
        data |= {"time": compact(joined["time"][keep], 7), "start": joined["start"][keep].astype(int).tolist()}
        recordings.append((model.recordings[index].name, data))
    return traces(recordings, channel_labels(model), series, caption)


def channel_labels(model: CaseModel) -> list[str]:
    """What is measured, with its units."""
    units = model.case.layout.units
    return [quantity(channel, units.get(channel, "")) for channel in model.channels]
