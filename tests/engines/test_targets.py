"""Both targets show the same machine, whatever they are wrapped in."""

import subprocess
import sys
from pathlib import Path

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct

from bayessim_jax.contracts import Target
from bayessim_jax.engines import GymnasiumTarget, SimulatedTarget, gymnasium_target
from bayessim_jax.engines import gymnasium as host
from bayessim_jax.learning import RandomPolicy
from bayessim_jax.systems import SYSTEMS


@struct.dataclass
class Reflex:
    """u = gain · y; an index (u > 0) where the actions are discrete."""

    gain: jax.Array
    discrete: bool = struct.field(pytree_node=False, default=True)

    def init(self):
        return ()

    def act(self, key, memory, observation):
        push = observation @ self.gain
        return jnp.atleast_1d((push > 0).astype(float) if self.discrete else push), memory


BALANCE = Reflex(jnp.array([0.1, 0.3, 1.0, 0.6]))
FALL = Reflex(jnp.array([0.0, 0.0, -1.0, 0.0]))
BRAKE = Reflex(jnp.array([0.0, 0.0, -0.1]), discrete=False)


def pool(target):
    return host._pool(target.env_id, target.configure)


def same(a, b):
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_array_equal(x, y)


@pytest.mark.parametrize("name", host.GYMNASIUM)
def test_targets_keep_the_contract(name):
    entry = SYSTEMS[name]
    system = entry.system()
    theta = (system.parameters.low + system.parameters.high) / 2
    policy = RandomPolicy(system.actions)
    real = gymnasium_target(name, theta, system.noise)
    stand_in = SimulatedTarget(system, entry.task(), theta)
    assert isinstance(real, Target)
    assert isinstance(stand_in, Target)
    a, b = (jax.eval_shape(lambda k, t=t: t.record(k, policy, 12), jax.random.key(0)) for t in (real, stand_in))
    assert jax.tree.map(lambda x: (x.shape, x.dtype), a) == jax.tree.map(lambda x: (x.shape, x.dtype), b)
    np.testing.assert_allclose(real.noise, system.noise)
    np.testing.assert_allclose(real.record(jax.random.key(0), policy, 3).times, system.dt * np.arange(4))


def returns(target, policy, steps, episodes):
    keys = jax.random.split(jax.random.key(1), episodes)
    recordings = jax.jit(jax.vmap(lambda k: target.record(k, policy, steps)))(keys)
    return np.asarray(recordings.rewards.sum(-1)), recordings


@pytest.mark.parametrize(
    ("name", "policy", "steps"), [("cartpole", FALL, 100), pytest.param("pendulum", BRAKE, 100, marks=pytest.mark.slow)]
)
def test_targets_agree_in_return(name, policy, steps):
    """The same policy on the same θ: the two samples of returns pass for one."""
    from scipy.stats import ks_2samp

    entry, theta = SYSTEMS[name], jnp.array([0.6, 0.4])
    real, recordings = returns(gymnasium_target(name, theta), policy, steps, 150)
    stand_in, _ = returns(SimulatedTarget(entry.system(), entry.task(), theta), policy, steps, 150)
    assert ks_2samp(real, stand_in).pvalue > 0.001
    assert real.std() > 0
    assert not recordings.diverged.any()
    other, _ = returns(SimulatedTarget(entry.system(), entry.task(), jnp.array([0.2, 0.9])), policy, steps, 150)
    assert ks_2samp(real, other).pvalue < 0.001


def test_observations_are_the_environments_plus_the_stated_noise():
    theta = jnp.array([0.6, 0.4])
    quiet = gymnasium_target("cartpole", theta, noise=0.0).record(jax.random.key(2), BALANCE, 60)
    env = gymnasium.make("CartPole-v1", disable_env_checker=True)
    host.hide_cartpole(env.unwrapped, np.asarray(theta))
    env.reset(seed=0)
    for t in range(60):
        env.unwrapped.state = np.asarray(quiet.observations[t], float)
        after = env.step(int(quiet.actions[t, 0]))[0]
        np.testing.assert_allclose(quiet.observations[t + 1], after, atol=1e-6)
    frozen = Reflex(jnp.zeros(4))
    noise = jnp.array([0.1, 0.2, 0.3, 0.4])
    keys = jax.random.split(jax.random.key(0), 400)
    record = lambda n: jax.vmap(lambda k: gymnasium_target("cartpole", theta, n).record(k, frozen, 5))(keys)  # noqa: E731
    error = record(noise).observations - record(0.0).observations
    np.testing.assert_allclose(error.std((0, 1)), noise, rtol=0.06)


