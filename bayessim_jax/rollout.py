"""One trajectory; `jax.vmap` gives many."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from bayessim_jax.contracts import Policy, Recording, System, Task

if TYPE_CHECKING:
    from collections.abc import Callable

__all__ = ["assemble", "rollout"]


def rollout(
    key: PRNGKeyArray,
    system: System[Any],
    theta: Float[Array, " d"],
    policy: Policy,
    steps: int,
    task: Task[Any] | None = None,
) -> Recording:
    """Simulate `steps` transitions under a policy that sees what the sensors see, noise included.

    Without a task no reward is paid and no episode ends early. θ is traced: a new posterior never recompiles.
    """
    reset_key, noise_key, act_key = jax.random.split(key, 3)
    state = system.reset(reset_key, theta)
    noise = system.noise * jax.random.normal(noise_key, (steps + 1, system.observations.size), system.noise.dtype)

    def step(carry: Any, x: Any) -> Any:
        state, observation, memory, running = carry
        key, noise = x
        action, memory = policy.act(key, memory, observation)
        next_state = system.step(theta, state, action)
        next_observation = system.observe(theta, next_state) + noise
        reward = jnp.zeros(()) if task is None else task.reward(state, action, next_state)
        ends = jnp.array(False) if task is None else task.terminated(next_state)
        output = (next_observation, action, reward, running)
        return (next_state, next_observation, memory, running & ~ends), output

    observation = system.observe(theta, state) + noise[0]
    carry = (state, observation, policy.init(), jnp.array(True))
    _, (later, actions, rewards, valid) = jax.lax.scan(step, carry, (jax.random.split(act_key, steps), noise[1:]))
    return assemble(system.dt, jnp.concatenate([observation[None], later]), actions, rewards, valid)


def assemble(
    dt: float,
    observations: Float[Array, "rows obs"],
    actions: Float[Array, "steps act"],
    rewards: Float[Array, " steps"],
    valid: Any,
) -> Recording:
    """Pad what came after the end with zeros, and mask everything from the first non-finite number on."""
    finite = jnp.isfinite(observations).all(-1)
    sound = finite[:-1] & finite[1:] & jnp.isfinite(actions).all(-1) & jnp.isfinite(rewards)
    steps = jnp.arange(valid.size)
    kept = valid & (steps < jnp.where(sound, valid.size, steps).min())
    seen = jnp.concatenate([kept[:1], kept])
    zero: Callable[[Any, Any], Any] = lambda mask, x: jnp.where(mask, x, jnp.zeros_like(x))  # noqa: E731
    return Recording(
        times=dt * jnp.arange(observations.shape[0], dtype=observations.dtype),
        observations=zero(seen[:, None], observations),
        actions=zero(kept[:, None], actions),
        rewards=zero(kept, rewards),
        valid=kept,
        diverged=(valid & ~sound).any(),
    )
