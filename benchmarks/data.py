"""Trajectories for the benchmarks, and the score that both sides are judged by."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from bayessim_jax.beliefs import Uniform
from bayessim_jax.contracts import Policy, Recording, Scalar, System
from bayessim_jax.inference.estimators import EstimatorState, MixtureDensity
from bayessim_jax.rollout import assemble, rollout

__all__ = ["as_recordings", "draw_recordings", "score_held_out", "stack_rows"]


def draw_recordings(
    key: PRNGKeyArray, system: System[Any], policy: Policy, count: int, steps: int = 50
) -> tuple[Float[Array, "n d"], Recording]:
    """`count` pairs of θ, uniform on the system's parameters, and one trajectory; no episode ends early."""

    def draw(key: PRNGKeyArray) -> tuple[Float[Array, " d"], Recording]:
        theta_key, rollout_key = jax.random.split(key)
        theta = Uniform(system.parameters).sample(theta_key)
        return theta, rollout(rollout_key, system, theta, policy, steps)

    return jax.vmap(draw)(jax.random.split(key, count))


def stack_rows(recordings: Recording) -> np.ndarray:
    """Rows (yₜ, yₜ₊₁ − yₜ, uₜ) of each trajectory, [n, steps, features]: what our encoders read, for the peers."""
    y = recordings.observations
    return np.asarray(jnp.concatenate([y[:, :-1], y[:, 1:] - y[:, :-1], recordings.actions], -1))


def as_recordings(dt: float, observations: np.ndarray, actions: np.ndarray, valid: np.ndarray) -> Recording:
    """Recordings from arrays [n, steps + 1, obs], [n, steps, act] and [n, steps]."""
    rewards = jnp.zeros(valid.shape)
    one = lambda *leaves: assemble(dt, *leaves)  # noqa: E731
    return jax.vmap(one)(jnp.asarray(observations), jnp.asarray(actions), rewards, jnp.asarray(valid))


@jax.jit
def score_held_out(
    estimator: MixtureDensity, state: EstimatorState, thetas: Float[Array, "n d"], recordings: Recording
) -> Scalar:
    """Mean log q(θ | recording) in raw units of θ; the mixture is not truncated to the prior."""

    def one(theta: Float[Array, " d"], recording: Recording) -> Scalar:
        as_set = jax.tree.map(lambda leaf: leaf[None], recording)
        return estimator.posterior(state, as_set, jnp.ones(1, bool)).log_prob(theta)

    return jax.vmap(one)(thetas, recordings).mean()
