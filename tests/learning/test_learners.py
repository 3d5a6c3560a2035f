"""What every learner promises."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct

from bayessim_jax.contracts import Box, Discrete, Learner, Policy
from bayessim_jax.control import PLANNERS
from bayessim_jax.learning import DEFAULTS, LEARNERS, Ppo, Sac, default_learner
from bayessim_jax.rollout import rollout
from bayessim_jax.systems import SYSTEMS, from_functions

SMALL = {"episodes": 16, "episode_steps": 20, "envs": 8, "horizon": 20, "widths": (16, 16)}
EXTRA = {"ppo": {"epochs": 2, "minibatches": 2}, "sac": {"updates": 16, "batch": 32}}


@struct.dataclass
class Known:
    """A belief that is sure of θ."""

    theta: jax.Array

    def sample(self, key):
        return self.theta

    def log_prob(self, theta):
        return jnp.zeros(())


@struct.dataclass
class Evenly:
    """A belief even over a box."""

    low: jax.Array
    high: jax.Array

    def sample(self, key):
        return self.low + (self.high - self.low) * jax.random.uniform(key, self.low.shape)

    def log_prob(self, theta):
        return jnp.zeros(())


@struct.dataclass
class Centre:
    """Stay near zero: reward −x² · scale."""

    scale: jax.Array = struct.field(default_factory=lambda: jnp.ones(()))
    steps: int = struct.field(pytree_node=False, default=20)

    def reward(self, state, action, next_state):
        return -self.scale * next_state[0] ** 2

    def terminated(self, state):
        return jnp.zeros((), bool)


def cart(actions=None):
    """A point that moves by θ₁ u, and is NaN beyond θ₂."""

    def step(theta, state, action):
        push = action[0] - 1.0 if isinstance(actions, Discrete) else action[0]
        after = state + 0.2 * theta[0] * push
        return jnp.where(jnp.abs(after) > theta[1], jnp.nan, after)

    return from_functions(
        parameters=Box.create(gain=(0.5, 1.5, ""), wall=(1.0, 9.0, "m")),
        observations=Box.create(x=(-2.0, 2.0, "m")),
        actions=actions or Box.create(push=(-1.0, 1.0, "m/s")),
        noise=0.01,
        dt=0.2,
        reset=lambda key, theta: jax.random.uniform(key, (1,), minval=-1.0, maxval=1.0),
        step=step,
    )


CASES = [("ppo", None), ("ppo", Discrete(3)), ("sac", None)]
SURE = Known(jnp.array([1.0, 9.0]))
TRACES = []


def make(name, actions=None, **settings):
    return LEARNERS[name].create(cart(actions), Centre(), **{**SMALL, **EXTRA[name], **settings})


@functools.cache
def case(name, actions):
    """A learner, its first state and its compiled step, in which every number is an argument."""
    learner = make(name, actions)

    @jax.jit
    def step(learner, key, state, belief):
        TRACES.append((name, actions))
        return learner.step(key, state, belief)

    return learner, learner.init(jax.random.key(0)), step


def types(tree):
    return jax.tree.map(lambda x: (x.shape, x.dtype, x.weak_type), tree)


def same(a, b):
    return all(np.array_equal(x, y) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True))


def finite(tree):
    return all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(tree))


@pytest.mark.parametrize(("name", "actions"), CASES)
def test_step_keeps_the_type_of_its_carry(name, actions):
    learner = make(name, actions)
    assert isinstance(learner, Learner)
    state = jax.eval_shape(learner.init, jax.random.key(0))
    after, info = jax.eval_shape(learner.step, jax.random.key(1), state, SURE)
    assert types(after) == types(state)
    assert info.return_mean.shape == info.nonfinite.shape == ()


@pytest.mark.parametrize(("name", "actions"), CASES)
def test_policy_acts_within_the_actions(name, actions):
    learner, state, _ = case(name, actions)
    keys = jax.random.split(jax.random.key(1), 200)
    for deterministic in (False, True):
        policy = learner.policy(state, deterministic)
        assert isinstance(policy, Policy)
        acts = jax.jit(jax.vmap(lambda k, p=policy: p.act(k, p.init(), jnp.array([0.3]))[0]))(keys)
        assert acts.shape == (200, 1)
        assert len(np.unique(acts)) == 1 if deterministic else len(np.unique(acts)) >= (3 if actions else 50)
        if actions:
            assert set(np.unique(acts)) <= {0.0, 1.0, 2.0}
        else:
            assert np.abs(acts).max() <= 1.0


@pytest.mark.parametrize(("name", "actions"), CASES)
def test_one_key_is_one_round_and_it_is_traced_once(name, actions):
    learner, state, step = case(name, actions)
    a, info = step(learner, jax.random.key(1), state, SURE)
    b, _ = step(learner, jax.random.key(1), state, SURE)
    c, _ = step(learner, jax.random.key(2), state, SURE)
    step(learner.replace(learning_rate=jnp.asarray(1e-2, float)), jax.random.key(3), a, Known(jnp.array([0.7, 5.0])))
    assert same(a, b)
    assert not same(a, c)
    assert TRACES.count((name, actions)) == 1
    assert info.nonfinite == info.skipped == 0
    assert info.length_mean == 20


@pytest.mark.parametrize("name", ["ppo", pytest.param("sac", marks=pytest.mark.slow)])
def test_seeds_and_learning_rates_batch(name):
    learner, state, step = case(name, None)
    rates = jnp.array([1e-3, 1e-2, 1e-3])
    keys = jnp.stack([jax.random.key(1)] * 3)
    together = jax.jit(jax.vmap(lambda k, r: learner.replace(learning_rate=r).step(k, state, SURE)))(keys, rates)
    assert together[1].return_mean.shape == (3,)
    alone = step(learner.replace(learning_rate=rates[1]), keys[1], state, SURE)[0]
    weights = jax.tree.leaves(together[0].weights)
    assert all(np.array_equal(w[0], w[2]) for w in weights)
    assert any(not np.array_equal(w[0], w[1]) for w in weights)
    for batched, single in zip(weights, jax.tree.leaves(alone.weights), strict=True):
        np.testing.assert_allclose(batched[1], single, rtol=2e-3, atol=2e-4)


@pytest.mark.parametrize(("name", "actions"), CASES)
def test_it_learns_to_stay_near_the_centre(name, actions):
    """From x uniform in ±1 a policy that does nothing is paid −20/3; one that goes to zero at once about −1."""
    learner, state, step = case(name, actions)
    learner = learner.replace(learning_rate=jnp.asarray(3e-3, float))
    belief = Evenly(jnp.array([0.5, 8.0]), jnp.array([1.5, 9.0]))
    for i in range(60):
        state, _ = step(learner, jax.random.key(i), state, belief)
    policy = learner.policy(state, deterministic=True)
    play = lambda key: rollout(key, learner.system, SURE.theta, policy, 20, Centre()).rewards.sum()  # noqa: E731
    assert jax.jit(jax.vmap(play))(jax.random.split(jax.random.key(99), 200)).mean() > -1.5


@pytest.mark.parametrize(("name", "actions"), CASES)
def test_transitions_that_are_no_numbers_are_counted_and_change_nothing_else(name, actions):
    learner, state, step = case(name, actions)
    state, info = step(learner, jax.random.key(1), state, Known(jnp.array([1.0, 1.2])))
    assert 0 < info.nonfinite < 160
    assert info.skipped == 0
    assert finite((state, info))


@pytest.mark.parametrize(("name", "actions"), CASES)
def test_a_gradient_that_is_no_number_is_skipped_and_counted(name, actions):
    learner, before, step = case(name, actions)
    after, info = step(learner.replace(task=Centre(jnp.asarray(1e30, float))), jax.random.key(1), before, SURE)
    assert info.skipped > 0
    assert finite((after.weights, after.moments, after.spread))
    if name == "ppo":
        assert same(before.weights, after.weights)


def test_a_belief_reaches_the_learner_as_data():
    """The further a push carries, the more a policy that knows nothing yet is paid for wandering off."""
    learner, state, step = case("ppo", None)
    slow, fast = (step(learner, jax.random.key(1), state, Known(jnp.array([t, 9.0])))[1] for t in (0.5, 1.5))
    assert fast.return_mean < slow.return_mean


def test_bad_settings_are_told():
    with pytest.raises(ValueError, match="minibatches 3 must divide envs · horizon = 160"):
        make("ppo", minibatches=3)
    with pytest.raises(ValueError, match=r"SAC needs actions in a box.*choose PPO"):
        make("sac", Discrete(3))


@pytest.mark.parametrize("name", SYSTEMS)
def test_every_registered_system_has_its_learner(name):
    entry = SYSTEMS[name]
    learner = default_learner(name, entry.system(), entry.task())
    assert isinstance(learner, LEARNERS[DEFAULTS[name][0]])
    assert entry.learner in (DEFAULTS[name][0], *PLANNERS)
    assert learner.iterations * learner.envs * learner.horizon == (25_000 if entry.learner == "her" else 15_000)
    assert set(DEFAULTS) == {*SYSTEMS, "diagnosed"}


def test_default_learner_offers_the_near_miss():
    with pytest.raises(ValueError, match="'acrobat': did you mean 'acrobot'"):
        default_learner("acrobat", cart(), Centre())


def test_the_work_of_stable_baselines_can_be_asked_for():
    learner = Ppo.create(cart(), Centre(), envs=16, horizon=128, epochs=10, minibatches=32)
    assert learner.iterations == 8
    assert learner.envs * learner.horizon == 2048
    assert isinstance(Sac.create(cart(), Centre()), Learner)
