"""Velocities that come later than the positions that they belong to, as behind a filter.

A velocity that is late by T is no velocity of the state that a simulation starts from, and no prediction fits it and
the positions together. Over a piece of a recording

    Δq − ∫ v dt = T Δv

whatever moves the machine. Semi-implicit Euler, too, adds to a position the velocity at the end of each step h, and is
late by h/2: that much a simulator's time step explains (`stepping`), also of recordings of a model that is believed to
take steps of Runge and Kutta. Where commands are held from row to row and a stiff drive follows them within one, a
velocity that changes between rows at a rate a is late by

    1 / (1 − exp(−a dt)) − 1 / (a dt) − 1/2

of a row at most, which trapezoids do not see. What is later comes from a filter, which made it of the positions:
without it nothing is lost that these do not hold.
"""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

import mujoco
import numpy as np
from jaxtyping import Bool, Float

from bayessim_jax.mechanics import free_inertia
from bayessim_jax.recordings.states import slopes_between
from bayessim_jax.recordings.windows import stack_windows
from bayessim_jax.recordings.wording import Finding

if TYPE_CHECKING:
    from collections.abc import Sequence

    from bayessim_jax.recordings.layout import Layout
    from bayessim_jax.recordings.recording import CaseRecording

__all__ = ["BLUR", "Lateness", "find_late", "is_runge_kutta", "measure_lag", "without_velocities"]

PIECE, FEWEST = 0.15, 30
"""Seconds over which positions and velocities are compared, and how many such pieces it takes at least."""
BLUR = 0.05
"""Of the time step's own lag: standard deviation for what trapezoids leave of an integral."""
SURE = 4.0
"""Standard deviations by which a velocity has to be late."""
VISIBLE = 0.1
"""Of its noise: what the lag has to change of it."""
STRETCH, SEEN = 1.0, 1_000_000
"""Seconds of the windows that are looked at, at least, and rows of all recordings, at most."""


@dataclasses.dataclass(frozen=True)
class Lateness:
    """What was found of a case's velocities."""

    channels: tuple[str, ...] = ()
    """Those that are later than a time step explains."""
    stepped: bool = False
    """Whether others are late as steps of semi-implicit Euler make them, and the model takes steps of another kind."""


def find_late(
    recordings: Sequence[CaseRecording], layout: Layout, model: mujoco.MjModel, horizon: float
) -> tuple[Lateness, list[Finding]]:
    """Velocities of hinges and slides that come later than their positions, and a warning of those not to be used.

    A lag that changes a velocity by less than a tenth of its noise is none.
    """
    if not any(r.qvel_measured.any() for r in recordings):
        return Lateness(), []
    try:
        windows = stack_windows(_first_rows(recordings), max(horizon, STRETCH))
    except ValueError:
        return Lateness(), []
    late, found, stepped, own = [], [], False, 0.5 * float(model.opt.timestep)
    held = _lags_of_held_commands(model, windows.qpos[0, 0], float(np.median(np.diff(windows.time, axis=1))))
    for name, q, v in layout.single:
        there = windows.qpos_measured[:, :, q] & windows.qvel_measured[:, :, v]
        velocity = windows.qvel[:, :, v]
        for lag, sd in measure_lag(windows.time, windows.qpos[:, :, q], velocity, there):
            least, (moves, noise) = SURE * np.hypot(sd, BLUR * own), _changes(windows.time, velocity, there)
            beyond = lag - held[v]
            if beyond - own > least and (beyond - own) * moves > VISIBLE * noise:
                late.append(layout.qvel[v])
                what = f"joint/{name}/qvel is {1e3 * lag:.2g} ms later than joint/{name}/qpos, as behind a filter"
                remedy = "it is not used, velocities are taken from the positions; record it without a filter"
                named = (r.name for r in recordings if r.qvel_measured[:, v].any())
                found += [Finding("warning", file, what, remedy) for file in named]
            elif beyond > least and beyond * moves > VISIBLE * noise:
                stepped = is_runge_kutta(model)
    return Lateness(tuple(late), stepped), found


def is_runge_kutta(model: mujoco.MjModel) -> bool:
    """Whether a model takes steps of Runge and Kutta."""
    return bool(model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4)


def without_velocities(
    recordings: Sequence[CaseRecording], layout: Layout, channels: Sequence[str]
) -> tuple[CaseRecording, ...]:
    """The same recordings with some velocities of hinges and slides taken from the positions."""
    places = [(q, v) for _, q, v in layout.single if layout.qvel[v] in channels]

    def free(r: CaseRecording) -> CaseRecording:
        qvel, measured, known, halves = r.qvel.copy(), r.qvel_measured.copy(), r.known.copy(), list(r.half_widths)
        for q, v in places:
            slopes, halves[v] = slopes_between(r.time, r.qpos[:, q], r.qpos_measured[:, q], ~r.valid)
            qvel[:, v], measured[:, v] = np.nan_to_num(slopes), False
            known &= np.isfinite(slopes)
        return dataclasses.replace(r, qvel=qvel, qvel_measured=measured, known=known, half_widths=tuple(halves))

    return tuple(free(r) for r in recordings) if places else tuple(recordings)


