"""A first real recording: the length of a free-swinging arm, learned window by window with `online.update`.

    python scripts/real_pendulum.py PATH/TO/multiarm_single/recordings/*.csv

Each file has columns `time` (s), `joint/hinge/qpos` (rad, 0 = hanging) and `joint/hinge/qvel` (rad/s). The simulator is
a pendulum with viscous friction; nothing acts on it. The posterior's length is compared with the one that the period of
the oscillation gives, L = g (T₀/2π)², with T₀ the period corrected for the amplitude.
"""

from __future__ import annotations

import sys
from itertools import pairwise
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from bayessim_jax import online
from bayessim_jax.contracts import Box, Recording
from bayessim_jax.inference import Schedule, recurrent_mixture
from bayessim_jax.learning import Fixed, RandomPolicy
from bayessim_jax.rollout import assemble
from bayessim_jax.systems import from_functions

GRAVITY, DT, STEPS, STRIDE, SUBSTEPS = 9.81, 0.02, 50, 5, 4


def free_pendulum() -> Any:
    """φ̈ = −(g/L) sin φ − b φ̇ with θ = (L, b); reset anywhere on the orbits that were recorded."""

    def step(theta: Any, x: Any, action: Any) -> Any:
        for _ in range(SUBSTEPS):  # semi-implicit Euler
            rate = x[1] - DT / SUBSTEPS * (GRAVITY / theta[0] * jnp.sin(x[0]) + theta[1] * x[1])
            x = jnp.stack([x[0] + DT / SUBSTEPS * rate, rate])
        return x

    return from_functions(
        parameters=Box.create(length=(0.05, 0.5, "m"), friction=(0.0, 0.5, "1/s")),
        observations=Box.create(angle=(-1.7, 1.7, "rad"), rate=(-14.0, 14.0, "rad/s")),
        actions=Box.create(),
        noise=jnp.array([0.005, 0.1]),
        dt=DT,
        reset=lambda key, theta: jax.random.uniform(key, (2,), minval=-1.0, maxval=1.0) * jnp.array([1.7, 14.0]),
        step=step,
    )


def windows(path: Path) -> list[Recording]:
    """Cut a file into recordings of 50 steps of 20 ms."""
    rows = np.genfromtxt(path, delimiter=",", skip_header=1)[::STRIDE, 1:3]
    starts = range(0, len(rows) - STEPS, STEPS)
    nothing, zero, all_valid = jnp.zeros((STEPS, 0)), jnp.zeros(STEPS), jnp.ones(STEPS, bool)
    return [assemble(DT, jnp.asarray(rows[i : i + STEPS + 1]), nothing, zero, all_valid) for i in starts]


def length_from_period(path: Path) -> float:
    """L = g (T₀/2π)², T₀ = T / (1 + a²/16 + 11 a⁴/3072), from the upward zero crossings of the angle."""
    time, angle = np.genfromtxt(path, delimiter=",", skip_header=1)[:, :2].T
    up = np.flatnonzero((angle[:-1] < 0) & (angle[1:] >= 0))
    crossings = time[up] - angle[up] * (time[up + 1] - time[up]) / (angle[up + 1] - angle[up])
    lengths = []
    for begin, end in pairwise(crossings):
        a = np.abs(angle[(time >= begin) & (time <= end)]).max()
        small = (end - begin) / (1 + a**2 / 16 + 11 * a**4 / 3072)
        lengths.append(GRAVITY * (small / (2 * np.pi)) ** 2)
    return float(np.median(lengths))


def infer(recordings: list[Recording], seed: int = 0, simulations: int = 400) -> tuple[Any, Any]:
    """One call of `online.update` for each recording; returns the last belief and the length's mean ± sd by round."""
    system = free_pendulum()
    learner = Fixed(RandomPolicy(system.actions))
    setup = online.Setup.create(
        system, learner, estimator=recurrent_mixture(schedule=Schedule(draws=simulations)), simulations=simulations
    )
    key = jax.random.key(seed)
    state = online.init(key, setup)
    update = jax.jit(online.update)
    trace = []
    for recording in recordings:
        state, info = update(key, setup, state, jax.tree.map(lambda leaf: leaf[None], recording))
        mean, sd = info.belief.mean(), jnp.sqrt(jnp.diagonal(info.belief.covariance()))
        trace.append((float(mean[0]), float(sd[0]), float(mean[1])))
    return state.belief, trace


def main() -> None:
    """Print the length round by round, and the period's."""
    paths = [Path(p) for p in sys.argv[1:]]
    if not paths:
        raise SystemExit(f"usage: {sys.argv[0]} recordings/*.csv")
    reference = float(np.mean([length_from_period(p) for p in paths]))
    recordings = [w for p in paths for w in windows(p)[:3]]
    _, trace = infer(recordings)
    for i, (mean, sd, friction) in enumerate(trace, 1):
        print(f"recording {i:2d}: length {mean:.4f} ± {sd:.4f} m, friction {friction:.3f} 1/s")
    print(f"period: {reference:.4f} m; posterior differs by {100 * (trace[-1][0] / reference - 1):+.1f} %")


if __name__ == "__main__":
    main()
