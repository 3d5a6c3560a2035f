"""What every registered system promises, and what a user's slip is answered with."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct

from bayessim_jax.contracts import Box, Discrete, System, Task
from bayessim_jax.rollout import rollout
from bayessim_jax.systems import SYSTEMS, from_functions, lookup


@struct.dataclass
class Still:
    """A policy that always takes the same action."""

    action: jax.Array

    def init(self):
        return ()

    def act(self, key, memory, observation):
        return self.action, memory


def still(system):
    return Still(jnp.zeros(system.actions.size))


@pytest.mark.parametrize("name", SYSTEMS)
def test_registered_systems_keep_the_contract(name):
    entry = lookup(name)
    system, task = entry.system(), entry.task()
    assert isinstance(system, System)
    assert isinstance(task, Task)
    theta = (system.parameters.low + system.parameters.high) / 2
    state = jax.eval_shape(system.reset, jax.random.key(0), theta)
    after = jax.eval_shape(system.step, theta, state, jnp.zeros(system.actions.size))
    assert after == state
    assert system.observe(theta, system.reset(jax.random.key(0), theta)).shape == (system.observations.size,)
    assert system.noise.shape == (system.observations.size,)


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow if name == "fetch_slide" else ()) for name in SYSTEMS]
)
def test_rollouts_stay_finite_over_the_whole_prior(name):
    system, task = SYSTEMS[name].system(), SYSTEMS[name].task()
    box = system.parameters
    theta = box.low + box.width * jax.random.uniform(jax.random.key(0), (200, box.size))
    keys = jax.random.split(jax.random.key(1), 200)
    recordings = jax.jit(jax.vmap(lambda k, t: rollout(k, system, t, still(system), 100, task)))(keys, theta)
    assert not recordings.diverged.any()
    assert jnp.isfinite(recordings.observations).all()


def test_rollout_is_the_same_for_the_same_key_and_other_for_another():
    system = SYSTEMS["pendulum"].system()
    theta = jnp.array([0.5, 0.5])
    run = jax.jit(lambda key: rollout(key, system, theta, still(system), 20).observations)
    np.testing.assert_array_equal(run(jax.random.key(3)), run(jax.random.key(3)))
    assert not np.array_equal(run(jax.random.key(3)), run(jax.random.key(4)))


def test_sensor_noise_has_the_stated_deviation():
    system = SYSTEMS["cartpole"].system(noise=0.03)
    state = system.reset(jax.random.key(0), system.parameters.low)
    fixed = from_functions(
        parameters=system.parameters,
        observations=system.observations,
        actions=system.actions,
        noise=system.noise,
        dt=system.dt,
        reset=lambda key, theta: state,
        step=lambda theta, state, action: state,
        observe=system.observe,
    )
    seen = rollout(jax.random.key(1), fixed, system.parameters.low, still(system), 4000).observations
    np.testing.assert_allclose(seen.std(0), 0.03, rtol=0.06)
    np.testing.assert_allclose(seen.mean(0), system.observe(system.parameters.low, state), atol=0.002)


def test_rollout_pads_after_the_end():
    """An unattended pole falls; nothing after the fall is kept."""
    system, task = SYSTEMS["cartpole"].system(noise=0.0), SYSTEMS["cartpole"].task()
    recording = rollout(jax.random.key(0), system, jnp.array([0.5, 0.1]), still(system), 100, task)
    steps = int(recording.valid.sum())
    assert 5 < steps < 100
    assert recording.valid[:steps].all()
    assert not recording.diverged
    assert recording.rewards.sum() == steps
    assert jnp.abs(recording.observations[steps, 2]) > 12 * 2 * jnp.pi / 360
    for padded in (recording.observations[steps + 1 :], recording.actions[steps:], recording.rewards[steps:]):
        assert (padded == 0).all()


def breaks_at(step):
    """A counter that turns into NaN after `step` steps, whatever the parameters' centre says."""
    return from_functions(
        parameters=Box.create(a=(0.0, 1.0, "")),
        observations=Box.create(count=(0.0, 100.0, "")),
        actions=Discrete(2),
        noise=0.0,
        dt=0.1,
        reset=lambda key, theta: jnp.zeros(1),
        step=lambda theta, state, action: jnp.where(state + 1 >= step, jnp.nan, state + 1),
    )


def test_a_diverged_rollout_is_masked_from_the_first_nan_on():
    recording = rollout(jax.random.key(0), breaks_at(7), jnp.array([0.5]), still(breaks_at(7)), 20)
    assert recording.diverged
    np.testing.assert_array_equal(recording.valid, np.arange(20) < 6)
    np.testing.assert_array_equal(recording.observations[:, 0], np.where(np.arange(21) < 7, np.arange(21), 0))
    for leaf in jax.tree.leaves(recording):
        assert jnp.isfinite(leaf).all()
    assert (recording.rewards == 0).all()


GOOD = {
    "parameters": Box.create(gain=(0.0, 1.0, "")),
    "observations": Box.create(x=(-1.0, 1.0, "m")),
    "actions": Box.create(force=(-1.0, 1.0, "N")),
    "noise": 0.1,
    "dt": 0.1,
    "reset": lambda key, theta: jax.random.normal(key, (1,)),
    "step": lambda theta, state, action: 0.9 * state + theta[0] * action,
}


def test_from_functions_makes_a_system():
    system = from_functions(**GOOD)
    assert isinstance(system, System)
    recording = jax.jit(lambda key: rollout(key, system, jnp.array([0.5]), still(system), 9))(jax.random.key(0))
    assert recording.observations.shape == (10, 1)
    assert recording.valid.all()


@pytest.mark.parametrize(
    ("slip", "message"),
    [
        ({"step": lambda theta, state, action: jnp.zeros(2)}, r"a state of float32\[2\]; reset made float32\[1\]"),
        ({"step": lambda theta, state, action: (state, state)}, r"a state of .*; reset made float32\[1\]"),
        ({"reset": lambda key, theta: jnp.zeros(1, int)}, r"a state of float32\[1\]; reset made int32\[1\]"),
        ({"noise": -0.1}, "noise is -0.1; it is a standard deviation"),
        ({"noise": [0.1, 0.1]}, "noise is .*for all 1 observations or for each"),
        ({"dt": 0.0}, "dt is 0.0; it is the control period"),
        ({"observe": lambda theta, state: jnp.zeros(3)}, r"observe returned shape \(3,\).*\('x',\)"),
        ({"step": lambda theta, state, action: state / 0.0 * 0.0}, "non-finite observations.*θ = .0.5."),
    ],
)
def test_from_functions_names_the_slip(slip, message):
    with pytest.raises(ValueError, match=message):
        from_functions(**{**GOOD, **slip})


def test_box_refuses_an_empty_axis():
    with pytest.raises(ValueError, match=r"'length': low 1.0 must be below high 0.1; swap or widen"):
        Box.create(mass=(0.0, 1.0, "kg"), length=(1.0, 0.1, "m"))


def test_box_contains_its_boundary_and_nothing_outside():
    box = Box.create(a=(0.0, 1.0, ""), b=(-2.0, 2.0, ""))
    assert box.size == 2
    np.testing.assert_array_equal(box.width, [1.0, 4.0])
    assert box.contains(jnp.array([0.0, 2.0]))
    assert not box.contains(jnp.array([0.5, 2.1]))


def test_lookup_offers_the_near_miss():
    with pytest.raises(ValueError, match="unknown system 'cartpol': did you mean 'cartpole'"):
        lookup("cartpol")
    with pytest.raises(ValueError, match="choose one of cartpole, pendulum, acrobot"):
        lookup("xyzzy")
