"""Policy steps in many simulated worlds at once, each episode with a θ of its own."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from bayessim_jax.chance import draw, normal
from bayessim_jax.contracts import Belief, Scalar, System, Task
from bayessim_jax.learning.heads import Actor

if TYPE_CHECKING:
    from collections.abc import Callable

__all__ = ["Episodes", "Transitions", "Worlds", "begin", "blank", "collect"]


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


def blank(system: System[Any], belief: Belief, count: int) -> Worlds:
    """Worlds in which no episode has begun; `collect` begins one in each at its first step."""
    look = jax.ShapeDtypeStruct((count, system.observations.size), system.noise.dtype)
    shapes = jax.eval_shape(lambda key, look: begin(key, system, belief, look), jax.random.key(0), look)
    zeros = jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), shapes)
    return Worlds(zeros.state, zeros.theta, zeros.observation, zeros.age - 1, zeros.gained)


def begin(key: PRNGKeyArray, system: System[Any], belief: Belief, looks: Float[Array, "*batch obs"]) -> Worlds:
    """Start an episode in every world: θ from the belief, a random reset, a first look with that much noise."""

    def one(keys: PRNGKeyArray, look: Float[Array, " obs"]) -> Worlds:
        theta = belief.sample(keys[0])
        state = system.reset(keys[1], theta)
        observation = system.observe(theta, state) + system.noise * look
        return Worlds(state, theta, observation, jnp.zeros((), jnp.int32), jnp.zeros(()))

    rows = looks.reshape(-1, looks.shape[-1])
    worlds = jax.vmap(one)(jax.random.split(key, 2 * len(rows)).reshape(-1, 2), rows)
    return jax.tree.map(lambda x: x.reshape(*looks.shape[:-1], *x.shape[1:]), worlds)


def collect(
    key: PRNGKeyArray,
    system: System[Any],
    task: Task[Any],
    belief: Belief,
    worlds: Worlds,
    head: Actor,
    outputs: Callable[[Float[Array, "worlds obs"]], Float[Array, "worlds outputs"]],
    steps: int,
    episode_steps: int,
) -> tuple[Worlds, Transitions, Episodes]:
    """Act by the head's samples, given the network's `outputs` for what all worlds show.

    Episodes end by the task, after `episode_steps` steps or where a number is not finite; the next one begins with a
    new θ at once.
    """
    count, obs = worlds.observation.shape
    fresh_key, noise_key = jax.random.split(key)
    uniforms = draw(noise_key, (steps + 1, count, head.chances + 2 * obs))
    noise, looks = head.noise(uniforms[1:, :, : head.chances]), normal(uniforms[:, :, head.chances :])
    fresh = begin(fresh_key, system, belief, looks[:, :, :obs])
    first, fresh = jax.tree.map(lambda x: x[0], fresh), jax.tree.map(lambda x: x[1:], fresh)
    worlds = _where(worlds.age < 0, first, worlds)

    def advance(theta: Any, state: Any, action: Any) -> Any:
        after = system.step(theta, state, action)
        return after, system.observe(theta, after), task.reward(state, action, after), task.terminated(after)

    def step(worlds: Worlds, x: Any) -> Any:
        noise, look, fresh = x
        raw = jax.vmap(head.sample)(outputs(worlds.observation), noise)
        action = jax.vmap(head.action)(raw)
        state, clean, reward, terminated = jax.vmap(advance)(worlds.theta, worlds.state, action)
        observation = clean + system.noise * look
        sound = jnp.isfinite(jnp.concatenate([worlds.observation, raw, reward[:, None], observation], -1)).all(-1)
        transition = Transitions(
            observation=jnp.where(sound[:, None], worlds.observation, 0.0),
            raw=jnp.where(sound[:, None], raw, 0.0),
            reward=jnp.where(sound, reward, 0.0),
            next_observation=jnp.where(sound[:, None], observation, 0.0),
            terminated=terminated & sound,
            ended=terminated | (worlds.age + 1 >= episode_steps) | ~sound,
            sound=sound,
        )
        after = Worlds(state, worlds.theta, observation, worlds.age + 1, worlds.gained + transition.reward)
        return _where(transition.ended, fresh, after), (transition, after.gained, after.age)

    worlds, (transitions, gained, age) = jax.lax.scan(step, worlds, (noise, looks[1:, :, obs:], fresh))
    done = (transitions.ended & transitions.sound).astype(gained.dtype)
    episodes = Episodes(jnp.sum(done * gained), jnp.sum(done * age), jnp.sum(done))
    return worlds, transitions, episodes


def _where(condition: Any, chosen: Any, other: Any) -> Any:
    return jax.tree.map(
        lambda a, b: jnp.where(condition.reshape(condition.shape + (1,) * (a.ndim - 1)), a, b), chosen, other
    )
