"""θ written by the engines does what the same value written into the file does."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from bayessim_jax.engines.fields import find_writes, merge_writes, write_into
from bayessim_jax.engines.mjx import MjxEngine
from bayessim_jax.engines.mujoco import MujocoEngine
from bayessim_jax.engines.tree import TreeEngine
from tests.engines.mechanisms import HOPPER, MODELS


def scale_mass(spec, value):
    body = spec.body("l2")
    body.fullinertia = body.fullinertia * value / body.mass
    body.mass = value


def scale_inertia(spec, value):
    body = spec.body("l1")
    body.inertia = body.inertia * value / body.mass
    body.mass = value


def put(kind, name, field, component=None):
    def edit(spec, value):
        element = getattr(spec, kind)(name)
        if component is None:
            setattr(element, field, value)
        else:
            array = np.array(getattr(element, field))
            array[component] = value
            setattr(element, field, array)

    return edit


def set_gravity(spec, value):
    spec.option.gravity = [0.0, 0.0, value]


def set_kp(spec, value):
    put("actuator", "servo", "gainprm", 0)(spec, value)
    put("actuator", "servo", "biasprm", 1)(spec, -value)


def set_range(spec, value):
    spec.actuator("push").ctrlrange = [-value, value]


SMOOTH = {
    "body/l2/mass": ("spatial_arm", 2.3, scale_mass),
    "body/l2/ipos/0": ("spatial_arm", 0.2, put("body", "l2", "ipos", 0)),
    "body/l2/pos/2": ("six_joint_arm", 0.4, put("body", "l2", "pos", 2)),
    "body/l0/inertia/1": ("pendulum", 0.013, put("body", "l0", "inertia", 1)),
    "joint/l0/damping": ("six_joint_arm", 0.9, put("joint", "l0", "damping", 0)),
    "joint/l1/armature": ("spatial_arm", 0.4, put("joint", "l1", "armature")),
    "joint/l0/stiffness": ("springs", 12.0, put("joint", "l0", "stiffness", 0)),
    "joint/l0/springref": ("springs", -0.3, put("joint", "l0", "springref")),
    "actuator/m1/gear": ("spatial_arm", 0.7, put("actuator", "m1", "gear", 0)),
    "actuator/m1/gain": ("spatial_arm", 1.8, put("actuator", "m1", "gainprm", 0)),
    "actuator/servo/gain": ("springs", 9.0, set_kp),
    "actuator/push/ctrlrange": ("cart_pole", 0.4, set_range),
    "joint/l0/frictionloss": ("pendulum", 0.3, put("joint", "l0", "frictionloss")),
    "body/l1/mass": ("limits", 1.7, scale_inertia),
    "option/gravity/2": ("spatial_arm", -3.7, set_gravity),
}
CONTACT = {
    "joint/ankle/frictionloss": (3.0, put("joint", "ankle", "frictionloss")),
    "geom/foot/friction/0": (2.5, put("geom", "foot", "friction", 0)),
    "geom/foot/size/1": (0.3, put("geom", "foot", "size", 1)),
    "joint/hip/damping": (4.0, put("joint", "hip", "damping", 0)),
}


def fresh(xml, edit, value):
    spec = mujoco.MjSpec.from_string(xml)
    edit(spec, value)
    return spec.compile()


def reference(model, qpos, ctrl, steps):
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    for k in range(steps):
        data.ctrl[:] = ctrl * np.cos(0.05 * k)
        mujoco.mj_step(model, data)
    return np.concatenate([data.qpos, data.qvel])


def by_engine(engine, theta, qpos, ctrl, steps):
    theta = jnp.asarray([theta])
    ctrls = jnp.asarray(ctrl * np.cos(0.05 * np.arange(steps))[:, None])
    start = engine.init(theta, jnp.asarray(qpos), jnp.zeros(engine.model.nv))
    last = jax.tree.map(lambda x: x[-1], jax.jit(engine.replay)(theta, start, ctrls))
    return np.concatenate([engine.qpos(last), engine.qvel(last)])


@pytest.mark.parametrize("path", SMOOTH)
@pytest.mark.parametrize("make", [TreeEngine, MujocoEngine])
def test_a_parameter_does_what_the_file_would(path, make):
    name, value, edit = SMOOTH[path]
    with jax.enable_x64(True):
        model = mujoco.MjModel.from_xml_string(MODELS[name])
        engine = make(model, merge_writes([find_writes(model, [path], 0)]))
        qpos, ctrl = model.qpos0 + 0.4, np.full(model.nu, 1.3)
        expected = reference(fresh(MODELS[name], edit, value), qpos, ctrl, 60)
        np.testing.assert_allclose(by_engine(engine, value, qpos, ctrl, 60), expected, rtol=1e-9, atol=1e-9)
        assert np.abs(expected - reference(model, qpos, ctrl, 60)).max() > 1e-4, "it has an effect"


@pytest.mark.parametrize("path", CONTACT)
def test_a_parameter_of_contacts_does_what_the_file_would(path):
    value, edit = CONTACT[path]
    spec = mujoco.MjSpec.from_string(HOPPER)
    model = spec.compile()
    with jax.enable_x64(True):
        engine = MujocoEngine(model, merge_writes([find_writes(model, [path], 0)]), spec)
        qpos, ctrl = model.qpos0, np.array([0.5, -0.5])
        expected = reference(fresh(HOPPER, edit, value), qpos, ctrl, 300)
        np.testing.assert_allclose(by_engine(engine, value, qpos, ctrl, 300), expected, rtol=1e-12, atol=1e-12)
        assert np.abs(expected - reference(model, qpos, ctrl, 300)).max() > 1e-3, "it has an effect"


def test_derived_quantities_follow_masses():
    """The model of each θ is the freshly compiled one in every number that matters."""
    spec = mujoco.MjSpec.from_string(HOPPER)
    model = spec.compile()
    engine = MujocoEngine(model, merge_writes([find_writes(model, ["body/leg/mass"], 0)]), spec)
    ours = engine.bank.build(np.array([7.0]))
    spec.body("leg").explicitinertial = True
    spec.body("leg").mass, spec.body("leg").inertia = 7.0, model.body("leg").inertia * 7.0 / model.body("leg").mass
    spec.body("leg").ipos, spec.body("leg").iquat = model.body("leg").ipos, model.body("leg").iquat
    theirs = spec.compile()
    for field in ("body_mass", "body_inertia", "body_subtreemass", "body_invweight0", "dof_invweight0", "dof_M0"):
        np.testing.assert_allclose(getattr(ours, field), getattr(theirs, field), rtol=1e-9, err_msg=field)
    assert not np.allclose(ours.dof_invweight0, model.dof_invweight0)


def test_models_are_kept_while_there_is_room_and_dropped_when_there_is_none():
    model = mujoco.MjModel.from_xml_string(HOPPER)
    bank = MujocoEngine(model, merge_writes([find_writes(model, ["body/leg/mass"], 0)])).bank
    batches = [1.0 + np.arange(3.0)[:, None] + 3 * i for i in range(6)]
    first = bank.batch(batches[0])
    for batch in batches[1:3]:
        bank.batch(batch)
    assert bank.batch(batches[0]) is first
    bank.room = 7
    for batch in batches[1:]:
        models = bank.batch(batch)
        np.testing.assert_allclose([m.body("leg").mass[0] for m in models], batch[:, 0])
    assert len(bank.rows) == 7
    assert sum(map(len, bank.batches.values())) <= 7
    large = np.linspace(1.0, 9.0, 12)[:, None]
    assert len(bank.batch(large)) == len(bank.rows) == 12
    assert list(bank.batches) == [large.tobytes()]


def test_mjx_derives_what_mujoco_derives():
    pytest.importorskip("mujoco.mjx")
    model = mujoco.MjModel.from_xml_string(HOPPER)
    writes = merge_writes([find_writes(model, ["body/leg/mass"], 0), find_writes(model, ["geom/foot/friction/0"], 1)])
    ours = jax.jit(MjxEngine(model, writes)._write)(jnp.array([7.0, 0.3]))
    theirs = MujocoEngine(model, writes).bank.build(np.array([7.0, 0.3]))
    for field in (
        "body_mass",
        "body_inertia",
        "body_subtreemass",
        "body_invweight0",
        "dof_invweight0",
        "geom_friction",
    ):
        np.testing.assert_allclose(getattr(ours, field), getattr(theirs, field), rtol=2e-4, err_msg=field)


@pytest.mark.parametrize(
    "name",
    ["double_pendulum", pytest.param("spatial_arm", marks=pytest.mark.slow), "springs", "limits", "dry_friction"],
)
def test_the_tree_engine_is_differentiable(name):
    """Forward derivatives of the last state with respect to every θ are the quotients of differences."""
    with jax.enable_x64(True):
        model = mujoco.MjModel.from_xml_string(MODELS[name])
        joint = model.joint(1).name
        body = model.body(2).name
        paths = [f"body/{body}/mass", f"body/{body}/ipos/2", f"joint/{joint}/damping", "option/gravity/2"]
        engine = TreeEngine(model, merge_writes([find_writes(model, [p], k) for k, p in enumerate(paths)]))
        theta = jnp.array([1.2, -0.15, 0.3, -9.0])
        ctrls = jnp.asarray(0.5 * np.cos(0.05 * np.arange(50)))[:, None] * jnp.ones(model.nu)

        @jax.jit
        def last(theta):
            start = engine.init(theta, jnp.asarray(model.qpos0) + 0.3, jnp.zeros(model.nv))
            return engine.qpos(jax.tree.map(lambda x: x[-1], engine.replay(theta, start, ctrls)))

        forward, backward = jax.jacfwd(last)(theta), jax.jacrev(last)(theta)
        for k in range(4):
            step = jnp.zeros(4).at[k].set(1e-6)
            quotient = (last(theta + step) - last(theta - step)) / 2e-6
            np.testing.assert_allclose(forward[:, k], quotient, rtol=1e-5, atol=1e-8)
        np.testing.assert_allclose(forward, backward, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize(
    ("path", "message"),
    [
        ("bodies/l0/mass", "the kind is one of body, joint, geom, actuator and option, not 'bodies'"),
        ("body/l9/mass", "the model has no body 'l9'"),
        ("body/l0/ipos", "ipos has components; write body/l0/ipos/0 to body/l0/ipos/2"),
        ("body/l0/ipos/3", "components 0 to 2, not 3"),
        ("body/l0/mass/0", "mass is one number; write body/l0/mass"),
        ("body/l0/colour", "a body has no field 'colour'"),
        ("joint/l0/colour", "this joint has no field 'colour'"),
        ("option/wind/0", "of the options only gravity/0"),
        ("actuator/m0/ctrlrange", "must be limited"),
    ],
)
def test_a_wrong_target_is_named(path, message):
    model = mujoco.MjModel.from_xml_string(MODELS["pendulum"])
    with pytest.raises(ValueError, match=message):
        find_writes(model, [path], 0)


def test_a_named_number_goes_before_one_that_follows():
    model = mujoco.MjModel.from_xml_string(MODELS["pendulum"])
    mass, inertia = find_writes(model, ["body/l0/mass"], 0), find_writes(model, ["body/l0/inertia/0"], 1)
    for order in ([mass, inertia], [inertia, mass]):
        write_into(model, merge_writes(order), np.array([2.0, 0.5]))
        assert model.body_inertia[1, 0] == 0.5 and model.body_mass[1] == 2.0
    with pytest.raises(ValueError, match="parameters 0 and 1 both write body_mass"):
        merge_writes([mass, find_writes(model, ["body/l0/mass"], 1)])
