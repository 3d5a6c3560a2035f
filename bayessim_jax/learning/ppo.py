"""Proximal policy optimization against a belief over θ."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Int, PRNGKeyArray

from bayessim_jax.contracts import Belief, Scalar, System, Task
from bayessim_jax.learning.collect import Episodes, Transitions, blank, collect
from bayessim_jax.learning.heads import Head, choose_head
from bayessim_jax.learning.networks import Mlp
from bayessim_jax.learning.normalisation import Scaling
from bayessim_jax.learning.policies import NetworkPolicy

__all__ = ["Ppo", "PpoInfo", "PpoState"]

_ADAM = optax.scale_by_adam(eps=1e-5)


@struct.dataclass
class PpoState:
    """Weights of the policy and of the value, Adam's moments, and the spread that values are measured in."""

    weights: Any
    moments: Any
    spread: Scalar
    """Running root mean square of the value targets, in units of reward; 0 before the first round."""


@struct.dataclass
class PpoInfo:
    """What a person wants to see of one round."""

    return_mean: Scalar
    """Mean undiscounted return of the episodes that ended in this round."""
    length_mean: Scalar
    """Their mean length, steps."""
    entropy: Scalar
    """Of the policy, nats."""
    value_loss: Scalar
    """Mean squared error of the value, in units of its targets' mean square."""
    divergence: Scalar
    """KL(old ‖ new) over an iteration's updates, averaged, nats."""
    nonfinite: Int[Array, ""]
    """Transitions that were masked because a number was not finite."""
    skipped: Int[Array, ""]
    """Gradient steps that were not taken because the gradient was not finite."""


