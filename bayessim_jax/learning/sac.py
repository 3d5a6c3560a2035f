"""Soft actor-critic against a belief over θ."""

from __future__ import annotations

from functools import partial
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import optax
from flax import struct
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Int, PRNGKeyArray

from bayessim_jax.chance import draw
from bayessim_jax.contracts import Belief, Box, Scalar, System, Task
from bayessim_jax.learning.collect import Episodes, blank, collect
from bayessim_jax.learning.heads import SquashedGaussian
from bayessim_jax.learning.networks import Mlp, evaluate_critics
from bayessim_jax.learning.normalisation import Scaling
from bayessim_jax.learning.policies import NetworkPolicy
from bayessim_jax.learning.replay import Replay

__all__ = ["Sac", "SacInfo", "SacState"]

_ADAM = optax.scale_by_adam()


@struct.dataclass
class SacState:
    """Weights of the policy, of both critics and log temperature; the slow critics; Adam's moments; the replay."""

    weights: Any
    slow: Any
    moments: Any
    replay: Replay
    spread: Scalar
    """Largest root mean square of the rewards of an iteration so far: the unit that values are learned in."""


@struct.dataclass
class SacInfo:
    """What a person wants to see of one round."""

    return_mean: Scalar
    """Mean undiscounted return of the episodes that ended in this round."""
    length_mean: Scalar
    """Their mean length, steps."""
    entropy: Scalar
    """Of the policy's squashed actions in half-widths of their box, nats."""
    temperature: Scalar
    """α, in units of `SacState.spread` for each nat."""
    value_loss: Scalar
    """Mean squared Bellman error of the critics, in units of `SacState.spread` squared."""
    nonfinite: Int[Array, ""]
    """Transitions that were masked because a number was not finite."""
    skipped: Int[Array, ""]
    """Gradient steps that were not taken because the gradient was not finite."""


