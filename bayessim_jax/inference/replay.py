"""Windows of recordings replayed by a simulator: what `inference.shooting` compares with what was measured."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

from bayessim_jax.beliefs.margins import Margins
from bayessim_jax.systems.mjcf import MjcfSystem, displace

__all__ = ["Inputs", "make_predictor", "replay_window"]


@struct.dataclass
class Inputs:
    """What the simulation of one window needs."""

    qpos: Float[Array, " nq"]
    """As recorded in the window's first row."""
    qvel: Float[Array, " nv"]
    ctrl: Float[Array, "steps nu"]
    past: Float[Array, "before nu"]
    """Commands of the rows before the window, the last one just before it."""
    time: Float[Array, ""]
    """When the window begins, s in its recording."""


def replay_window(system: Any, theta: Array, delta: Float[Array, " n"], window: Inputs) -> Float[Array, "rows obs"]:
    """What the sensors show in every row of a window that begins δ beside the recorded state.

    `system` is an `MjcfSystem`, or one with effects.
    """
    nv = system.engine.model.nv
    qpos, qvel = displace(system.engine.model, window.qpos, delta[:nv]), window.qvel + delta[nv:]
    commanded = window.ctrl.shape[-1] > 0
    if isinstance(system, MjcfSystem):
        state = system.begin(theta, qpos, qvel)
        state = dataclasses.replace(state, ctrl=window.ctrl[0]) if commanded else state
    else:
        past = window.past if commanded and window.past.shape[0] else None
        state = system.begin(theta, qpos, qvel, window.ctrl[0] if commanded else None, window.time, past)
    first = system.observe(theta, state)
    after = jax.vmap(system.observe, in_axes=(None, 0))(theta, system.replay(theta, state, window.ctrl))
    return jnp.concatenate([first[None], after])


def make_predictor(system: Any, margins: Margins) -> Callable[[Array, Array, Inputs], Array]:
    """`predict(z, δ, window)` of a system whose parameters have these priors."""

    def predict(z: Array, delta: Array, window: Inputs) -> Array:
        return replay_window(system, margins.theta(z), delta, window)

    return predict