@struct.dataclass
class Ppo:
    """Maximizes E min(r A, clip(r, 1 ± c) A) − value_cost · (V − R)² + entropy_cost · H, r = π/π_old.

    One `step` collects `iterations · horizon · envs` policy steps and improves after every `horizon · envs` of them.
    Numbers are leaves, so that seeds and learning rates batch; shapes are static.

    Source: Schulman et al. 2017
    """

    system: System[Any]
    task: Task[Any]
    head: Head
    scaling: Scaling
    learning_rate: Scalar
    gamma: Scalar
    gae_lambda: Scalar
    clip: Scalar
    entropy_cost: Scalar
    value_cost: Scalar
    gradient_limit: Scalar
    """Largest norm of a gradient; longer ones are shortened."""
    network: Mlp = struct.field(pytree_node=False)
    critic: Mlp = struct.field(pytree_node=False)
    iterations: int = struct.field(pytree_node=False)
    envs: int = struct.field(pytree_node=False)
    horizon: int = struct.field(pytree_node=False)
    episode_steps: int = struct.field(pytree_node=False)
    epochs: int = struct.field(pytree_node=False)
    minibatches: int = struct.field(pytree_node=False)

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
        epochs: int = 5,
        minibatches: int = 5,
        learning_rate: float = 1e-3,
        gamma: float = 0.99,
        gae_lambda: float = 0.95,
        clip: float = 0.2,
        entropy_cost: float = 0.0,
        value_cost: float = 0.5,
        gradient_limit: float = 0.5,
        widths: tuple[int, ...] = (64, 64),
    ) -> Ppo:
        """Iterate until `episodes · episode_steps` policy steps; an episode that ends early makes room for more.

        Stable-Baselines3's amount of work is `envs=16, horizon=128, epochs=10, minibatches=32, learning_rate=3e-4`.
        """
        if (envs * horizon) % minibatches:
            raise ValueError(
                f"minibatches {minibatches} must divide envs · horizon = {envs * horizon}; change one of the three."
            )
        head = choose_head(system.actions)
        leaf = lambda x: jnp.asarray(x, float)  # noqa: E731
        return cls(
            system=system,
            task=task,
            head=head,
            scaling=Scaling.from_box(system.observations),
            learning_rate=leaf(learning_rate),
            gamma=leaf(gamma),
            gae_lambda=leaf(gae_lambda),
            clip=leaf(clip),
            entropy_cost=leaf(entropy_cost),
            value_cost=leaf(value_cost),
            gradient_limit=leaf(gradient_limit),
            network=Mlp(widths, head.outputs, output_gain=0.01),
            critic=Mlp(widths, 1),
            iterations=-(-episodes * episode_steps // (envs * horizon)),
            envs=envs,
            horizon=horizon,
            episode_steps=episode_steps,
            epochs=epochs,
            minibatches=minibatches,
        )

    def init(self, key: PRNGKeyArray) -> PpoState:
        """Random weights."""
        policy_key, value_key = jax.random.split(key)
        example = self.scaling.normalise(self.scaling.shift)
        weights = {
            "policy": self.network.init(policy_key, example),
            "value": self.critic.init(value_key, example),
        }
        return PpoState(weights, _ADAM.init(ravel_pytree(weights)[0]), jnp.zeros(()))

    def policy(self, state: PpoState, deterministic: bool = False) -> NetworkPolicy:
        """The current policy: stochastic to explore, deterministic to be judged."""
        return NetworkPolicy(state.weights["policy"], self.scaling, self.head, self.network, deterministic)

    def step(self, key: PRNGKeyArray, state: PpoState, belief: Belief) -> tuple[PpoState, PpoInfo]:
        """One round: collect and improve, `iterations` times; every round begins with new episodes."""
        worlds = blank(self.system, belief, self.envs)
        sums = Episodes(jnp.zeros(()), jnp.zeros(()), jnp.zeros(()))

        def iterate(carry: Any, keys: PRNGKeyArray) -> Any:
            state, worlds, sums = carry
            worlds, transitions, episodes = collect(
                keys[0],
                self.system,
                self.task,
                belief,
                worlds,
                self.head,
                lambda observations: self._outputs(state.weights, observations),
                self.horizon,
                self.episode_steps,
            )
            state, seen = self._improve(keys[1], state, transitions)
            return (state, worlds, sums + episodes), (seen, jnp.sum(~transitions.sound))

        (state, worlds, sums), (seen, nonfinite) = jax.lax.scan(
            iterate, (state, worlds, sums), jax.random.split(key, (self.iterations, 2))
        )
        none, count = sums.count == 0, jnp.maximum(sums.count, 1.0)
        value_loss, entropy, divergence, skipped = seen
        return state, PpoInfo(
            return_mean=jnp.where(none, jnp.mean(worlds.gained), sums.gained / count),
            length_mean=jnp.where(none, jnp.mean(worlds.age.astype(float)), sums.length / count),
            entropy=jnp.mean(entropy),
            value_loss=jnp.mean(value_loss),
            divergence=jnp.mean(divergence),
            nonfinite=jnp.sum(nonfinite),
            skipped=jnp.sum(skipped),
        )

    def _outputs(self, weights: Any, observations: Any) -> Any:
        return self.network.apply(weights["policy"], self.scaling.normalise(observations))

    def _values(self, weights: Any, observations: Any) -> Any:
        values: Any = self.critic.apply(weights["value"], self.scaling.normalise(observations))
        return values[..., 0]

    def _improve(self, key: PRNGKeyArray, state: PpoState, seen: Transitions) -> tuple[PpoState, Any]:
        """`epochs` passes over the transitions in minibatches."""
        weights, spread = state.weights, state.spread
        unit = jnp.where(spread > 0, spread, 1.0)
        advantage, target = advantages(
            seen,
            unit * self._values(weights, seen.observation),
            unit * self._values(weights, seen.next_observation),
            self.gamma,
            self.gae_lambda,
        )
        sound = seen.sound.astype(target.dtype)
        size = jnp.sqrt(jnp.sum(sound * target**2) / jnp.maximum(jnp.sum(sound), 1.0) + 1e-8)
        later = jnp.where(spread > 0, 0.9 * spread + 0.1 * size, size)
        spread = jnp.where(jnp.isfinite(later), later, unit)
        outputs = self._outputs(weights, seen.observation)
        log_prob = jax.vmap(jax.vmap(self.head.log_prob))(outputs, seen.raw)
        columns = (seen.observation, seen.raw, log_prob, advantage, target / spread, sound)
        rows = self.horizon * self.envs
        table = jnp.concatenate([c.reshape(rows, -1) for c in columns], 1)
        obs, act = seen.observation.shape[-1], seen.raw.shape[-1]
        flat, unravel = ravel_pytree(weights)

        def loss(flat: Any, batch: Any) -> Any:
            weights = unravel(flat)
            observation, raw, rest = batch[:, :obs], batch[:, obs : obs + act], batch[:, obs + act :]
            old, advantage, target, sound = rest.T
            mean = lambda x: jnp.sum(sound * x) / jnp.maximum(jnp.sum(sound), 1.0)  # noqa: E731
            centred = advantage - mean(advantage)
            advantage = centred / (jnp.sqrt(mean(centred**2)) + 1e-8)
            outputs = self._outputs(weights, observation)
            change = jax.vmap(self.head.log_prob)(outputs, raw) - old
            ratio = jnp.exp(change)
            clipped = jnp.clip(ratio, 1.0 - self.clip, 1.0 + self.clip)
            gain = mean(jnp.minimum(ratio * advantage, clipped * advantage))
            value_loss = mean((self._values(weights, observation) - target) ** 2)
            entropy = mean(jax.vmap(self.head.entropy)(outputs))
            total = -gain + self.value_cost * value_loss - self.entropy_cost * entropy
            return total, (value_loss, entropy, mean(ratio - 1.0 - change))

        def update(carry: Any, batch: Any) -> Any:
            flat, moments = carry
            gradient, seen = jax.grad(loss, has_aux=True)(flat, batch)
            norm = jnp.sqrt(jnp.sum(gradient**2))
            gradient = gradient * jnp.minimum(1.0, self.gradient_limit / (norm + 1e-6))
            direction: Any
            direction, after = _ADAM.update(gradient, moments)
            kept = (flat - self.learning_rate * direction, after)
            taken = jnp.isfinite(norm)
            carry = jax.tree.map(lambda new, old: jnp.where(taken, new, old), kept, carry)
            return carry, (*(jnp.where(taken, x, 0.0) for x in seen), ~taken)

        def epoch(carry: Any, bits: Any) -> Any:
            shuffled = table[jnp.argsort(bits)]
            return jax.lax.scan(update, carry, shuffled.reshape(self.minibatches, -1, table.shape[1]))

        (flat, moments), info = jax.lax.scan(
            epoch, (flat, state.moments), jax.random.bits(key, (self.epochs * rows,)).reshape(self.epochs, rows)
        )
        return PpoState(unravel(flat), moments, spread), info


def advantages(
    seen: Transitions,
    value: Float[Array, "steps worlds"],
    next_value: Float[Array, "steps worlds"],
    gamma: Scalar,
    gae_lambda: Scalar,
) -> tuple[Float[Array, "steps worlds"], Float[Array, "steps worlds"]]:
    """Generalized advantages A and the targets A + V, in units of reward.

    Aₜ = δₜ + γ λ Aₜ₊₁ with δₜ = rₜ + γ V(yₜ₊₁) − V(yₜ); V(yₜ₊₁) is zero after a termination, stays after a time limit,
    and the sum stops where an episode ends. Transitions that are not sound have A = 0.

    Source: Schulman et al. 2016, eq. 16
    """
    delta = seen.reward + gamma * jnp.where(seen.terminated, 0.0, next_value) - value
    delta = jnp.where(seen.sound, delta, 0.0)

    def back(later: Any, x: Any) -> Any:
        delta, ended = x
        advantage = delta + gamma * gae_lambda * jnp.where(ended, 0.0, later)
        return advantage, advantage

    _, advantage = jax.lax.scan(back, jnp.zeros_like(delta[0]), (delta, seen.ended), reverse=True)
    return advantage, advantage + value
