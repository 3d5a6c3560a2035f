"""Hindsight: what is replayed would have been seen and paid under another goal, and sparse goals are learned."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct

from bayessim_jax.beliefs import Uniform
from bayessim_jax.contracts import Box, Discrete, GoalTask, Learner
from bayessim_jax.learning import Her
from bayessim_jax.learning.heads import Explorer
from bayessim_jax.learning.normalisation import Moments
from bayessim_jax.learning.replay import Replay
from bayessim_jax.rollout import rollout
from bayessim_jax.systems import from_functions


@struct.dataclass
class Reach:
    """Be within 0.1 of a goal in the plane."""

    steps: int = struct.field(pytree_node=False, default=10)
    goal: tuple = struct.field(pytree_node=False, default=(2, 3))
    achieved: tuple = struct.field(pytree_node=False, default=(0, 1))

    def reward(self, state, action, next_state):
        return self.pay(next_state[:2], next_state[2:])

    def terminated(self, state):
        return jnp.zeros((), bool)

    def pay(self, achieved, goal):
        return -(jnp.sum((achieved - goal) ** 2) > 0.01).astype(float)


def plane(broken=9.0):
    """A point in the plane that moves by θ u, and is NaN beyond `broken`; the goal is drawn at the reset."""

    def step(theta, state, action):
        place = state[:2] + 0.3 * theta[0] * action
        return jnp.concatenate([jnp.where(jnp.abs(place).max() > broken, jnp.nan, place), state[2:]])

    return from_functions(
        parameters=Box.create(gain=(0.7, 1.3, "")),
        observations=Box.create(**dict.fromkeys(("x", "y", "goal_x", "goal_y"), (-2.0, 2.0, "m"))),
        actions=Box.create(u=(-1.0, 1.0, "m/s"), v=(-1.0, 1.0, "m/s")),
        noise=0.0,
        dt=0.3,
        reset=lambda key, theta: jnp.append(jnp.zeros(2), jax.random.uniform(key, (2,), minval=-1.0, maxval=1.0)),
        step=step,
    )


SMALL = {"episodes": 40, "envs": 20, "updates": 40, "batch": 64, "widths": (32, 32), "rounds_kept": 2}


@functools.cache
def case(broken=9.0, **changes):
    learner = Her.create(plane(broken), Reach(), **{**SMALL, **changes})
    belief = Uniform(learner.system.parameters)
    step = jax.jit(lambda learner, key, state: learner.step(key, state, belief))
    return learner, learner.init(jax.random.key(0)), functools.partial(step, learner)


def test_it_keeps_the_contract_of_learners():
    learner, state, step = case()
    assert isinstance(learner, Learner)
    assert isinstance(learner.task, GoalTask)
    after, info = jax.eval_shape(step, jax.random.key(1), state)
    types = lambda tree: jax.tree.map(lambda x: (x.shape, x.dtype), tree)  # noqa: E731
    assert types(after) == types(state)
    assert info.return_mean.shape == info.success.shape == info.nonfinite.shape == ()
    one, two = step(jax.random.key(1), state)[0], step(jax.random.key(1), state)[0]
    assert all(np.array_equal(a, b) for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(two), strict=True))


@pytest.mark.parametrize("changes", [{}, pytest.param({"critics": 2, "smoothing": 0.2}, marks=pytest.mark.slow)])
def test_a_sparse_goal_is_reached(changes):
    """The point is at the goal at the end of an episode by chance in 3 % of them; trained, in nine of ten."""
    learner, state, step = case(**changes)
    for i in range(25):
        state, info = step(jax.random.key(i), state)
        assert info.skipped == info.nonfinite == 0
    policy = learner.policy(state, deterministic=True)
    play = lambda key: rollout(key, learner.system, jnp.ones(1), policy, 10, Reach()).rewards[-1]  # noqa: E731
    assert (jax.jit(jax.vmap(play))(jax.random.split(jax.random.key(99), 200)) == 0).mean() > 0.9


def test_without_hindsight_it_is_not():
    _, state, step = case(relabelled=0.0, episodes=20)
    for i in range(25):
        state, info = step(jax.random.key(i), state)
    assert info.success < 0.5


def test_replayed_transitions_are_those_that_happened_and_are_paid_for_the_goal_they_show():
    learner, state, step = case()
    state = step(jax.random.key(1), state)[0]
    scaling = state.seen.scaling()
    before, action, after, reward, sound = learner._replay(jax.random.key(2), state)
    before, after = (y * scaling.scale + scaling.shift for y in (before, after))
    assert sound.all()
    moved = np.linalg.norm(after[..., :2] - before[..., :2], axis=-1)
    np.testing.assert_allclose(moved / np.linalg.norm(action, axis=-1) / 0.3, 1.0, atol=0.31)
    np.testing.assert_array_equal(before[..., 2:], after[..., 2:])
    there = ((after[..., :2] - after[..., 2:]) ** 2).sum(-1) <= 0.01
    np.testing.assert_array_equal(reward, np.where(there, 0.0, -1.0))
    # of ten steps a goal is one's own with probability 1/10, 1/9, …: 29 % of what is relabelled
    assert 0.15 < there.mean() < 0.5


def test_broken_episodes_are_kept_out():
    learner, state, step = case(broken=0.5)
    state, info = step(jax.random.key(1), state)
    assert info.nonfinite > 0
    assert info.skipped == 0
    *_, sound = learner._replay(jax.random.key(2), state)
    assert 0 < sound.mean() < 1
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((state, info)))


def test_later_rows_are_of_the_same_episode():
    replay = Replay.create(60, 2)
    rows = jnp.stack([jnp.repeat(jnp.arange(4.0), 10), jnp.tile(jnp.arange(10.0), 4)], -1)
    weights = jnp.repeat(jnp.array([1.0, 1.0, 0.0, 2.0, 5.0, 5.0]), 10)
    replay = replay.add(rows[:20]).add(rows[20:])
    now, later = replay.sample_later(jax.random.key(0), (5000,), weights, 10)
    np.testing.assert_allclose(np.bincount(now[:, 0].astype(int)) / 5000, [0.25, 0.25, 0.0, 0.5], atol=0.03)
    np.testing.assert_array_equal(now[:, 0], later[:, 0])
    assert (later[:, 1] >= now[:, 1]).all()
    first = later[now[:, 1] == 0, 1]
    np.testing.assert_allclose(np.bincount(first.astype(int), minlength=10) / first.size, 0.1, atol=0.05)


def test_what_is_about_to_move_is_replayed_most_and_noise_moves_nothing():
    """Of two noisy episodes of 30 steps the first stands still, the second goes 0.4 m in its steps 15 and 16."""
    task = Reach(steps=30)
    learner = Her.create(plane().replace(noise=jnp.full(4, 1e-3)), task, **(SMALL | {"episodes": 2, "envs": 2}))
    place = jnp.zeros((2, 31, 2)).at[1, 16, 0].set(0.2).at[1, 17:, 0].set(0.4)
    seen = jnp.concatenate([place + 1e-3 * jax.random.normal(jax.random.key(0), place.shape), 0 * place], -1)
    rows = jnp.concatenate([seen[:, :-1], jnp.zeros((2, 30, 2)), seen[:, 1:], jnp.ones((2, 30, 1))], -1)
    replay = learner.init(jax.random.key(0)).replay.add(rows.reshape(60, -1))
    still, moving = learner._weights(replay)[:60].reshape(2, 30)
    idle = float(learner.idle)
    np.testing.assert_allclose(still, idle)
    np.testing.assert_allclose(moving[:6], idle)
    np.testing.assert_allclose(moving[7:16], 1.0)
    np.testing.assert_allclose(moving[17:], idle)


def test_moments_are_those_of_everything_seen():
    rows = 3.0 + jnp.array([1.0, 1e-4]) * jax.random.normal(jax.random.key(0), (90, 2))
    moments = Moments.create(2)
    assert (moments.scaling().scale == 1.0).all()
    for part in jnp.split(rows, [10, 50]):
        moments = moments.add(part)
    np.testing.assert_allclose(moments.mean, rows.mean(0), rtol=1e-5)
    np.testing.assert_allclose(jnp.sqrt(moments.variance), rows.std(0), rtol=1e-2)
    np.testing.assert_allclose(moments.scaling().scale, [rows[:, 0].std(), 1e-2], rtol=1e-4)


def test_exploration_is_noise_and_now_and_then_anything():
    box = Box.create(a=(-2.0, 2.0, "N"))
    head = Explorer(box, jnp.array(0.1), jnp.array(0.25))
    noise = head.noise(jax.random.uniform(jax.random.key(0), (4000, head.chances), minval=1e-6))
    actions = np.asarray(jax.vmap(lambda n: head.action(head.sample(jnp.array([0.5]), n)))(noise))[:, 0]
    middle = 2 * np.tanh(0.5)
    assert head.action(head.mode(jnp.array([0.5])))[0] == pytest.approx(middle)
    assert np.abs(actions).max() <= 2.0
    assert np.mean(np.abs(actions - middle) > 0.8) == pytest.approx(0.25 * (2.0 + middle - 0.8) / 4, abs=0.03)


def test_other_tasks_and_actions_are_refused():
    with pytest.raises(ValueError, match="choose PPO or SAC"):
        Her.create(plane(), struct.dataclass(type("Plain", (), {"steps": 5, "__annotations__": {}}))())
    indices = plane().replace(actions=Discrete(2))
    with pytest.raises(ValueError, match="choose PPO"):
        Her.create(indices, Reach())
