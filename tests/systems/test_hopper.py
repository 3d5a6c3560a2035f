"""Brax's hopper, contacts solved to the end, is MuJoCo's."""

import importlib.util
import sys
from pathlib import Path

import gymnasium
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from bayessim_jax.beliefs import Uniform
from bayessim_jax.engines.gymnasium import GYMNASIUM
from bayessim_jax.inference.strangeness import STRANGE, strangeness
from bayessim_jax.learning import default_learner
from bayessim_jax.rollout import rollout
from bayessim_jax.systems import Hop, Hopper, hopper
from bayessim_jax.systems.converged import solve_constraints

sys.path.insert(0, str(Path(__file__).parents[2] / "scripts"))
from hopper_gap import RATIOS, compare, follow, record


def test_in_the_air_one_step_is_gymnasiums():
    env_id, configure, _ = GYMNASIUM["hopper"]
    env = gymnasium.make(env_id, disable_env_checker=True).unwrapped
    system, task, rng = Hopper.create(noise=0.0), Hop(), np.random.default_rng(0)

    @jax.jit
    def step(theta, qpos, qvel, action):
        state = system.begin(theta, qpos, qvel)
        after = system.step(theta, state, action)
        return system.observe(theta, state), system.observe(theta, after), task.reward(state, action, after)

    for _ in range(10):
        theta, action = rng.uniform(0.1, 0.5, 1), rng.uniform(-1, 1, 3)
        configure(env, theta)
        env.reset(seed=0)
        # arms of the chain off their stops, well above the floor
        qpos = np.array([rng.normal(), 2.5, *rng.uniform(-0.1, 0.1, 1), *rng.uniform(-1.0, -0.2, 2), 0.1])
        env.set_state(qpos, rng.uniform(-1, 1, 6))
        floats = (jnp.asarray(x, float) for x in (theta, env.data.qpos, env.data.qvel, action))
        before, later, reward = step(*floats)
        np.testing.assert_allclose(before, env._get_obs(), atol=1e-6)
        theirs, paid, *_ = env.step(action)
        np.testing.assert_allclose(later, theirs, atol=1e-5)
        assert float(reward) == pytest.approx(paid, abs=1e-4)


@pytest.mark.slow
def test_the_gap_between_the_engines_is_as_stated():
    gaps, rewards, same_end = compare(Hopper.create(noise=0.0), *record(30, 15, 0))
    """What is left is single precision, and contacts of links that Brax's model has none for."""
    assert np.median(gaps[:, 0], 0).max() < 1e-5
    assert np.median(gaps[:, 14], 0).max() < 1e-4
    assert np.quantile(gaps[:, 14].max(-1), 0.8) < 1e-3
    assert np.median(rewards) < 1e-3
    assert same_end.all()


def test_on_mujoco_it_is_the_environment():
    """Same model, same solver: what is seen and paid, and where it ends, agree but for single precision."""
    gaps, rewards, same_end = compare(Hopper.create(noise=0.0, pipeline="mujoco"), *record(10, 15, 0))
    assert gaps.max() < 1e-4
    assert rewards.max() < 1e-3
    assert same_end.all()


@pytest.mark.slow
def test_friction_that_follows_the_environment_is_the_environments():
    """With Brax's own solver a sliding foot needs more than half as much again."""
    errors = follow(Hopper.create(noise=0.0), *record(30, 15, 0, speed=1.0))
    np.testing.assert_allclose(RATIOS[errors.argmin(1)], 1.0, atol=0.01)


