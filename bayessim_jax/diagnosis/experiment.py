"""The next experiment: of a library of motions, the one whose outcome best separates what recordings could not.

Every motion is simulated under every member of a confusion set, each with what was fitted to it. What one member shows
is then explained by another as well as its parameters and the initial state allow, near what the recordings say of
them. What is left, in units of the noise, is the expected difference of their log likelihoods:

    D_ij = ½ min_x ‖(y_i − y_j − J_j x) / σ‖² + ½ xᵀ P_j x

Motions stay within the commands that were recorded, and positions within one and a half times their recorded range.

Source: Box and Hill 1967 (designs that discriminate); Hunter and Reiner 1965
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from bayessim_jax.diagnosis.bench import Bench
from bayessim_jax.diagnosis.verdict import Entry
from bayessim_jax.inference.replay import Inputs
from bayessim_jax.inference.shooting import COMPILER_OPTIONS, Shots, expand

__all__ = ["Experiment", "Motions", "commands", "design"]

SHARES = (0.3, 1.0)
"""Of the recorded commands, how strong the motions of the library are."""
BEYOND = 0.5
"""Part of a position's recorded range by which a motion may leave it."""
ENOUGH = 3.0
"""Expected nats below which an experiment separates nothing."""


@dataclass(frozen=True)
class Motions:
    """A library: what is commanded, and where the machine starts."""

    names: list[str]
    ctrl: Float[np.ndarray, "motions rows nu"]
    qpos: Float[np.ndarray, "motions nq"]
    qvel: Float[np.ndarray, "motions nv"]


@dataclass(frozen=True)
class Experiment:
    """A motion, and how well it separates two members of a confusion set."""

    name: str
    ctrl: Float[np.ndarray, "rows nu"]
    qpos: Float[np.ndarray, " nq"]
    qvel: Float[np.ndarray, " nv"]
    dt: float
    pair: tuple[list[str], list[str]]
    """The members that it separates least."""
    nats: float
    """Expected difference of their log likelihoods."""


def commands(
    recorded: Float[np.ndarray, "rows nu"], names: Sequence[str], rows: int, dt: float
) -> list[tuple[str, Float[np.ndarray, "rows nu"]]]:
    """Command signals around the mean of the recorded ones, all actuators together and each by itself."""
    t = np.arange(rows) * dt
    length = rows * dt
    fast = min(0.1 / dt, 8.0 / length * 4)
    shapes = {
        "nothing": np.zeros(rows),
        "a slow triangle": 2 * np.abs(2 * ((t / length + 0.25) % 1) - 1) - 1,
        "four steps": np.array([0.5, 1.0, -0.5, -1.0])[np.minimum((4 * t / length).astype(int), 3)],
        "a square wave": np.sign(np.sin(2 * np.pi * 3 * t / length + 1e-9)),
        "a chirp": np.sin(2 * np.pi * (t / length + 0.5 * (fast - 1 / length) * t**2 / length)),
        "two sines": 0.6 * np.sin(2 * np.pi * 2 * t / length) + 0.4 * np.sin(2 * np.pi * 7.3 * t / length),
    }
    center, size = recorded.mean(0), np.abs(recorded - recorded.mean(0)).max(0)
    count = recorded.shape[1]
    groups = [(f"on {name}", np.arange(count) == i) for i, name in enumerate(names)]
    groups = [("on every actuator", np.ones(count, bool)), *groups] if count > 1 else groups
    library = [("all commands at zero", np.zeros((rows, count)))] if count else [("a release", np.zeros((rows, 0)))]
    for where, chosen in groups:
        for what, shape in shapes.items():
            for share in SHARES if what != "nothing" else ():
                signal = center + share * size * np.where(chosen, shape[:, None], 0.0)
                library.append((f"{what} {where}, {share:.0%} of the recorded commands", signal))
    return library


def design(bench: Bench, members: Sequence[Entry], motions: Motions, shots: Shots, dt: float) -> Experiment | None:
    """The motion that separates the members best; None where the library holds none that does.

    `shots` are windows of the recordings, which say how the machine starts and how far it moved.
    """
    count, rows = motions.ctrl.shape[:2]
    past = shots.inputs.past
    inputs = Inputs(
        jnp.asarray(motions.qpos),
        jnp.asarray(motions.qvel),
        jnp.asarray(motions.ctrl),
        jnp.broadcast_to(jnp.asarray(motions.ctrl[:, :1]), (count, past.shape[1], past.shape[2])),
        jnp.zeros(count),
    )
    channels = shots.y.shape[-1]
    blank = Shots(
        inputs, jnp.zeros((count, rows + 1, channels)), jnp.ones((count, rows + 1, channels), bool), shots.spread
    )
    shown = [bench.replay(entry.candidate, entry.fit.z, blank) for entry in members]
    low, high = (np.nanquantile(np.where(shots.measured, shots.y, np.nan), q, axis=(0, 1)) for q in (0.0, 1.0))
    room = BEYOND * (high - low)
    places = np.array([name.endswith("/qpos") for name in bench.channels])
    fine = np.ones(count, bool)
    for y in shown:
        with np.errstate(invalid="ignore"):
            inside = (y >= low - room) & (y <= high + room) | ~places
        fine &= np.isfinite(y).all((1, 2)) & inside.all((1, 2))
    apart = np.zeros((len(members), len(members), count))
    for j, entry in enumerate(members):
        for i, y in enumerate(shown):
            if i != j:
                left = _separate_from(bench, entry, dataclasses.replace(blank, y=jnp.asarray(y)), members[i].fit.sigma)
                apart[i, j] = np.where(fine, np.nan_to_num(np.asarray(left)), 0.0)
    pairs = [(i, j) for i in range(len(members)) for j in range(i)]
    between = np.array([np.minimum(apart[i, j], apart[j, i]) for i, j in pairs])
    worth = (1.0 - np.exp(-between / ENOUGH)).sum(0) + 1e-9 * between.min(0)
    k = int(np.argmax(worth))
    least = int(np.argmin(between[:, k]))
    if between[:, k].max() < ENOUGH:
        return None
    i, j = pairs[least]
    pair = (members[j].names, members[i].names)
    return Experiment(
        motions.names[k], motions.ctrl[k], motions.qpos[k], motions.qvel[k], dt, pair, float(between[least, k])
    )


def _separate_from(bench: Bench, entry: Entry, shots: Shots, sigma: Array) -> Array:
    """Of every motion, what one member cannot explain of what another one made of it, nats."""
    used, own = bench.used(entry.candidate), bench.setup(entry.candidate, shots)
    x, precision = entry.fit.z[:used], entry.fit.precision[:used, :used]
    return _separate(bench.simulator(entry.candidate), own, x, precision, sigma, bench.step)


@partial(jax.jit, static_argnames=("predict", "step"), compiler_options=COMPILER_OPTIONS)
def _separate(predict: Any, shots: Shots, x: Array, precision: Array, sigma: Array, step: float) -> Array:
    """Of every motion, what another model cannot explain of the one that made `shots.y`, nats."""
    n = shots.spread.size
    r, slopes = expand(predict, shots, x, jnp.zeros((shots.y.shape[0], n)), sigma, step)
    prior = (
        jnp.zeros((x.size + n, x.size + n)).at[: x.size, : x.size].set(precision).at[x.size :, x.size :].set(jnp.eye(n))
    )

    def left(r: Array, slopes: Array) -> Array:
        pull = slopes @ r
        return 0.5 * (r @ r - pull @ jnp.linalg.solve(slopes @ slopes.T + prior, pull))

    return jax.vmap(left)(r, slopes)
