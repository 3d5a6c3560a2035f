"""Fetch Push and Slide step as gymnasium-robotics' environments do, for any friction."""

import functools

import gymnasium
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from bayessim_jax.contracts import GoalTask
from bayessim_jax.engines import gymnasium as host
from bayessim_jax.engines.mujoco import PHYSICS
from bayessim_jax.learning import RandomPolicy
from bayessim_jax.rollout import rollout
from bayessim_jax.systems import SYSTEMS, MoveTo
from bayessim_jax.systems.fetch import CLEARANCE, FetchState

NAMES = ["fetch_push", "fetch_slide"]


@functools.cache
def system_of(name):
    return SYSTEMS[name].system(noise=0.0)


@functools.cache
def environment(name):
    host.require_robotics()
    return gymnasium.make(host.GYMNASIUM[name][0], disable_env_checker=True).unwrapped


def seen(env, observation):
    return np.concatenate([observation["observation"], observation["desired_goal"]])


def state_of(env, system, theta):
    """The environment's state as one of ours, to the last bit."""
    data, bits = env.data, np.zeros(system.engine.rest.size)
    mujoco.mj_getState(env.model, data, bits, PHYSICS)
    physics = system.engine.init(theta, jnp.asarray(data.qpos, float), jnp.asarray(data.qvel, float))
    grip, link = data.site("robot0:grip"), data.body("robot0:gripper_link")
    rate = env._utils.get_site_xvelp(env.model, data, "robot0:grip")
    hand = np.concatenate([grip.xpos, rate, link.xpos, link.xquat])
    return FetchState(
        physics.replace(physics=jnp.asarray(bits.view(np.uint32))), jnp.asarray(hand, float), jnp.asarray(env.goal)
    )


def chase(env, rng, step):
    """Half of the episodes go after the object, the others anywhere."""
    if env.np_random_seed % 2:
        gap = env.data.site("object0").xpos - env.data.site("robot0:grip").xpos
        return np.clip(8 * gap + [0, 0, 0.02] + 0.1 * rng.normal(size=3), -1, 1)
    return rng.uniform(-1, 1, 3)


@functools.cache
def one_step_errors(name, episodes=8, steps=50):
    """What one control period from the environment's own states makes different: [step, channel], and rewards."""
    system, env, task = system_of(name), environment(name), MoveTo()
    rng = np.random.default_rng(0)

    @jax.jit
    def step(theta, state, action):
        after = system.step(theta, state, action)
        return system.observe(theta, state), system.observe(theta, after), task.reward(state, action, after)

    errors, rewards = [], []
    for seed in range(episodes):
        theta = jnp.asarray(rng.uniform(0.1, 2.0, 1), float)
        host.hide_fetch(env, np.asarray(theta))
        before, _ = env.reset(seed=seed)
        for t in range(steps):
            action = np.append(chase(env, rng, t), 0.3).astype(np.float32)
            shown, later, reward = step(theta, state_of(env, system, theta), jnp.asarray(action))
            np.testing.assert_allclose(_turned(shown - seen(env, before)), 0.0, atol=2e-6)
            before, paid, *_ = env.step(action)
            errors.append(np.abs(_turned(later - seen(env, before))))
            rewards.append(float(reward) == float(paid))
    return np.array(errors), np.array(rewards)


def _turned(difference):
    """Angles are compared on the circle."""
    difference = np.array(difference)
    difference[11:14] = (difference[11:14] + np.pi) % (2 * np.pi) - np.pi
    return difference


@pytest.mark.parametrize("name", NAMES)
def test_one_step_is_that_of_the_environment(name):
    """Ours starts the constraint solver from rest at each control step, which shows where contacts are many."""
    errors, same_reward = one_step_errors(name)
    worst = errors.max(1)
    assert np.median(worst) < 1e-6
    assert np.quantile(worst, 0.9) < 1e-3
    assert errors[:, :6].max() < 0.02
    assert same_reward.mean() > 0.99


@pytest.mark.parametrize("name", NAMES)
def test_episodes_begin_as_in_the_environment(name):
    system, env = system_of(name), environment(name)
    theta = jnp.array([0.7])
    keys = jax.random.split(jax.random.key(0), 400)
    begun = jax.jit(jax.vmap(lambda k: system.observe(theta, system.reset(k, theta))))(keys)
    theirs = np.array([seen(env, env.reset(seed=seed)[0]) for seed in range(400)])
    place, goal = slice(3, 5), slice(25, 27)
    for part in (place, goal):
        np.testing.assert_allclose(begun[:, part].mean(0), theirs[:, part].mean(0), atol=0.03)
        np.testing.assert_allclose(begun[:, part].min(0), theirs[:, part].min(0), atol=0.03)
        np.testing.assert_allclose(begun[:, part].max(0), theirs[:, part].max(0), atol=0.03)
    fixed = [c for c in range(28) if c not in (3, 4, 6, 7, 25, 26)]
    np.testing.assert_allclose(begun[:, fixed], np.broadcast_to(theirs[0, fixed], (400, len(fixed))), atol=1e-6)
    assert np.linalg.norm(begun[:, 6:8], axis=1).min() >= CLEARANCE - 2e-3


