"""The newest recording of a target, and the simulator under the same actions, for the report."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from bayessim_jax.contracts import System
from bayessim_jax.recordings.history import History
from bayessim_jax.report.beside import Beside
from bayessim_jax.systems import Fetch, Hopper

__all__ = ["replay"]


def replay(name: str, system: System[Any], history: History, draws: Float[np.ndarray, "round draw d"]) -> Beside | None:
    """The first recording of the newest round of the first seed, from its first observation on, at the mean of θ.

    Nothing where no round has recorded, or the system is another than Fetch or Hopper. The simulator shows no noise;
    what it begins from has that of the sensors.
    """
    lengths = history.valid[:, 0, 0].sum(-1)
    if not isinstance(system, Fetch | Hopper) or not lengths.any():
        return None
    index = int(np.flatnonzero(lengths)[-1])
    steps = int(lengths[index])
    seen = history.observations[index, 0, 0, : steps + 1]
    theta = jnp.asarray(draws[index].mean(0), float)

    def step(state: Any, action: Array) -> Any:
        after: Any = system.step(theta, state, action)
        return after, system.observe(theta, after)

    begun = _begin(system, theta, jnp.asarray(seen[0], float))
    actions = jnp.asarray(history.actions[index, 0, 0, :steps], float)
    shown = jax.jit(lambda begun, actions: jax.lax.scan(step, begun, actions)[1])(begun, actions)
    return Beside(
        system=name,
        time=history.times[index, 0, 0, : steps + 1],
        target=seen,
        simulated=np.concatenate([system.observe(theta, begun)[None], shown]),
        channels=tuple(system.observations.names),
        theta=np.asarray(theta),
        model=system.engine.model if isinstance(system, Fetch) else system.model,
        round=index + 1,
    )


def _begin(system: Fetch | Hopper, theta: Array, look: Array) -> Any:
    """The beginning of an episode that shows this."""
    if isinstance(system, Fetch):
        channels = list(system.observations.names)
        object_x, goal_x = (channels.index(name) for name in ("object_x", "goal_x"))
        return system.begin(theta, look[object_x : object_x + 2], look[goal_x : goal_x + 3])
    return system.begin(theta, jnp.concatenate([jnp.zeros(1), look[:5]]), look[5:])