@struct.dataclass
class Sac:
    """Maximizes E Σ γᵗ (rₜ + α H(π(·|yₜ))) with twin critics, slow copies of them and a learned temperature α.

    One `step` collects `iterations · horizon · envs` policy steps, and takes `updates` gradient steps after every
    `horizon · envs` of them. Numbers are leaves, so that seeds and learning rates batch; shapes are static.

    Source: Haarnoja et al. 2018
    """

    system: System[Any]
    task: Task[Any]
    head: SquashedGaussian
    scaling: Scaling
    learning_rate: Scalar
    gamma: Scalar
    slowness: Scalar
    """Fraction of the way that the slow critics follow in one gradient step."""
    entropy_target: Scalar
    """Entropy that the temperature holds the policy at, nats."""
    network: Mlp = struct.field(pytree_node=False)
    critic: Mlp = struct.field(pytree_node=False)
    iterations: int = struct.field(pytree_node=False)
    envs: int = struct.field(pytree_node=False)
    horizon: int = struct.field(pytree_node=False)
    episode_steps: int = struct.field(pytree_node=False)
    updates: int = struct.field(pytree_node=False)
    batch: int = struct.field(pytree_node=False)
    capacity: int = struct.field(pytree_node=False)

    @classmethod
    def create(
        cls,
        system: System[Any],
        task: Task[Any],
        episodes: int = 300,
        episode_steps: int = 50,
        *,
        envs: int = 30,
        horizon: int = 50,
        updates: int = 100,
        batch: int = 128,
        rounds_kept: int = 3,
        learning_rate: float = 1e-3,
        gamma: float = 0.99,
        slowness: float = 0.005,
        entropy_target: float | None = None,
        widths: tuple[int, ...] = (64, 64),
    ) -> Sac:
        """Iterate until `episodes · episode_steps` policy steps; the replay holds the last `rounds_kept` rounds.

        The entropy is held at −1 nat for each action where no other target is given.
        """
        if not isinstance(system.actions, Box):
            raise ValueError("SAC needs actions in a box; this system's are discrete: choose PPO.")
        head = SquashedGaussian(system.actions)
        leaf = lambda x: jnp.asarray(x, float)  # noqa: E731
        iterations = -(-episodes * episode_steps // (envs * horizon))
        return cls(
            system=system,
            task=task,
            head=head,
            scaling=Scaling.from_box(system.observations),
            learning_rate=leaf(learning_rate),
            gamma=leaf(gamma),
            slowness=leaf(slowness),
            entropy_target=leaf(-float(system.actions.size) if entropy_target is None else entropy_target),
            network=Mlp(widths, head.outputs, nn.relu, 0.01),
            critic=Mlp(widths, 1, nn.relu),
            iterations=iterations,
            envs=envs,
            horizon=horizon,
            episode_steps=episode_steps,
            updates=updates,
            batch=batch,
            capacity=rounds_kept * iterations * envs * horizon,
        )

    def init(self, key: PRNGKeyArray) -> SacState:
        """Random weights, an empty replay buffer."""
        keys = jax.random.split(key, 3)
        seen = self.scaling.normalise(self.scaling.shift)
        both = jnp.concatenate([seen, jnp.zeros(self.head.box.size)])
        critics = [self.critic.init(k, both) for k in keys[1:]]
        weights = {
            "policy": self.network.init(keys[0], seen),
            "critics": critics,
            "log_temperature": jnp.zeros(()),
        }
        width = 2 * seen.size + self.head.box.size + 3
        return SacState(
            weights=weights,
            slow=ravel_pytree(critics)[0],
            moments=_ADAM.init(ravel_pytree(weights)[0]),
            replay=Replay.create(self.capacity, width),
            spread=jnp.zeros(()),
        )

    def policy(self, state: SacState, deterministic: bool = False) -> NetworkPolicy:
        """The current policy: stochastic to explore, deterministic to be judged."""
        return NetworkPolicy(state.weights["policy"], self.scaling, self.head, self.network, deterministic)

    def step(self, key: PRNGKeyArray, state: SacState, belief: Belief) -> tuple[SacState, SacInfo]:
        """One round: collect and improve, `iterations` times; every round begins with new episodes."""
        worlds = blank(self.system, belief, self.envs)
        sums = Episodes(jnp.zeros(()), jnp.zeros(()), jnp.zeros(()))

        def iterate(carry: Any, keys: PRNGKeyArray) -> Any:
            state, worlds, sums = carry
            worlds, seen, episodes = collect(
                keys[0],
                self.system,
                self.task,
                belief,
                worlds,
                self.head,
                lambda observations: self._outputs(state.weights["policy"], observations),
                self.horizon,
                self.episode_steps,
            )
            columns = (
                self.scaling.normalise(seen.observation),
                jnp.tanh(seen.raw),
                self.scaling.normalise(seen.next_observation),
                seen.reward,
                seen.terminated,
                seen.sound,
            )
            rows = jnp.concatenate([c.reshape(self.horizon * self.envs, -1) for c in columns], 1)
            size = jnp.sqrt(jnp.sum(seen.reward**2) / jnp.maximum(jnp.sum(seen.sound), 1) + 1e-8)
            size = jnp.where(jnp.isfinite(size), size, 1.0)
            state = state.replace(replay=state.replay.add(rows), spread=jnp.maximum(state.spread, size))
            state, info = self._improve(keys[1], state)
            return (state, worlds, sums + episodes), (info, jnp.sum(~seen.sound))

        (state, worlds, sums), (info, nonfinite) = jax.lax.scan(
            iterate, (state, worlds, sums), jax.random.split(key, (self.iterations, 2))
        )
        none, count = sums.count == 0, jnp.maximum(sums.count, 1.0)
        value_loss, entropy, skipped = info
        return state, SacInfo(
            return_mean=jnp.where(none, jnp.mean(worlds.gained), sums.gained / count),
            length_mean=jnp.where(none, jnp.mean(worlds.age.astype(float)), sums.length / count),
            entropy=jnp.mean(entropy),
            temperature=jnp.exp(state.weights["log_temperature"]),
            value_loss=jnp.mean(value_loss),
            nonfinite=jnp.sum(nonfinite),
            skipped=jnp.sum(skipped),
        )

    def _outputs(self, weights: Any, observations: Any) -> Any:
        return self.network.apply(weights, self.scaling.normalise(observations))

    def _act(self, weights: Any, seen: Any, noise: Any) -> Any:
        """Squashed actions and their log density, for normalised observations."""
        outputs: Any = self.network.apply(weights, seen)
        raw = jax.vmap(self.head.sample)(outputs, noise)
        return jnp.tanh(raw), jax.vmap(self.head.log_prob)(outputs, raw)

    def _improve(self, key: PRNGKeyArray, state: SacState) -> tuple[SacState, Any]:
        """`updates` gradient steps of all three losses at once; each loss moves its own weights only."""
        obs, act = self.system.observations.size, self.head.box.size
        flat, unravel = ravel_pytree(state.weights)
        _, unravel_slow = ravel_pytree(state.weights["critics"])
        sample_key, noise_key = jax.random.split(key)
        batches = state.replay.sample(sample_key, (self.updates, self.batch))
        noises = self.head.noise(draw(noise_key, (self.updates, 2, self.batch, self.head.chances)))

        values = partial(evaluate_critics, self.critic)

        def loss(flat: Any, slow: Any, batch: Any, noise: Any) -> Any:
            weights, frozen = unravel(flat), unravel(jax.lax.stop_gradient(flat))
            seen, action = batch[:, :obs], batch[:, obs : obs + act]
            after, rest = batch[:, obs + act : 2 * obs + act], batch[:, 2 * obs + act :]
            reward, terminated, sound = rest[:, 0] / state.spread, rest[:, 1], rest[:, 2]
            mean = lambda x: jnp.sum(sound * x) / jnp.maximum(jnp.sum(sound), 1.0)  # noqa: E731
            temperature = jnp.exp(frozen["log_temperature"])

            next_action, next_log_prob = self._act(frozen["policy"], after, noise[0])
            ahead = jnp.min(values(unravel_slow(slow), after, next_action), -1) - temperature * next_log_prob
            target = reward + self.gamma * (1.0 - terminated) * ahead
            error = values(weights["critics"], seen, action) - target[:, None]
            value_loss = mean(jnp.sum(error**2, -1)) / 2

            chosen, log_prob = self._act(weights["policy"], seen, noise[1])
            policy_loss = mean(temperature * log_prob - jnp.min(values(frozen["critics"], seen, chosen), -1))
            surplus = jax.lax.stop_gradient(mean(log_prob)) + self.entropy_target
            total = value_loss + policy_loss - weights["log_temperature"] * surplus
            return total, (value_loss, -mean(log_prob))

        def update(carry: Any, x: Any) -> Any:
            flat, slow, moments = carry
            gradient, info = jax.grad(loss, has_aux=True)(flat, slow, *x)
            direction: Any
            direction, after = _ADAM.update(gradient, moments)
            moved = flat - self.learning_rate * direction
            followed = slow + self.slowness * (ravel_pytree(unravel(moved)["critics"])[0] - slow)
            taken = jnp.isfinite(jnp.sum(gradient**2))
            carry = jax.tree.map(lambda a, b: jnp.where(taken, a, b), (moved, followed, after), carry)
            return carry, (*(jnp.where(taken, x, 0.0) for x in info), ~taken)

        (flat, slow, moments), info = jax.lax.scan(update, (flat, state.slow, state.moments), (batches, noises))
        return SacState(unravel(flat), slow, moments, state.replay, state.spread), info