@pytest.mark.parametrize("name", NAMES)
def test_friction_decides_how_far_an_object_slides(name):
    system = system_of(name)
    state = system.reset(jax.random.key(0), jnp.array([0.5]))
    physics = system.engine.init(jnp.array([0.5]), state.physics.qpos, state.physics.qvel.at[-6].set(0.6))

    def slid(friction):
        theta, after = friction[None], state.replace(physics=physics)
        for _ in range(15):
            after = system.step(theta, after, jnp.array([0.0, 0.0, 0.5, 0.0]))
        return after.physics.qpos[-7] - physics.qpos[-7]

    far = jax.jit(jax.vmap(slid))(jnp.array([0.15, 0.5, 1.0, 1.8]))
    assert (np.diff(far) < -1e-3).all()
    np.testing.assert_allclose(far[1], 0.6**2 / (2 * 0.5 * 9.81), rtol=0.2)


def test_the_task_pays_where_the_object_is():
    task, system = MoveTo(), system_of("fetch_push")
    assert isinstance(task, GoalTask)
    assert not isinstance(SYSTEMS["pendulum"].task(), GoalTask)
    goal = jnp.array([1.3, 0.7, 0.42])
    assert task.pay(goal + jnp.array([0.04, 0.0, 0.0]), goal) == 0.0
    assert task.pay(goal + jnp.array([0.04, 0.04, 0.0]), goal) == -1.0
    recording = rollout(jax.random.key(0), system, jnp.array([0.5]), RandomPolicy(system.actions), 20, task)
    later = recording.observations[1:]
    paid = jax.vmap(task.pay)(later[:, jnp.array(task.achieved)], later[:, jnp.array(task.goal)])
    np.testing.assert_array_equal(recording.rewards, paid)


def test_without_gymnasium_robotics_one_line_tells(monkeypatch):
    monkeypatch.setattr(host.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ValueError, match=r"pip install 'bayessim-jax\[fetch\]'"):
        host.gymnasium_target("fetch_push", [0.5])


def test_features_do_not_know_where_on_the_table_things_happen():
    """Turning and moving the whole scene changes what is seen, and nothing of what an encoder reads."""
    system, steps = system_of("fetch_push"), 6
    rng = np.random.default_rng(0)
    o = 0.01 * rng.normal(size=(steps + 1, system.observations.size))
    o[:, :3] += (1.3, 0.7, 0.45)
    o[:, 3:6] = o[:, :3] + (0.1, 0.05, -0.02) + 0.01 * rng.normal(size=(steps + 1, 3))
    o[:, 6:9] = o[:, 3:6] - o[:, :3]
    o[:, 11:13] = 0.0  # the angles of a tilted object are no vector
    u, (cos, sin) = rng.normal(size=(steps, 4)), (np.cos(0.7), np.sin(0.7))

    def turned(v):
        return np.stack([cos * v[:, 0] - sin * v[:, 1], sin * v[:, 0] + cos * v[:, 1], v[:, 2]], -1)

    there, v = o.copy(), u.copy()
    for first in (0, 3, 6, 14, 17, 20, 25):
        there[:, first : first + 3] = turned(o[:, first : first + 3])
    for first in (0, 3, 25):
        there[:, first : first + 2] += (0.2, -0.1)
    there[:, 13] += 0.7
    v[:, :3] = turned(u[:, :3])
    valid = np.arange(steps) < 4
    bare = jax.eval_shape(
        lambda: rollout(jax.random.key(0), system, jnp.array([0.5]), RandomPolicy(system.actions), steps)
    )
    empty = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), bare)

    def read(observations, actions):
        as_arrays = {"observations": jnp.asarray(observations), "actions": jnp.asarray(actions)}
        return np.asarray(system.features(empty.replace(valid=jnp.asarray(valid), **as_arrays)))

    np.testing.assert_allclose(read(there, v), read(o, u), atol=2e-3)
    assert (read(o, u)[valid].std(0) > 1e-3).sum() > 30
    assert (read(o, u)[~valid] == 0).all()
    assert not np.allclose(read(there, u), read(o, u), atol=0.1)
