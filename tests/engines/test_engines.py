"""Every engine against a loop of `mj_step`, on the same models and the same random walk of controls."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from bayessim_jax.engines.batch import LOOPS
from bayessim_jax.engines.contract import Engine
from bayessim_jax.engines.fields import Write
from bayessim_jax.engines.mjx import MjxEngine
from bayessim_jax.engines.mujoco import MujocoEngine
from bayessim_jax.engines.tree import TreeEngine
from bayessim_jax.engines.tree.folding import fold, unknown_one
from bayessim_jax.mechanics import free_inertia
from tests.engines.mechanisms import HOPPER, MODELS

STEPS = 100
ENGINES = {"tree": TreeEngine, "mujoco": MujocoEngine, "mjx": MjxEngine}


def compile_exact(name):
    """A model whose constraints MuJoCo solves to the last digit, where it has any."""
    model = mujoco.MjModel.from_xml_string(MODELS[name])
    model.opt.tolerance, model.opt.iterations = 0.0, 100
    return model


def random_walk(model, seed=0, batch=3):
    rng = np.random.default_rng(seed)
    ctrl = np.cumsum(rng.normal(scale=0.3, size=(batch, STEPS, model.nu)), axis=1)
    applied = 0.1 * rng.normal(size=(batch, STEPS, model.nv))
    qpos = model.qpos0 + rng.uniform(-1, 1, (batch, model.nq))
    return ctrl, applied, qpos, rng.uniform(-1, 1, (batch, model.nv))


def bare(model, ctrl, applied, qpos, qvel):
    """Positions and velocities after each `mj_step`."""
    data, rows = mujoco.MjData(model), []
    data.qpos[:], data.qvel[:] = qpos, qvel
    for u, f in zip(ctrl, applied, strict=True):
        data.ctrl[:], data.qfrc_applied[:] = u, f
        mujoco.mj_step(model, data)
        rows.append(np.concatenate([data.qpos, data.qvel]))
    return np.array(rows)


def simulate(engine, ctrl, applied, qpos, qvel, dtype):
    """The same by an engine, a scan of steps under vmap and jit."""

    def one(ctrl, applied, qpos, qvel):
        theta = jnp.zeros(0, dtype)

        def body(state, row):
            after = engine.step(theta, state, *row)
            return after, jnp.concatenate([engine.qpos(after), engine.qvel(after)])

        return jax.lax.scan(body, engine.init(theta, qpos, qvel), (ctrl, applied))[1]

    return np.asarray(jax.jit(jax.vmap(one))(*(jnp.asarray(x, dtype) for x in (ctrl, applied, qpos, qvel))))


@pytest.mark.parametrize("name", MODELS)
@pytest.mark.parametrize(("dtype", "tolerance"), [("float64", 1e-9), ("float32", 1e-4)])
def test_the_tree_engine_agrees_with_mujoco(name, dtype, tolerance):
    with jax.enable_x64(dtype == "float64"):
        model = compile_exact(name)
        inputs = [np.asarray(x, dtype) for x in random_walk(model)]
        ours = simulate(TreeEngine(model), *inputs, dtype)
        assert ours.dtype == dtype
        theirs = np.stack([bare(model, *(x[i].astype(float) for x in inputs)) for i in range(3)])
        np.testing.assert_allclose(ours, theirs, rtol=tolerance, atol=tolerance)


@pytest.mark.parametrize("name", ["cart_pole", "spatial_arm", "springs"])
def test_the_c_engine_is_mujoco_bit_for_bit(name):
    """Also in float32 programs: the state is carried as bits."""
    for dtype in ("float32", "float64"):
        with jax.enable_x64(dtype == "float64"):
            model = mujoco.MjModel.from_xml_string(MODELS[name])
            inputs = [np.asarray(x, dtype) for x in random_walk(model)]
            ours = simulate(MujocoEngine(model, threads=2), *inputs, dtype)
            theirs = np.stack([bare(model, *(x[i].astype(float) for x in inputs)) for i in range(3)])
            np.testing.assert_array_equal(ours, theirs.astype(dtype))


def test_a_replay_is_mujoco_bit_for_bit_with_contacts():
    """In one call the constraint solver goes on from where it was, as it does in a loop of `mj_step`."""
    model = mujoco.MjModel.from_xml_string(HOPPER)
    ctrl, _, _, _ = random_walk(model)
    ctrl = ctrl.astype(np.float32)
    engine, theta = MujocoEngine(model, threads=2), jnp.zeros(0)
    state = engine.init(theta, jnp.asarray(model.qpos0), jnp.zeros(model.nv))
    states = jax.jit(jax.vmap(lambda u: engine.replay(theta, state, u, steps=2)))(ctrl)
    for i in range(3):
        theirs = bare(model, np.repeat(ctrl[i], 2, 0).astype(float), np.zeros((2 * STEPS, model.nv)), model.qpos0, 0.0)
        physics = np.asarray(states.physics[i]).view(np.float64)
        np.testing.assert_array_equal(physics[:, 1 : 1 + model.nq + model.nv], theirs[1::2])
    assert theirs[-1, 1] < -0.2, "it fell to the ground"


@pytest.mark.parametrize("name", ["tree", "mujoco"])
def test_scan_of_steps_equals_replay_and_batch_equals_alone(name):
    model = mujoco.MjModel.from_xml_string(MODELS["spatial_arm"])
    engine, theta = ENGINES[name](model), jnp.zeros(0)
    ctrl, applied, qpos, qvel = (jnp.asarray(x, jnp.float32) for x in random_walk(model))
    start = jax.vmap(lambda q, v: engine.init(theta, q, v))(qpos, qvel)
    together = jax.jit(jax.vmap(lambda s, u, f: engine.replay(theta, s, u, f, steps=3)))(start, ctrl, applied)
    first = jax.tree.map(lambda leaf: leaf[0], start)

    def body(state, row):
        after = engine.step(theta, state, *row, steps=3)
        return after, after

    alone = jax.jit(lambda s, u, f: jax.lax.scan(body, s, (u, f))[1])(first, ctrl[0], applied[0])
    tolerance = 0.0 if name == "mujoco" else 2e-5
    np.testing.assert_allclose(
        jax.vmap(engine.qpos)(alone), jax.vmap(engine.qpos)(jax.tree.map(lambda x: x[0], together)), atol=tolerance
    )


@pytest.mark.parametrize("name", ENGINES)
def test_engines_keep_the_contract(name):
    if name == "mjx":
        pytest.importorskip("mujoco.mjx")
    model = mujoco.MjModel.from_xml_string(MODELS["cart_pole"])
    engine, theta = ENGINES[name](model), jnp.zeros(0)
    assert isinstance(engine, Engine)
    assert engine.name == name
    state = engine.init(theta, jnp.zeros(2), jnp.ones(2))
    after = jax.eval_shape(engine.step, theta, state, jnp.zeros(1), jnp.zeros(2))
    assert jax.tree.map(lambda x: (x.shape, x.dtype), after) == jax.tree.map(lambda x: (x.shape, x.dtype), state)
    np.testing.assert_array_equal(engine.qvel(state), jnp.ones(2))
    rows = engine.replay(theta, state, jnp.zeros((5, 1)), steps=2)
    assert jax.vmap(engine.qpos)(rows).shape == (5, 2)


def test_mjx_agrees_with_the_tree_engine():
    pytest.importorskip("mujoco.mjx")
    model = mujoco.MjModel.from_xml_string(MODELS["cart_pole"])
    inputs = [x[:1].astype(np.float32) for x in random_walk(model)]
    np.testing.assert_allclose(
        simulate(MjxEngine(model), *inputs, "float32"), simulate(TreeEngine(model), *inputs, "float32"), atol=1e-4
    )


@pytest.mark.parametrize("name", ["double_pendulum", "runge_kutta"])
def test_energy_is_conserved_without_damping(name):
    """Of first order by Euler's steps, and of fourth by Runge and Kutta's."""
    with jax.enable_x64(True):
        model = mujoco.MjModel.from_xml_string(MODELS[name])
        model.opt.enableflags |= int(mujoco.mjtEnableBit.mjENBL_ENERGY)
        zeros = np.zeros((1, STEPS, model.nu)), np.zeros((1, STEPS, model.nv))
        path = simulate(TreeEngine(model), *zeros, np.array([[0.5, 0.3]]), np.zeros((1, 2)), "float64")[0]
        data, energies = mujoco.MjData(model), []
        for row in path:
            data.qpos[:], data.qvel[:] = row[:2], row[2:]
            mujoco.mj_forward(model, data)
            energies.append(data.energy.sum())
    assert np.ptp(energies) < (1e-8 if name == "runge_kutta" else 2e-2)


def test_a_diverging_simulation_shows():
    """It is neither reset to the start nor told on the screen."""
    model = mujoco.MjModel.from_xml_string(HOPPER)
    engine, theta = MujocoEngine(model), jnp.zeros(0)
    state = engine.init(theta, jnp.zeros(model.nq), jnp.full(model.nv, 1e30))
    states = engine.replay(theta, state, jnp.zeros((3, model.nu)))
    assert not jnp.isfinite(states.qpos).all()


def test_sensors_of_the_c_engine():
    model = mujoco.MjModel.from_xml_string(HOPPER)
    engine, theta = MujocoEngine(model), jnp.zeros(0)
    qpos = jnp.asarray(model.qpos0).at[3].set(-0.25)
    seen = jax.jit(jax.vmap(lambda u: engine.sensors(theta, engine.init(theta, qpos, jnp.zeros(model.nv)), u)))(
        jnp.array([[0.0, 0.0], [0.1, 0.0]])
    )
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_forward(model, data)
    np.testing.assert_array_equal(seen[0], data.sensordata.astype(np.float32))
    assert seen[1, 0] != seen[0, 0], "an accelerometer feels the control"


@pytest.mark.parametrize("name", ["cart_pole", "spatial_arm", "springs"])
def test_engines_know_what_a_joint_shows_of_inertia(name):
    """As MuJoCo's own mass matrix has it; a step that is damped shows as much more as damping does within it."""
    with jax.enable_x64():
        model = mujoco.MjModel.from_xml_string(MODELS[name])
        pose = model.qpos0 + np.linspace(-0.8, 0.6, model.nq)
        theirs = free_inertia(model, mujoco.MjData(model), pose)
        tree, stepped = TreeEngine(model), MujocoEngine(model, threads=2)
        theta = jnp.zeros(0)
        for dof in range(model.nv):
            here = [tree.inertia(theta, pose, dof), jax.jit(tree.inertia, static_argnums=2)(theta, pose, dof)]
            np.testing.assert_allclose(here, theirs[dof], rtol=1e-9)
            assert stepped.inertia(theta, pose, dof) == pytest.approx(theirs[dof], rel=0.1)


