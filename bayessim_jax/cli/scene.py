"""The plans that were weighed in a recorded drive, computed again for the report."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from bayessim_jax.beliefs import Particles, Uniform
from bayessim_jax.control import Planner
from bayessim_jax.report.drives import Drives, Scene

__all__ = ["replan"]

FRAMES = 90
PLANS = 12
POINTS = 10


def replan(planner: Planner, drives: Drives, index: int, before: Float[np.ndarray, "draw d"] | None) -> Scene | None:
    """Plan again along the poses of round `index`, with what was believed before it (`None`: the prior).

    Nothing where the machine is no vehicle. The samples are not those of the run, but drawn as they were.
    """
    poses, disco = drives.poses(index), planner.disco
    if poses is None or len(poses) < 2:
        return None
    prior = Uniform(disco.system.parameters)
    belief: Any = prior if before is None else Particles(jnp.asarray(before), jnp.zeros(len(before)))
    digest = disco.digest(jax.random.key(0), belief)
    theta = belief.mean()

    def path(look: Array, actions: Float[Array, "horizon act"]) -> Float[Array, "points 2"]:
        def step(state: Any, action: Array) -> Any:
            after = disco.system.step(theta, state, action)
            return after, disco.system.observe(theta, after)[:2]

        seen = jax.lax.scan(step, disco.system.restart(theta, look), actions)[1]
        rows = np.unique(np.linspace(0, len(actions) - 1, POINTS).round().astype(int))
        return jnp.concatenate([look[None, :2], seen[rows]])

    def once(plan: Any, x: Any) -> Any:
        key, look = x
        _, after, info = disco.steer(key, plan, look, digest)
        paths = jax.vmap(path, (None, -1))(look, info.actions[..., :PLANS])
        made = jnp.einsum("hak,k->ha", info.actions, info.weights)
        return after, (paths, path(look, made))

    keys = jax.random.split(jax.random.key(1), len(poses))
    _, (paths, best) = jax.jit(lambda xs: jax.lax.scan(once, disco.init(), xs))((keys, jnp.asarray(poses)))
    rows = np.unique(np.linspace(0, len(poses) - 1, FRAMES).round().astype(int))
    time, radius = drives.times[index - 1][rows], disco.task.radius  # type: ignore[attr-defined]
    return Scene(time, poses[rows], np.asarray(paths)[rows], np.asarray(best)[rows], radius)
