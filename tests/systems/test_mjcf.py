"""A MuJoCo model as a system."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from flax import struct

from bayessim_jax.contracts import System
from bayessim_jax.rollout import rollout
from bayessim_jax.systems.mjcf import Unknown, mjcf_system, system_key
from tests.engines.mechanisms import HOPPER, MODELS

MASS = Unknown("pole_mass", ("body/pole/mass",), 0.2, 2.0, "kg")
FRICTION = Unknown("friction", ("geom/foot/friction/0", "geom/floor/friction/0"), 0.1, 1.0)


@struct.dataclass
class Push:
    """A policy that always takes the same action."""

    action: jax.Array

    def init(self):
        return ()

    def act(self, key, memory, observation):
        return self.action, memory


@pytest.mark.parametrize(
    ("xml", "unknown", "engine"),
    [(MODELS["cart_pole"], MASS, "tree"), (MODELS["cart_pole"], MASS, "mujoco"), (HOPPER, FRICTION, "mujoco")],
)
def test_a_model_is_a_system(xml, unknown, engine):
    system = mjcf_system(xml, [unknown], substeps=4, noise=0.01, scatter=0.05, engine=engine)
    assert isinstance(system, System)
    assert system.dt == pytest.approx(0.008)
    theta = (system.parameters.low + system.parameters.high) / 2
    state = jax.eval_shape(system.reset, jax.random.key(0), theta)
    assert jax.eval_shape(system.step, theta, state, jnp.zeros(system.actions.size)) == state
    thetas = jnp.linspace(0.3, 0.9, 3)[:, None]
    run = jax.jit(
        jax.vmap(lambda k, t: rollout(k, system, t, Push(jnp.full(system.actions.size, 0.5)), 20), in_axes=(0, 0))
    )
    recording = run(jax.random.split(jax.random.key(0), 3), thetas)
    assert recording.observations.shape == (3, 21, system.observations.size)
    assert recording.valid.all() and not recording.diverged.any()


def test_control_and_observation_spaces_come_from_the_model():
    system = mjcf_system(MODELS["cart_pole"], [MASS])
    assert system.actions.names == ("push",)
    np.testing.assert_array_equal(system.actions.high, [2.0])
    assert system.observations.names == ("joint/cart/qpos", "joint/pole/qpos", "joint/cart/qvel", "joint/pole/qvel")
    assert system.observations.units == ("m", "rad", "m/s", "rad/s")
    assert (system.engine.name, system.reason) == ("tree", "tree, which takes every element of this model")


def test_channels_are_chosen_by_name():
    system = mjcf_system(HOPPER, [], observe=["joint/hip/qpos", "sensor/hip", "sensor/imu", "sensor/imu/2"])
    assert (
        system.observations.names
        == (
            "joint/hip/qpos",
            "sensor/hip",
            "sensor/imu/0",
            "sensor/imu/1",
            "sensor/imu/2",
            "sensor/imu/2",
        )
        or len(system.observations.names) == 5
    )
    theta = jnp.zeros(0)
    state = system.begin(theta, system.qpos.at[3].set(-0.3), system.qvel)
    seen = system.observe(theta, state)
    assert seen[0] == seen[1] == jnp.float32(-0.3)


def test_initial_states_are_given_or_scattered():
    system = mjcf_system(MODELS["cart_pole"], [MASS], qpos=[0.1, 0.2], scatter=[0.0, 0.3])
    theta = jnp.array([1.0])
    states = jax.vmap(lambda key: system.reset(key, theta))(jax.random.split(jax.random.key(0), 200))
    qpos = jax.vmap(system.positions)(states)
    np.testing.assert_array_equal(qpos[:, 0], jnp.full(200, 0.1, jnp.float32))
    assert 0.25 < jnp.abs(qpos[:, 1] - 0.2).max() <= 0.3
    free = mjcf_system(
        '<mujoco><worldbody><body><freejoint name="f"/><geom size="0.1"/></body></worldbody></mujoco>', [], scatter=0.4
    )
    state = free.reset(jax.random.key(1), jnp.zeros(0))
    assert jnp.linalg.norm(free.positions(state)[3:7]) == pytest.approx(1.0)


def test_a_generalized_force_can_be_applied():
    """What the effects need: a force that balances gravity holds the pendulum still, by either engine."""
    for engine in ("tree", "mujoco"):
        system = mjcf_system(MODELS["pendulum"], [], engine=engine)
        model, data = system.engine.model, mujoco.MjData(system.engine.model)
        data.qpos[:] = 0.7
        mujoco.mj_forward(model, data)
        theta = jnp.zeros(0)
        state = system.begin(theta, jnp.array([0.7]), jnp.zeros(1))
        for _ in range(10):
            state = system.advance(theta, state, jnp.zeros(1), jnp.asarray(data.qfrc_bias, jnp.float32))
        assert abs(float(system.velocities(state)[0])) < 1e-5
        assert jnp.abs(system.velocities(system.advance(theta, state, jnp.zeros(1)))[0]) > 1e-2


def test_replay_is_a_scan_of_steps():
    system = mjcf_system(MODELS["cart_pole"], [MASS], substeps=3)
    theta, actions = jnp.array([0.8]), jnp.linspace(-1, 1, 15)[:, None]
    start = system.reset(jax.random.key(0), theta)
    rows = jax.vmap(lambda s: system.observe(theta, s))(system.replay(theta, start, actions))
    state = start
    for action in actions:
        state = system.step(theta, state, action)
    np.testing.assert_allclose(rows[-1], system.observe(theta, state), atol=1e-5)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"observe": ["joint/wheel/qpos"]}, "no joint 'wheel'"),
        ({"observe": ["sensor/imu"]}, "no sensor 'imu'"),
        ({"observe": ["cart"]}, "write joint/<name>/qpos"),
        ({"qpos": [0.0, 0.0, 0.0]}, r"qpos has shape \(3,\); this model needs one number or 2"),
        ({"engine": "warp"}, "choose one of auto, tree, mujoco, mjx"),
    ],
)
def test_a_slip_is_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        mjcf_system(MODELS["cart_pole"], [MASS], **arguments)


def test_systems_are_the_same_that_are_made_of_the_same():
    def made(**changes):
        model = mujoco.MjSpec.from_string(MODELS["cart_pole"])
        model.option.timestep = changes.pop("timestep", 0.002)
        unknown = Unknown("mass", MASS.targets, *changes.pop("bounds", (0.5, 2.0)), "kg")
        return system_key(mjcf_system(model, [unknown], engine="tree", **changes))

    assert made() == made() and hash(made()) == hash(made())
    others = [made(timestep=0.001), made(bounds=(0.5, 1.0)), made(substeps=2), made(scatter=0.1)]
    assert len({made(), *others}) == 5
