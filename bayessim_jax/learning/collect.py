"""Policy steps in many simulated worlds at once, each episode with a θ of its own."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from bayessim_jax.contracts import Belief, Scalar, System, Task

if TYPE_CHECKING:
    from collections.abc import Callable

__all__ = ["Episodes", "Transitions", "Worlds", "begin", "collect"]


@struct.dataclass
class Worlds:
    """Running episodes."""

    state: Any
    theta: Float[Array, "worlds d"]
    observation: Float[Array, "worlds obs"]
    """What the sensors show now, noise included."""
    age: Int[Array, " worlds"]
    gained: Float[Array, " worlds"]
    """Steps taken and reward summed since the episode began."""


@struct.dataclass
class Transitions:
    """What was seen and done. The next observation is the episode's own, also where a new episode follows."""

    observation: Float[Array, "steps worlds obs"]
    raw: Float[Array, "steps worlds act"]
    reward: Float[Array, "steps worlds"]
    next_observation: Float[Array, "steps worlds obs"]
    terminated: Bool[Array, "steps worlds"]
    """The task ended the episode: nothing can be gained after it. A time limit is no termination."""
    ended: Bool[Array, "steps worlds"]
    """The episode ended, for whatever reason."""
    sound: Bool[Array, "steps worlds"]
    """All numbers were finite; where they were not, they are replaced by zeros and the episode is given up."""


@struct.dataclass
class Episodes:
    """Sums over the episodes that ended soundly, and their number."""

    gained: Scalar
    length: Scalar
    count: Scalar

    def __add__(self, other: Episodes) -> Episodes:
        """Sums over both."""
        return jax.tree.map(jnp.add, self, other)


def begin(key: PRNGKeyArray, system: System[Any], belief: Belief, noise: Float[Array, "*batch obs"]) -> Worlds:
    """Start an episode in every world: θ from the belief, a random reset, a first look with standard normal `noise`."""

    def one(keys: PRNGKeyArray, noise: Float[Array, " obs"]) -> Worlds:
        theta = belief.sample(keys[0])
        state = system.reset(keys[1], theta)
        observation = system.observe(theta, state) + system.noise * noise
        return Worlds(state, theta, observation, jnp.zeros((), jnp.int32), jnp.zeros(()))

    batch = noise.shape[:-1]
    for _ in batch:
        one = jax.vmap(one)
    return one(jax.random.split(key, (*batch, 2)), noise)


def collect(
    key: PRNGKeyArray,
    system: System[Any],
    task: Task[Any],
    belief: Belief,
    worlds: Worlds,
    sensor: Float[Array, "steps worlds 2 obs"],
    choose: Callable[[Any, Any], tuple[Any, Any]],
    noise: Float[Array, "steps worlds noise"],
    episode_steps: int,
) -> tuple[Worlds, Transitions, Episodes]:
    """Let `choose(observations, noise) -> (raw, actions)` act for as many steps as there is noise.

    Episodes end by the task, after `episode_steps` steps or where a number is not finite; the next one begins with a
    new θ at once. `sensor` holds standard normal numbers: for each step's observation and for a new episode's first.
    """
    fresh = begin(key, system, belief, sensor[:, :, 1])

    def advance(theta: Any, state: Any, action: Any) -> Any:
        after = system.step(theta, state, action)
        return after, system.observe(theta, after), task.reward(state, action, after), task.terminated(after)

    def step(worlds: Worlds, x: Any) -> Any:
        noise, unit, fresh = x
        raw, action = choose(worlds.observation, noise)
        state, clean, reward, terminated = jax.vmap(advance)(worlds.theta, worlds.state, action)
        observation = clean + system.noise * unit
        sound = jnp.isfinite(observation).all(-1) & jnp.isfinite(reward) & jnp.isfinite(raw).all(-1)
        transition = Transitions(
            observation=worlds.observation,
            raw=jnp.where(sound[:, None], raw, 0.0),
            reward=jnp.where(sound, reward, 0.0),
            next_observation=jnp.where(sound[:, None], observation, 0.0),
            terminated=terminated & sound,
            ended=terminated | (worlds.age + 1 >= episode_steps) | ~sound,
            sound=sound,
        )
        after = Worlds(state, worlds.theta, observation, worlds.age + 1, worlds.gained + transition.reward)
        return _where(transition.ended, fresh, after), (transition, after.gained, after.age)

    worlds, (transitions, gained, age) = jax.lax.scan(step, worlds, (noise, sensor[:, :, 0], fresh))
    done = (transitions.ended & transitions.sound).astype(gained.dtype)
    episodes = Episodes(jnp.sum(done * gained), jnp.sum(done * age), jnp.sum(done))
    return worlds, transitions, episodes


def _where(condition: Any, chosen: Any, other: Any) -> Any:
    return jax.tree.map(
        lambda a, b: jnp.where(condition.reshape(condition.shape + (1,) * (a.ndim - 1)), a, b), chosen, other
    )
