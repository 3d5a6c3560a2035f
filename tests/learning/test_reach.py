"""The learners solve the paper's tasks with the settings that their systems take, on Gymnasium's own machines."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayessim_jax.engines import gymnasium_target
from bayessim_jax.learning import default_learner
from bayessim_jax.systems import SYSTEMS


class Near:
    """A belief even over a box; a pytree whose leaves are its bounds."""

    def __init__(self, low, high):
        self.low, self.high = low, high

    def sample(self, key):
        return self.low + (self.high - self.low) * jax.random.uniform(key, self.low.shape)

    def log_prob(self, theta):
        return -jnp.sum(jnp.log(self.high - self.low))


jax.tree_util.register_pytree_node(Near, lambda b: ((b.low, b.high), None), lambda _, leaves: Near(*leaves))


@functools.cache
def compiled(name):
    entry = SYSTEMS[name]
    learner = default_learner(name, entry.system(), entry.task())
    return learner, jax.jit(learner.step)


def train(name, low, high, calls, seed=0):
    learner, step = compiled(name)
    state = learner.init(jax.random.key(seed))
    for i in range(calls):
        state, info = step(jax.random.fold_in(jax.random.key(seed), i), state, Near(low, high))
        assert info.nonfinite == info.skipped == 0
    return learner.policy(state, deterministic=True)


def returns(name, theta, policy, episodes):
    target, steps = gymnasium_target(name, theta), SYSTEMS[name].task().steps
    keys = jax.random.split(jax.random.key(99), episodes)
    return np.asarray(jax.vmap(lambda key: target.record(key, policy, steps))(keys).rewards.sum(-1))


def near(theta):
    theta = jnp.asarray(theta, float)
    return 0.98 * theta, 1.02 * theta


def over_the_prior(name):
    box = SYSTEMS[name].system().parameters
    return box.low, box.high


@pytest.mark.slow
def test_ppo_balances_a_known_pole():
    policy = train("cartpole", *near([0.5, 0.3]), calls=12)
    assert (returns("cartpole", [0.5, 0.3], policy, 20) >= 500).mean() >= 0.95


@pytest.mark.slow
def test_sac_swings_a_known_pendulum_up():
    policy = train("pendulum", *near([0.8, 0.6]), calls=8)
    assert returns("pendulum", [0.8, 0.6], policy, 20).mean() > -200


@pytest.mark.slow
def test_ppo_raises_a_known_acrobot():
    policy = train("acrobot", *near([1.0, 1.0, 1.0, 1.0]), calls=8)
    assert returns("acrobot", [1.0, 1.0, 1.0, 1.0], policy, 20).mean() > -110


@pytest.mark.slow
@pytest.mark.parametrize("theta", [None, [0.1, 0.1], [0.1, 1.0], [1.0, 0.1], [1.0, 1.0]])
@pytest.mark.parametrize("seed", [1, 2])
def test_ppo_balances_poles_of_the_whole_prior(theta, seed):
    box = over_the_prior("cartpole") if theta is None else near(theta)
    policy = train("cartpole", *box, calls=30, seed=seed)
    for tried in [[0.2, 0.9], [0.9, 0.2], [0.6, 0.6]] if theta is None else [theta]:
        assert (returns("cartpole", tried, policy, 100) >= 500).mean() >= 0.95


@pytest.mark.slow
@pytest.mark.parametrize("theta", [None, [0.1, 0.1], [0.1, 1.0], [1.0, 0.1], [1.0, 1.0]])
def test_sac_swings_pendulums_of_the_whole_prior_up(theta):
    box = over_the_prior("pendulum") if theta is None else near(theta)
    policy = train("pendulum", *box, calls=30, seed=1)
    for tried in [[0.3, 0.9], [0.9, 0.3], [0.6, 0.6]] if theta is None else [theta]:
        assert returns("pendulum", tried, policy, 100).mean() > -200


@pytest.mark.slow
@pytest.mark.parametrize(
    ("theta", "least"), [([0.6, 0.6, 0.3, 0.3], -35), ([1.0, 0.6, 0.7, 1.4], -60), ([1.5, 1.2, 1.2, 1.0], -140)]
)
def test_ppo_raises_acrobots(theta, least):
    policy = train("acrobot", *near(theta), calls=30, seed=1)
    assert returns("acrobot", theta, policy, 100).mean() > least