def test_what_a_joint_shows_of_inertia_follows_theta():
    with jax.enable_x64():
        model = mujoco.MjModel.from_xml_string(MODELS["cart_pole"])
        heavier = mujoco.MjModel.from_xml_string(MODELS["cart_pole"])
        heavier.body_mass[2] = 2.5
        engine = TreeEngine(model, (Write("body_mass", (2,), 1.0, 0),))
        shown = jax.jit(lambda theta: engine.inertia(theta, model.qpos0, 0))(jnp.array([2.5]))
        assert shown == pytest.approx(free_inertia(heavier, mujoco.MjData(heavier), model.qpos0)[0], rel=1e-9)


def test_the_compiler_does_not_repeat_what_the_links_of_an_arm_hand_on():
    """An operation that many others use would otherwise be in each of them: four times the code."""
    model = mujoco.MjModel.from_xml_string(MODELS["six_joint_arm"])
    engine = TreeEngine(model)

    def one(qpos, qvel, ctrl):
        return engine.replay(jnp.zeros(0), engine.init(jnp.zeros(0), qpos, qvel), ctrl).qpos

    ctrl, _, qpos, qvel = (jnp.asarray(x, jnp.float32) for x in random_walk(model))
    lowered = jax.jit(jax.vmap(one), compiler_options=LOOPS).lower(qpos, qvel, ctrl)
    written, made = lowered.as_text().count(" = "), lowered.compile().as_text().count(" = ")
    assert made < 3 * written


@pytest.mark.parametrize("value", [0.3, jnp.array(0.3), jnp.array(-1e30)])
def test_a_one_that_the_compiler_does_not_know_is_one(value):
    """Also of a number that is known while tracing."""
    assert unknown_one(fold(value)).value == 1.0
