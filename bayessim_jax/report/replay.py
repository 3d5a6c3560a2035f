"""A model moving as recorded, beside what simulators predict from the same instants."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from bayessim_jax.recordings.shots import CaseModel
from bayessim_jax.recordings.windows import Windows
from bayessim_jax.report.skeleton import draw_positions, plane_of
from bayessim_jax.report.viewer import animation

__all__ = ["replay_animation"]

FRAMES = 160
WINDOWS = 6
"""Of the first recording, at most."""


def replay_animation(
    model: CaseModel,
    windows: Windows,
    ghosts: Sequence[tuple[str, str, Float[np.ndarray, "windows rows obs"]]],
    which: str,
) -> str:
    """The first recording of some windows, and a ghost for each label, colour and prediction of them."""
    names, wanted = model.channels, model.case.layout.qpos
    first = windows.recording[0]
    chosen = [w for w in range(len(windows)) if windows.recording[w] == first][:WINDOWS]
    rows = [np.concatenate([[True], windows.valid[w]]) for w in chosen]
    time = np.concatenate([(windows.start[w] + windows.time[w])[r] for w, r in zip(chosen, rows, strict=True)])
    recorded = np.concatenate([windows.qpos[w][r] for w, r in zip(chosen, rows, strict=True)])

    def move(predicted: Float[np.ndarray, "windows rows obs"]) -> np.ndarray:
        moved = recorded.copy()
        values = np.concatenate([predicted[w][r] for w, r in zip(chosen, rows, strict=True)])
        for k, name in enumerate(wanted):
            if name in names:
                moved[:, k] = values[:, names.index(name)]
        return moved

    thin = max(len(time) // FRAMES, 1)
    motions = [*(move(predicted) for _, _, predicted in ghosts), recorded]
    drawn = [draw_positions(model.case.model, motion[::thin]) for motion in motions]
    axes = list(plane_of(drawn[-1].reshape(-1, 3)))
    looks = [*((label, colour, 0.55, 6.0) for label, colour, _ in ghosts), ("recording", "", 0.9, 3.0)]
    flat = [each[..., axes].reshape(len(each), -1, 4) for each in drawn]
    bodies = [(*look, lines) for look, lines in zip(looks, flat, strict=True)]
    caption = (
        f"{model.recordings[first].name}, held out: the model as recorded, and simulated from the same instants "
        f"{which}, seen along the {'xyz'[3 - sum(axes)]} axis."
    )
    return animation(time[::thin], bodies, caption)
