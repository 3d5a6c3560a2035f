"""Which recordings are kept to judge by: some whose commands are like those of the others.

Machines are recorded in kinds of motion, and what a simulator lacks may show in one kind alone. A rule that counts
along the list, every third say, keeps all of one kind from the fit where kinds come in turn. So the two groups are
chosen to be as alike as can be, by the energy distance between them, in what was done to the machine; what it did is
not looked at.

Source: Joseph and Vakayil 2022 (splitting by energy distance); Székely and Rizzo 2013 (energy distance)
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float

if TYPE_CHECKING:
    from collections.abc import Sequence

    from bayessim_jax.recordings.recording import CaseRecording

__all__ = ["choose_held_out", "describe_inputs"]

STILL = 1e-3
"""Of how commands scatter or change over all recordings: less is nothing."""


def describe_inputs(recordings: Sequence[CaseRecording]) -> Float[np.ndarray, "recordings k"]:
    """What was done to the machine, one row a recording.

    Of each command the mean, in units of how it scatters over all recordings, and the logarithms of how it scatters
    and of how fast it changes (root mean square). Where there are no commands, the positions and velocities of the
    joints at the beginning, in units of their standard deviation over recordings.
    """
    if not any(r.ctrl.any() for r in recordings):
        started = np.array([np.concatenate([r.qpos[0], r.qvel[0]]) for r in recordings])
        return (started - started.mean(0)) / np.maximum(started.std(0), 1e-9)
    every = np.concatenate([r.ctrl for r in recordings]).std(0)
    mean, scatter, speed = (np.array(part) for part in zip(*map(_describe_commands, recordings), strict=True))
    logs = [np.log(np.maximum(x / np.maximum(x.max(0), 1e-300), STILL)) for x in (scatter, speed)]
    return np.concatenate([(mean - mean.mean(0)) / np.where(every > 0, every, 1.0), *logs], axis=1)


def choose_held_out(points: Float[np.ndarray, "recordings k"]) -> Bool[np.ndarray, " recordings"]:
    """About a quarter of the points, one at least, that are like the others; of one point none.

    From points spread over the list on, two change places as long as that brings the groups nearer: the energy distance
    2 E|x − y| − E|x − x'| − E|y − y'|, with x, x' held out and y, y' not.
    """
    count = len(points)
    held = np.zeros(count, bool)
    if count < 2:
        return held
    period = max(round(count / max(round(count / 4), 1)), 2)
    held[period - 1 :: period] = True
    apart = np.linalg.norm(points[:, None] - points[None], axis=-1)
    sizes = held.sum(), count - held.sum()
    distance = _energy(*_sums(apart, held), apart.sum(), sizes)
    while True:
        inside, outside = np.flatnonzero(held), np.flatnonzero(~held)
        to_held, to_rest = apart[:, held].sum(1), apart[:, ~held].sum(1)
        swapped = apart[np.ix_(inside, outside)]
        within, without = _sums(apart, held)
        within = within + 2 * (to_held[outside][None] - to_held[inside][:, None] - swapped)
        without = without + 2 * (to_rest[inside][:, None] - to_rest[outside][None] - swapped)
        after = _energy(within, without, apart.sum(), sizes)
        best = np.unravel_index(np.argmin(after), after.shape)
        if after[best] >= distance - 1e-9:
            return held
        distance = after[best]
        held[inside[best[0]]], held[outside[best[1]]] = False, True


def _describe_commands(recording: CaseRecording) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean, standard deviation and root mean square rate of each command."""
    ctrl, valid = recording.ctrl, recording.valid
    rate = np.diff(ctrl, axis=0)[valid] / np.diff(recording.time)[valid, None]
    return ctrl.mean(0), ctrl.std(0), np.sqrt((rate**2).mean(0)) if valid.any() else np.zeros(ctrl.shape[1])


def _sums(apart: Float[np.ndarray, "n n"], held: Bool[np.ndarray, " n"]) -> tuple[float, float]:
    """Distances within the points held out, and within the others, summed."""
    return apart[np.ix_(held, held)].sum(), apart[np.ix_(~held, ~held)].sum()


def _energy(
    within: float | np.ndarray, without: float | np.ndarray, total: float, sizes: tuple[int, int]
) -> np.ndarray:
    held, rest = sizes
    between = (total - within - without) / 2
    return np.asarray(2 * between / (held * rest) - within / held**2 - without / rest**2)