@pytest.mark.slow
def test_brax_as_it_comes_is_strange_and_the_targets_engine_is_not():
    """Sets of eight recordings under a policy that hops, beside simulations around the true friction."""
    system, task = Hopper.create(), Hop()
    learner, belief = default_learner("hopper", system, task), Uniform(system.parameters)

    def improve(state, key):
        return learner.step(key, state, belief)[0], None

    state = learner.init(jax.random.key(0))
    policy = learner.policy(
        jax.jit(lambda s, k: jax.lax.scan(improve, s, k)[0])(state, jax.random.split(jax.random.key(4), 20))
    )

    def sets(pipeline, key, thetas):
        physics = Hopper.create(pipeline=pipeline)
        one = lambda key, theta: rollout(key, physics, theta, policy, 50, task)  # noqa: E731
        return jax.jit(jax.vmap(jax.vmap(one, (0, None))))(jax.random.split(key, (len(thetas), 8)), thetas)

    usual = sets(
        "converged", jax.random.key(1), jax.random.uniform(jax.random.key(2), (64, 1), minval=0.29, maxval=0.31)
    )
    judge = jax.jit(jax.vmap(strangeness, (None, 0, None)))
    true = jnp.full((24, 1), 0.3)
    found = {
        name: judge(usual, sets(name, jax.random.key(3), true), jnp.ones(8, bool)) for name in ("mujoco", "generalized")
    }
    assert np.max(found["mujoco"]) < STRANGE
    assert np.min(found["generalized"]) > 2 * STRANGE


def test_forces_of_constraints_are_those_of_the_accelerations():
    """M a = τ + Jᵀ f with f = max(0, a_ref − J a) / R: rows that push, rows that part, and one that is not there."""
    rng = np.random.default_rng(0)
    with jax.enable_x64():
        for _ in range(20):
            root, jacobian = rng.normal(size=(5, 5)), rng.normal(size=(8, 5))
            mass, force, wanted = root @ root.T + 0.3 * np.eye(5), rng.normal(size=5), rng.normal(size=8)
            compliance = rng.uniform(0.05, 0.5, 8)
            jacobian[3], compliance[3], wanted[3] = 0.0, 0.0, 0.0
            a = np.asarray(solve_constraints(*map(jnp.asarray, (mass, force, jacobian, compliance, wanted))))
            f = np.maximum(wanted - jacobian @ a, 0.0) / np.where(compliance > 0, compliance, np.inf)
            assert 0 < (f > 0).sum() < 8
            np.testing.assert_allclose(mass @ a, force + jacobian.T @ f, atol=1e-9)


def test_friction_slows_a_sliding_machine():
    system = Hopper.create(noise=0.0)
    qvel = jnp.zeros(6).at[0].set(1.0)

    def slide(friction):
        theta = friction[None]
        state = system.begin(theta, jnp.zeros(6).at[1].set(1.25), qvel)
        step = lambda state, _: (system.step(theta, state, jnp.zeros(3)), None)  # noqa: E731
        last = jax.lax.scan(step, state, None, length=12)[0]
        return last.qpos, last.qvel

    data = mujoco.MjData(system.model)
    speeds = []
    for qpos, rates in zip(*jax.jit(jax.vmap(slide))(jnp.array([0.1, 0.3, 0.5])), strict=True):
        data.qpos, data.qvel = qpos, rates
        mujoco.mj_forward(system.model, data)
        mujoco.mj_subtreeVel(system.model, data)
        speeds.append(data.subtree_linvel[0, 0])
    assert (np.diff(speeds) < -0.02).all()


def test_falling_ends_the_task():
    system, task, theta = Hopper.create(), Hop(), jnp.array([0.3])
    stands = jax.jit(lambda qpos: task.terminated(system.begin(theta, qpos, jnp.zeros(6))))
    upright = jnp.zeros(6).at[1].set(1.25)
    assert not stands(upright)
    assert stands(upright.at[1].set(0.69))
    assert stands(upright.at[2].set(-0.21))


def test_without_brax_one_line_tells(monkeypatch):
    hopper._load.cache_clear()
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ValueError, match=r"pip install 'bayessim-jax\[brax\]'"):
        Hopper.create()
    with pytest.raises(ValueError, match="choose one of converged, generalized, positional, spring"):
        Hopper.create(pipeline="planar")
