"""What the learners learn from: collected transitions, their advantages, and the replay buffer."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct

from bayessim_jax.contracts import Box, Discrete
from bayessim_jax.learning.collect import Transitions, blank, collect
from bayessim_jax.learning.heads import Categorical
from bayessim_jax.learning.ppo import advantages
from bayessim_jax.learning.replay import Replay
from bayessim_jax.systems import from_functions


@struct.dataclass
class UnitBelief:
    def sample(self, key):
        return jax.random.uniform(key, (1,))

    def log_prob(self, theta):
        return jnp.zeros(())


@struct.dataclass
class Reaches:
    """One is paid for each step; ends when the counter reaches a goal."""

    goal: float = struct.field(pytree_node=False, default=100.0)
    steps: int = struct.field(pytree_node=False, default=1000)

    def reward(self, state, action, next_state):
        return jnp.ones(())

    def terminated(self, state):
        return state[0] >= self.goal


def counter(broken=1e9):
    """State (count, θ, start): counts up by one; NaN from `broken` on. The start is random."""

    def step(theta, state, action):
        count = state[0] + 1.0
        return jnp.stack([jnp.where(count >= broken, jnp.nan, count), state[1], state[2]])

    return from_functions(
        parameters=Box.create(a=(0.0, 1.0, "")),
        observations=Box.create(count=(0.0, 1e3, ""), theta=(0.0, 1.0, ""), start=(0.0, 1.0, "")),
        actions=Discrete(2),
        noise=0.0,
        dt=1.0,
        reset=lambda key, theta: jnp.stack([jnp.zeros(()), theta[0], jax.random.uniform(key)]),
        step=step,
    )


def gather(system, task, steps=30, count=8, episode_steps=1000, blocks=1):
    evenly = lambda observations: jnp.zeros((len(observations), 2))  # noqa: E731

    def block(worlds, key):
        worlds, seen, episodes = collect(
            key, system, task, UnitBelief(), worlds, Categorical(2), evenly, steps, episode_steps
        )
        return worlds, (seen, episodes)

    worlds = blank(system, UnitBelief(), count)
    worlds, (seen, episodes) = jax.lax.scan(block, worlds, jax.random.split(jax.random.key(0), blocks))
    join = lambda x: x.reshape(-1, *x.shape[2:])  # noqa: E731
    return worlds, jax.tree.map(join, seen), jax.tree.map(jnp.sum, episodes)


def test_every_episode_has_a_theta_and_a_start_of_its_own():
    _, seen, _ = gather(counter(), Reaches(5.0))
    counts, thetas, starts = np.moveaxis(np.asarray(seen.observation), -1, 0)
    np.testing.assert_array_equal(counts, np.broadcast_to((np.arange(30) % 5)[:, None], (30, 8)))
    assert len(np.unique(thetas)) == len(np.unique(starts)) == 8 * 6
    assert (thetas[:5] == thetas[0]).all()
    np.testing.assert_array_equal(seen.terminated, counts == 4)
    np.testing.assert_array_equal(seen.next_observation[..., 0], counts + 1)


def test_episodes_go_on_from_block_to_block():
    worlds, seen, episodes = gather(counter(), Reaches(12.0), steps=7, blocks=4)
    np.testing.assert_array_equal(seen.observation[:, 0, 0], np.arange(28) % 12)
    np.testing.assert_array_equal(worlds.age, np.full(8, 4))
    assert episodes.count == 16
    assert episodes.gained == episodes.length == 16 * 12


def test_a_time_limit_ends_without_a_termination():
    _, seen, episodes = gather(counter(), Reaches(), episode_steps=6)
    assert not seen.terminated.any()
    np.testing.assert_array_equal(seen.ended[:, 0], np.arange(30) % 6 == 5)
    np.testing.assert_array_equal(seen.next_observation[5, :, 0], 6.0)
    assert episodes.length / episodes.count == 6


def test_an_episode_that_breaks_is_given_up_and_masked():
    worlds, seen, episodes = gather(counter(broken=4.0), Reaches())
    np.testing.assert_array_equal(seen.sound[:, 0], np.arange(30) % 4 != 3)
    np.testing.assert_array_equal(seen.ended, ~seen.sound)
    assert episodes.count == 0
    assert all(np.isfinite(x).all() for x in jax.tree.leaves((worlds, seen)))


def test_a_reset_that_is_no_number_is_masked_too():
    lost = dataclasses.replace(counter(), reset_fn=lambda key, theta: jnp.full(3, jnp.nan))
    _, seen, episodes = gather(lost, Reaches())
    assert not seen.sound.any()
    assert episodes.count == 0
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(seen))


def test_actions_and_chance_differ_between_worlds_and_steps():
    _, seen, _ = gather(counter(), Reaches(), steps=200)
    np.testing.assert_allclose(seen.raw.mean(), 0.5, atol=0.05)
    assert len(np.unique(np.asarray(seen.raw[..., 0]), axis=0)) > 100


def by_hand(reward, value, next_value, terminated, ended, sound, gamma, lam):
    """The sum Σ (γλ)ᵏ δₜ₊ₖ, written out."""
    steps = len(reward)
    delta = [(reward[t] + gamma * (0 if terminated[t] else next_value[t]) - value[t]) * sound[t] for t in range(steps)]
    result = np.zeros(steps)
    for t in range(steps):
        weight = 1.0
        for k in range(t, steps):
            result[t] += weight * delta[k]
            if ended[k]:
                break
            weight *= gamma * lam
    return result


@pytest.mark.parametrize("seed", range(3))
def test_advantages_are_the_written_out_sum(seed):
    rng = np.random.default_rng(seed)
    reward, value, next_value = rng.normal(size=(3, 25))
    ended = rng.uniform(size=25) < 0.25
    sound = ~(ended & (rng.uniform(size=25) < 0.3))
    terminated = ended & sound & (rng.uniform(size=25) < 0.5)
    expected = by_hand(reward, value, next_value, terminated, ended, sound, 0.9, 0.8)
    column = lambda x: jnp.asarray(x)[:, None]  # noqa: E731
    zero = jnp.zeros((25, 1, 1))
    seen = Transitions(zero, zero, column(reward), zero, column(terminated), column(ended), column(sound))
    scalar = lambda x: jnp.asarray(x, float)  # noqa: E731
    advantage, target = advantages(seen, column(value), column(next_value), scalar(0.9), scalar(0.8))
    np.testing.assert_allclose(advantage[:, 0], expected, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(target[:, 0], expected + value, rtol=1e-4, atol=1e-5)


def test_replay_forgets_the_oldest_block_first():
    replay = Replay.create(6, 2)
    for i in range(1, 6):
        replay = replay.add(jnp.full((2, 2), float(i)))
        assert replay.filled == min(2 * i, 6)
    assert set(np.unique(replay.table)) == {3.0, 4.0, 5.0}


def test_replay_shows_only_what_it_holds_and_all_of_it():
    replay = Replay.create(8, 1).add(jnp.array([[1.0], [2.0]])).add(jnp.array([[3.0], [4.0]]))
    drawn = replay.sample(jax.random.key(0), (50, 40))
    assert drawn.shape == (50, 40, 1)
    values, counts = np.unique(drawn, return_counts=True)
    np.testing.assert_array_equal(values, [1, 2, 3, 4])
    assert counts.min() > 400


def test_replay_refuses_blocks_that_do_not_fit():
    with pytest.raises(ValueError, match="capacity 6 is no multiple of the 4 rows"):
        Replay.create(6, 1).add(jnp.zeros((4, 1)))