def test_one_key_is_one_recording_however_it_is_run():
    target = gymnasium_target("cartpole", jnp.array([0.5, 0.3]))
    keys = jax.random.split(jax.random.key(0), 4)
    run = lambda key: target.record(key, BALANCE, 40)  # noqa: E731
    single = [run(key) for key in keys]
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *single)
    same(single[1], run(keys[1]))
    same(single[2], jax.jit(run)(keys[2]))
    same(stacked, jax.jit(lambda k: jax.lax.scan(lambda c, key: (c, run(key)), 0, k)[1])(keys))
    same(stacked, jax.jit(jax.vmap(run))(keys))
    assert not np.array_equal(single[0].observations, single[1].observations)


def test_one_key_is_one_recording_in_another_process():
    code = (
        "import jax, jax.numpy as jnp\n"
        "from bayessim_jax.engines import gymnasium_target\n"
        "from tests.engines.test_targets import BALANCE\n"
        "r = gymnasium_target('cartpole', jnp.array([0.5, 0.3])).record(jax.random.key(7), BALANCE, 30)\n"
        "import numpy as np; print(np.asarray(r.observations).tobytes().hex())"
    )
    here = gymnasium_target("cartpole", jnp.array([0.5, 0.3])).record(jax.random.key(7), BALANCE, 30)
    root = Path(__file__).parents[2]
    there = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=root)
    assert np.asarray(here.observations).tobytes().hex() == there.stdout.strip()


def test_every_seed_of_a_batch_hides_its_own_parameters():
    thetas = jnp.array([[0.3, 0.3], [0.9, 0.1], [0.5, 0.9]])
    target = gymnasium_target("pendulum", thetas[0])
    keys = jnp.broadcast_to(jax.random.key(3), (3,))
    together = jax.jit(jax.vmap(lambda t, k: target.replace(theta=t).record(k, BRAKE, 30)))(thetas, keys)
    for i in range(3):
        alone = gymnasium_target("pendulum", thetas[i]).record(keys[i], BRAKE, 30)
        np.testing.assert_allclose(alone.observations, together.observations[i], atol=1e-6)
    assert np.abs(together.observations[0] - together.observations[1]).max() > 0.1


def test_nothing_happens_after_the_end():
    target = gymnasium_target("cartpole", jnp.array([0.5, 0.1]))
    recording = target.record(jax.random.key(0), FALL, 80)
    steps = int(recording.valid.sum())
    assert 5 < steps < 80
    assert recording.valid[:steps].all()
    assert recording.rewards.sum() == steps
    assert not recording.diverged
    for padded in (recording.observations[steps + 1 :], recording.actions[steps:], recording.rewards[steps:]):
        assert (padded == 0).all()


def test_the_environments_time_limit_ends_the_recording():
    recording = gymnasium_target("pendulum", jnp.array([0.5, 0.5])).record(jax.random.key(0), BRAKE, 220)
    assert recording.valid.sum() == 200
    assert not recording.diverged


def test_environments_are_given_back_and_used_again():
    target = GymnasiumTarget.create("CartPole-v1", _hide_fresh, [0.5, 0.1], 0.01, 0.02)
    keys = jax.random.split(jax.random.key(0), 6)
    run = jax.jit(jax.vmap(lambda k, p: target.record(k, p, 30), in_axes=(0, None)))
    for policy in (BALANCE, FALL, BALANCE):
        jax.block_until_ready(run(keys, policy))
        assert pool(target).made == 6
        assert len(pool(target).waiting) == 6
        assert not pool(target).acting


def _hide_fresh(env, theta):
    host.hide_cartpole(env, theta)


@struct.dataclass
class Breaks:
    """Turns into NaN after some steps."""

    step: int = struct.field(pytree_node=False)

    def init(self):
        return jnp.zeros((), jnp.int32)

    def act(self, key, memory, observation):
        return jnp.where(memory >= self.step, jnp.nan, 1.0)[None], memory + 1


def test_an_action_that_is_no_number_is_masked_and_never_reaches_the_environment():
    target = gymnasium_target("cartpole", jnp.array([0.5, 0.5]))
    recording = target.record(jax.random.key(0), Breaks(4), 20)
    np.testing.assert_array_equal(recording.valid, np.arange(20) < 4)
    assert recording.diverged
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(recording))
    assert not pool(target).acting


def test_the_memory_of_a_policy_is_carried():
    recording = gymnasium_target("acrobot", [1.0, 1.0, 1.0, 1.0]).record(jax.random.key(0), Breaks(30), 25)
    assert recording.valid.all()


def test_bad_input_is_told():
    with pytest.raises(ValueError, match="'pendulm': did you mean 'pendulum'"):
        gymnasium_target("pendulm", [0.5, 0.5])
    with pytest.raises(ValueError, match=r"noise has shape \(3,\); CartPole-v1 has 4 observations"):
        gymnasium_target("cartpole", [0.5, 0.5], noise=jnp.ones(3))
