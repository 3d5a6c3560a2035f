"""The classic systems step exactly as Gymnasium's environments do, for any θ."""

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayessim_jax.engines.gymnasium import GYMNASIUM
from bayessim_jax.systems import SYSTEMS

THETAS, STEPS = 100, 200


def gymnasium_run(name, seed):
    """States, actions, rewards and terminations of random steps; an episode that ends simply goes on."""
    env_id, configure, _ = GYMNASIUM[name]
    env = gymnasium.make(env_id, disable_env_checker=True).unwrapped
    rng = np.random.default_rng(seed)
    system = SYSTEMS[name].system()
    theta = rng.uniform(np.asarray(system.parameters.low), np.asarray(system.parameters.high))
    configure(env, theta)
    env.reset(seed=seed)
    states, actions, rewards, ends = [np.array(env.state, float)], [], [], []
    for _ in range(STEPS):
        env.steps_beyond_terminated = None
        discrete = isinstance(env.action_space, gymnasium.spaces.Discrete)
        action = rng.integers(env.action_space.n) if discrete else rng.uniform(-2.5, 2.5, 1)
        _, reward, terminated, _, _ = env.step(action)
        states.append(np.array(env.state, float))
        actions.append(np.atleast_1d(action).astype(float))
        rewards.append(float(reward))
        ends.append(bool(terminated))
    return theta, *(np.array(x) for x in (states, actions, rewards, ends))


@pytest.fixture(scope="module", params=["acrobot", "cartpole", "pendulum"])
def runs(request):
    columns = zip(*(gymnasium_run(request.param, seed) for seed in range(THETAS)), strict=True)
    return request.param, [np.stack(c) for c in columns]


def pack(state):
    return jnp.stack(jax.tree.leaves(state), -1)


def wrapped(name, difference):
    """Angles are compared on the circle."""
    angles = {"cartpole": [], "pendulum": [0], "acrobot": [0, 1]}[name]
    difference = np.array(difference)
    difference[..., angles] = (difference[..., angles] + np.pi) % (2 * np.pi) - np.pi
    return difference


def step_from(name, dtype):
    """One step from each of Gymnasium's own states, in `dtype`."""
    system, task = SYSTEMS[name].system(), SYSTEMS[name].task()
    template = jax.tree.structure(system.reset(jax.random.key(0), system.parameters.low))

    def step(theta, state, action):
        state = jax.tree.unflatten(template, list(state))
        after = system.step(theta, state, action)
        return pack(after), task.reward(state, action, after), task.terminated(after)

    function = jax.jit(jax.vmap(jax.vmap(step, (None, 0, 0))))
    return lambda *arrays: [np.asarray(x) for x in function(*(jnp.asarray(a, dtype) for a in arrays))]


def near_the_line(name, states):
    """Where rounding may decide whether an episode ends."""
    if name == "cartpole":
        margin = np.minimum(abs(abs(states[..., 0]) - 2.4), abs(abs(states[..., 2]) - 12 * 2 * np.pi / 360))
    elif name == "acrobot":
        margin = abs(-np.cos(states[..., 0]) - np.cos(states[..., 0] + states[..., 1]) - 1.0)
    else:
        margin = np.ones(states.shape[:-1])
    return margin < 1e-5


def test_each_step_agrees_in_single_precision(runs):
    name, (theta, states, actions, rewards, ends) = runs
    after, reward, ended = step_from(name, np.float32)(theta, states[:, :-1], actions)
    scale = np.maximum(1.0, np.abs(states[:, 1:]))
    assert np.abs(wrapped(name, after - states[:, 1:]) / scale).max() < 1e-5
    clear = ~near_the_line(name, states[:, 1:])
    assert clear.mean() > 0.99
    np.testing.assert_array_equal(ended[clear], ends[clear])
    np.testing.assert_allclose(reward[clear], rewards[clear], rtol=1e-5, atol=1e-5)


def test_each_step_agrees_in_double_precision(runs):
    name, (theta, states, actions, rewards, ends) = runs
    with jax.enable_x64(True):
        after, reward, ended = step_from(name, np.float64)(theta, states[:, :-1], actions)
    assert np.abs(wrapped(name, after - states[:, 1:])).max() < 1e-9
    np.testing.assert_array_equal(ended, ends)
    np.testing.assert_allclose(reward, rewards, atol=1e-9)


def test_whole_trajectories_agree(runs):
    """200 steps open loop from Gymnasium's first state; Acrobot is chaotic and held to its first 50 steps."""
    name, (theta, states, actions, _, _) = runs
    steps = {"cartpole": STEPS, "pendulum": STEPS, "acrobot": 50}[name]
    with jax.enable_x64(True):
        system = SYSTEMS[name].system()
        template = jax.tree.structure(system.reset(jax.random.key(0), system.parameters.low))

        def roll(theta, start, actions):
            def step(state, action):
                after = system.step(theta, state, action)
                return after, pack(after)

            return jax.lax.scan(step, jax.tree.unflatten(template, list(start)), actions)[1]

        rolled = jax.jit(jax.vmap(roll))(theta, states[:, 0], jnp.asarray(actions[:, :steps]))
    difference = np.abs(wrapped(name, np.asarray(rolled) - states[:, 1 : steps + 1])).max((1, 2))
    assert difference.max() < 1e-5


def test_observations_are_those_of_gymnasium(runs):
    name, (theta, *_) = runs
    env_id, configure, _ = GYMNASIUM[name]
    env = gymnasium.make(env_id, disable_env_checker=True).unwrapped
    configure(env, theta[0])
    env.reset(seed=0)
    system = SYSTEMS[name].system()
    template = jax.tree.structure(system.reset(jax.random.key(0), system.parameters.low))
    action = 1 if name != "pendulum" else np.array([0.7])
    before = np.array(env.state, np.float32)
    seen = env.step(action)[0]
    after = system.step(jnp.asarray(theta[0]), jax.tree.unflatten(template, list(before)), jnp.atleast_1d(action))
    np.testing.assert_allclose(system.observe(jnp.asarray(theta[0]), after), seen, rtol=1e-5, atol=1e-5)
