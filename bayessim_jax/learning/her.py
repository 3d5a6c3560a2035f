"""Deep deterministic policy gradients with hindsight experience replay, against a belief over θ."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import optax
from flax import struct
from jaxtyping import Array, Int, PRNGKeyArray

from bayessim_jax.chance import draw, normal
from bayessim_jax.contracts import Belief, Box, GoalTask, Scalar, System, Task
from bayessim_jax.learning.collect import Transitions, blank, collect
from bayessim_jax.learning.heads import Explorer
from bayessim_jax.learning.networks import Mlp, evaluate_critics
from bayessim_jax.learning.normalisation import Moments
from bayessim_jax.learning.policies import NetworkPolicy
from bayessim_jax.learning.replay import Replay

__all__ = ["Her", "HerInfo", "HerState"]

_ADAM = optax.scale_by_adam()
AHEAD = 10
"""Steps within which something must move for a transition to be replayed often."""


@struct.dataclass
class HerState:
    """Weights of policy and critics, slow copies of both, Adam's moments, what was seen, and the replay."""

    weights: Any
    slow: Any
    moments: Any
    seen: Moments
    replay: Replay


@struct.dataclass
class HerInfo:
    """What a person wants to see of one round."""

    return_mean: Scalar
    """Mean undiscounted return of the exploring episodes of this round."""
    success: Scalar
    """Share of them that were paid the most at their last step."""
    value_loss: Scalar
    """Mean squared Bellman error of the critics."""
    nonfinite: Int[Array, ""]
    """Transitions that were masked because a number was not finite."""
    skipped: Int[Array, ""]
    """Gradient steps that were not taken because the gradient was not finite."""