def measure_lag(
    time: Float[np.ndarray, "windows rows"],
    q: Float[np.ndarray, "windows rows"],
    v: Float[np.ndarray, "windows rows"],
    there: Bool[np.ndarray, "windows rows"],
) -> list[tuple[float, float]]:
    """By how many seconds of its own motion a joint's velocity is late, with a standard deviation, if that is told.

    A regression of Δq − ∫ v dt, the integral by trapezoids, on Δv, and on Δq for scales that are off. The noise of Δv
    makes a slope smaller; it is known from second differences. Pieces that lie far off, such as those of an impact
    between two rows, are left out.
    """
    steps = np.diff(time, axis=1)
    passed = np.cumsum(0.5 * (v[:, 1:] + v[:, :-1]) * steps, axis=1)
    travel = np.concatenate([np.zeros((len(v), 1)), passed], axis=1)
    rows = round(PIECE / float(np.median(steps[steps > 0]))) if (steps > 0).any() else 0
    first = np.arange(0, time.shape[1] - rows, max(rows, 1))
    if rows < 2 or not first.size:
        return []
    whole = np.all(np.lib.stride_tricks.sliding_window_view(there, rows + 1, axis=1), axis=-1)[:, first]
    if whole.sum() < FEWEST:
        return []
    dq, dv, moved = ((x[:, first + rows] - x[:, first])[whole] for x in (q, v, travel))
    noise = 2.0 * _noise(v, there) ** 2
    columns, ahead = np.stack([dv, dq, np.ones_like(dv)], axis=1), dq - moved
    kept = np.ones(len(dv), bool)
    for _ in range(3):
        slopes = np.linalg.lstsq(columns[kept], ahead[kept], rcond=None)[0]
        left = ahead - columns @ slopes
        kept = np.abs(left) <= 4.0 * np.median(np.abs(left)) / 0.6745
    beside = columns[kept, 1:]
    alone = dv[kept] - beside @ np.linalg.lstsq(beside, dv[kept], rcond=None)[0]
    size = float(alone @ alone) - noise * kept.sum()
    if size < 2.0 * noise * kept.sum() or size <= 0.0:
        return []
    sd = float(np.sqrt((left[kept] ** 2).sum() / (kept.sum() - 3) * (alone @ alone))) / size
    return [(float(alone @ ahead[kept]) / size, sd)]


def _lags_of_held_commands(model: mujoco.MjModel, pose: Float[np.ndarray, " nq"], row: float) -> np.ndarray:
    """Seconds by which each velocity seems late at most because commands jump at rows, [nv].

    A joint follows at the rate of its damping and its servos' over the inertia that it shows while others are free;
    what nothing drives, or drives through a state of its own, does not jump.
    """
    dampings, jumps = model.dof_damping.copy(), np.zeros(model.nv, bool)
    for i in range(model.nu):
        if model.actuator_trntype[i] == mujoco.mjtTrn.mjTRN_JOINT:
            v = model.jnt_dofadr[model.actuator_trnid[i, 0]]
            dampings[v] -= model.actuator_gear[i, 0] ** 2 * model.actuator_biasprm[i, 2]
            jumps[v] |= model.actuator_dyntype[i] == mujoco.mjtDyn.mjDYN_NONE
    passed = np.maximum(row * dampings / free_inertia(model, mujoco.MjData(model), pose), 1e-2)
    return np.where(jumps, row * (1.0 / -np.expm1(-passed) - 1.0 / passed - 0.5), 0.0)


def _first_rows(recordings: Sequence[CaseRecording]) -> list[CaseRecording]:
    """The recordings as far as they are looked at, an equal share of each at most."""
    names = ("time", "ctrl", "qpos", "qvel", "sensors", "qpos_measured", "qvel_measured", "sensors_measured", "known")
    count = SEEN // len(recordings)
    return [
        dataclasses.replace(r, valid=r.valid[: count - 1], **{name: getattr(r, name)[:count] for name in names})
        for r in recordings
    ]


def _changes(
    time: Float[np.ndarray, "windows rows"], v: Float[np.ndarray, "windows rows"], there: Bool[np.ndarray, "..."]
) -> tuple[float, float]:
    """Root mean square of dv/dt, and the noise of v."""
    noise, both = _noise(v, there), there[:, 1:] & there[:, :-1]
    step = float(np.median(np.diff(time, axis=1)[both]))
    return float(np.sqrt(max((np.diff(v, axis=1)[both] ** 2).mean() - 2.0 * noise**2, 0.0))) / step, noise


def _noise(v: Float[np.ndarray, "windows rows"], there: Bool[np.ndarray, "windows rows"]) -> float:
    """Standard deviation of white noise, from second differences, whatever jumps there are."""
    known = there[:, :-2] & there[:, 1:-1] & there[:, 2:]
    return float(np.median(np.abs(np.diff(v, 2, axis=1)[known]))) / 0.6745 / np.sqrt(6.0)