@struct.dataclass
class Her:
    """Maximizes E Σ γᵗ rₜ for the goal of each episode, learning from every episode as if it had asked for what it got.

    With probability `relabelled` a transition is replayed with a goal that its own episode achieved at this step or
    later; it is replayed more often if something is about to move (`idle`). A deterministic policy climbs the critic Q,

        max Σ Q(y, π(y)) − penalty |π(y)|²,   Q(y, u) ← r + γ min Q'(y', π'(y')),

    with slow copies Q' and π'; targets are clipped to what rewards of the batch's range can sum up to. One critic is
    DDPG; two, with noise on the target's action (`smoothing`), are what TD3 adds to it. Networks see observations and
    goals in units of the standard deviation of what was seen so far.

    One `step` plays `iterations · envs` whole episodes, and takes `updates` gradient steps after every `envs` of them.
    The replay holds the last `rounds_kept` rounds, so that old dynamics fade.

    Source: Andrychowicz et al. 2017; Lillicrap et al. 2016; Fujimoto et al. 2018; Zhao and Tresp 2018
    """

    system: System[Any]
    task: GoalTask[Any]
    head: Explorer
    learning_rate: Scalar
    gamma: Scalar
    slowness: Scalar
    """Fraction of the way that the slow networks follow in one gradient step."""
    relabelled: Scalar
    idle: Scalar
    """How often a transition is replayed that nothing moves after, to one that much does; 1 for evenly."""
    penalty: Scalar
    smoothing: Scalar
    """Standard deviation of the noise on the target's action, in half-widths; it is clipped at 2.5 of them."""
    network: Mlp = struct.field(pytree_node=False)
    critic: Mlp = struct.field(pytree_node=False)
    critics: int = struct.field(pytree_node=False)
    iterations: int = struct.field(pytree_node=False)
    envs: int = struct.field(pytree_node=False)
    horizon: int = struct.field(pytree_node=False)
    updates: int = struct.field(pytree_node=False)
    batch: int = struct.field(pytree_node=False)
    capacity: int = struct.field(pytree_node=False)

    @classmethod
    def create(
        cls,
        system: System[Any],
        task: Task[Any],
        episodes: int = 500,
        *,
        envs: int = 50,
        updates: int = 400,
        batch: int = 256,
        rounds_kept: int = 10,
        learning_rate: float = 1e-3,
        gamma: float = 0.98,
        slowness: float = 0.05,
        relabelled: float = 0.8,
        idle: float = 0.05,
        penalty: float = 0.5,
        deviation: float = 0.2,
        random: float = 0.3,
        critics: int = 1,
        smoothing: float = 0.0,
        widths: tuple[int, ...] = (128, 128, 128),
    ) -> Her:
        """Iterate until `episodes` of the task's length were played; each iteration plays `envs` of them."""
        if not isinstance(task, GoalTask):
            raise ValueError("hindsight needs a task with goals (contracts.GoalTask); choose PPO or SAC for this one.")
        if not isinstance(system.actions, Box):
            raise ValueError("HER needs actions in a box; this system's are discrete: choose PPO.")
        leaf = lambda x: jnp.asarray(x, float)  # noqa: E731
        iterations = -(-episodes // envs)
        return cls(
            system=system,
            task=task,
            head=Explorer(system.actions, leaf(deviation), leaf(random)),
            learning_rate=leaf(learning_rate),
            gamma=leaf(gamma),
            slowness=leaf(slowness),
            relabelled=leaf(relabelled),
            idle=leaf(idle),
            penalty=leaf(penalty),
            smoothing=leaf(smoothing),
            network=Mlp(widths, system.actions.size, nn.relu, 0.01),
            critic=Mlp(widths, 1, nn.relu),
            critics=critics,
            iterations=iterations,
            envs=envs,
            horizon=task.steps,
            updates=updates,
            batch=batch,
            capacity=rounds_kept * iterations * envs * task.steps,
        )

    def init(self, key: PRNGKeyArray) -> HerState:
        """Random weights, an empty replay buffer."""
        policy_key, *keys = jax.random.split(key, 1 + self.critics)
        obs, act = self.system.observations.size, self.head.box.size
        weights = {
            "policy": self.network.init(policy_key, jnp.zeros(obs)),
            "critics": [self.critic.init(k, jnp.zeros(obs + act)) for k in keys],
        }
        replay = Replay.create(self.capacity, 2 * obs + act + 1)
        return HerState(weights, weights, _ADAM.init(weights), Moments.create(obs), replay)

    def policy(self, state: HerState, deterministic: bool = False) -> NetworkPolicy:
        """The current policy: with its noise to explore, deterministic to be judged."""
        return NetworkPolicy(state.weights["policy"], state.seen.scaling(), self.head, self.network, deterministic)

    def step(self, key: PRNGKeyArray, state: HerState, belief: Belief) -> tuple[HerState, HerInfo]:
        """One round: play whole episodes and improve, `iterations` times."""

        def iterate(state: HerState, keys: PRNGKeyArray) -> Any:
            scaling = state.seen.scaling()

            def act(observations: Any) -> Any:
                return self.network.apply(state.weights["policy"], scaling.normalise(observations))

            _, seen, _ = collect(
                keys[0],
                self.system,
                self.task,
                belief,
                blank(self.system, belief, self.envs),
                self.head,
                act,
                self.horizon,
                self.horizon,
            )
            rows, whole = self._rows(seen)
            looks = state.seen.add(seen.observation.reshape(-1, seen.observation.shape[-1]))
            state = replace(state, replay=state.replay.add(rows), seen=looks)
            state, (value_loss, skipped) = self._improve(keys[1], state)
            returns, last = jnp.sum(seen.reward, 0), seen.reward[-1]
            count = jnp.maximum(jnp.sum(whole), 1)
            info = HerInfo(
                return_mean=jnp.sum(whole * returns) / count,
                success=jnp.sum(whole * (last >= 0.0)) / count,
                value_loss=jnp.mean(value_loss),
                nonfinite=jnp.sum(~seen.sound),
                skipped=jnp.sum(skipped),
            )
            return state, info

        state, infos = jax.lax.scan(iterate, state, jax.random.split(key, (self.iterations, 2)))
        means = jax.tree.map(jnp.mean, infos)
        return state, replace(means, nonfinite=jnp.sum(infos.nonfinite), skipped=jnp.sum(infos.skipped))

    def _rows(self, seen: Transitions) -> tuple[Array, Array]:
        """The replay's rows, an episode after the other, and which episodes are sound from end to end."""
        whole = jnp.all(seen.sound, 0)
        mark = jnp.broadcast_to(whole.astype(float), seen.reward.shape)
        columns = (seen.observation, seen.raw, seen.next_observation, mark[..., None])
        rows = jnp.concatenate([jnp.swapaxes(c, 0, 1) for c in columns], -1)
        return rows.reshape(-1, rows.shape[-1]), whole

    def _replay(self, key: PRNGKeyArray, state: HerState) -> tuple[Array, ...]:
        """Normalised batches for all updates: observations, actions, next observations, rewards, soundness."""
        obs, act = self.system.observations.size, self.head.box.size
        goal, achieved = jnp.array(self.task.goal), jnp.array(self.task.achieved)
        sample_key, choice_key = jax.random.split(key)
        size = (self.updates, self.batch)
        rows, later = state.replay.sample_later(sample_key, size, self._weights(state.replay), self.horizon)
        before, action = rows[..., :obs], rows[..., obs : obs + act]
        after, sound = rows[..., obs + act : -1], rows[..., -1]
        hindsight = jax.random.bernoulli(choice_key, self.relabelled, size)
        wanted = jnp.where(hindsight[..., None], later[..., obs + act : -1][..., achieved], before[..., goal])
        pay = jax.vmap(jax.vmap(self.task.pay))
        reward = pay(after[..., achieved], wanted)
        scaling = state.seen.scaling()
        before, after = (scaling.normalise(y.at[..., goal].set(wanted)) for y in (before, after))
        return before, action, after, reward, sound

    def _weights(self, replay: Replay) -> Array:
        """How often each row is replayed: 1 where much moves within the next steps, `idle` where nothing does.

        It is the squared way of what is achieved, over the next `AHEAD` steps, less what the sensors' noise alone
        exceeds in one of a thousand, over its mean. The last rows of an episode share its last `AHEAD` steps.
        """
        obs, act, achieved = self.system.observations.size, self.head.box.size, jnp.array(self.task.achieved)
        episodes = replay.table.reshape(-1, self.horizon, replay.table.shape[1])
        ahead = min(AHEAD, self.horizon)
        first = jnp.minimum(jnp.arange(self.horizon), self.horizon - ahead)
        now, later = episodes[:, first][..., achieved], episodes[:, first + ahead - 1][..., obs + act + achieved]
        noise = 32.0 * jnp.max(self.system.noise[achieved]) ** 2
        moved = jnp.maximum(jnp.sum((later - now) ** 2, -1) - noise, 0.0).ravel()
        mean = jnp.sum(moved) / jnp.maximum(replay.filled, 1)
        return self.idle + (1.0 - self.idle) * jnp.minimum(moved / jnp.maximum(mean, 1e-12), 1.0)

    def _act(self, weights: Any, seen: Any) -> Any:
        outputs: Any = self.network.apply(weights, seen)
        return self.head.mode(outputs)

    def _improve(self, key: PRNGKeyArray, state: HerState) -> tuple[HerState, Any]:
        """`updates` gradient steps of both losses at once; each loss moves its own weights only."""
        replay_key, noise_key = jax.random.split(key)
        batches = self._replay(replay_key, state)
        noises = normal(draw(noise_key, (self.updates, self.batch, self.head.box.size)))

        values = partial(evaluate_critics, self.critic)

        def loss(
            weights: Any, slow: Any, noise: Any, seen: Any, action: Any, after: Any, reward: Any, sound: Any
        ) -> Any:
            frozen = jax.lax.stop_gradient(weights)
            mean = lambda x: jnp.sum(sound * x) / jnp.maximum(jnp.sum(sound), 1.0)  # noqa: E731
            shake = jnp.clip(self.smoothing * noise, -2.5 * self.smoothing, 2.5 * self.smoothing)
            next_action = jnp.clip(self._act(slow["policy"], after) + shake, -1.0, 1.0)
            ahead = jnp.min(values(slow["critics"], after, next_action), -1)
            low, high = jnp.minimum(reward.min(), 0.0), jnp.maximum(reward.max(), 0.0)
            target = jnp.clip(reward + self.gamma * ahead, low / (1.0 - self.gamma), high / (1.0 - self.gamma))
            error = values(weights["critics"], seen, action) - target[:, None]
            value_loss = mean(jnp.sum(error**2, -1))
            chosen = self._act(weights["policy"], seen)
            climbed = values(frozen["critics"], seen, chosen)[..., 0]
            policy_loss = mean(self.penalty * jnp.mean(chosen**2, -1) - climbed)
            return value_loss + policy_loss, value_loss

        def update(carry: Any, x: Any) -> Any:
            weights, slow, moments = carry
            gradient, value_loss = jax.grad(loss, has_aux=True)(weights, slow, *x)
            direction, after = _ADAM.update(gradient, moments)
            moved = jax.tree.map(lambda w, d: w - self.learning_rate * d, weights, direction)
            followed = jax.tree.map(lambda s, w: s + self.slowness * (w - s), slow, moved)
            taken, stepped = jnp.isfinite(optax.tree.norm(gradient)), (moved, followed, after)
            carry = jax.tree.map(lambda a, b: jnp.where(taken, a, b), stepped, carry)
            return carry, (jnp.where(taken, value_loss, 0.0), ~taken)

        carry = (state.weights, state.slow, state.moments)
        (weights, slow, moments), info = jax.lax.scan(update, carry, (noises, *batches))
        return replace(state, weights=weights, slow=slow, moments=moments), info
