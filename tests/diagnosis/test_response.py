"""The linear response around a motion is that of the simulator, and effects do along it what they do in it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayessim_jax.beliefs.margins import Margins, uniform
from bayessim_jax.diagnosis.flexible import FEATURES, FLEXIBLE, FlexibleForce
from bayessim_jax.diagnosis.forcing import Joint, Passed, commands_of, force_of, pass_on, restore_readings
from bayessim_jax.diagnosis.response import (
    Beside,
    Forcing,
    Motion,
    Ways,
    Windowed,
    assess,
    bound_gains,
    cross_validate,
    differ,
    find_gaps,
    find_heavier,
    move_steps,
    respond,
    separate,
    weigh,
)
from bayessim_jax.diagnosis.scene import _see_all
from bayessim_jax.effects import EFFECTS, Moment, Scales
from bayessim_jax.systems.mjcf import Unknown, displace, mjcf_system

DOUBLE = """<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody>
<body><joint name="a" axis="0 1 0" damping="0.02"/><inertial pos="0 0 -0.2" mass="0.5" diaginertia="0.004 0.004 0.001"/>
<body pos="0 0 -0.4"><joint name="b" axis="0 1 0"/><inertial pos="0 0 -0.1" mass="0.3" diaginertia="0.002 0.002 0.001"/>
</body></body></worldbody><actuator><motor joint="a"/></actuator></mujoco>"""
FREE = """<mujoco><worldbody><body><freejoint/><geom size="0.1" mass="1"/></body></worldbody></mujoco>"""
STEPS = 30


@pytest.fixture(autouse=True)
def double_precision():
    jax.config.update("jax_enable_x64", True)
    yield
    jax.config.update("jax_enable_x64", False)


@pytest.fixture
def arm():
    return mjcf_system(DOUBLE, [], substeps=2)


def simulate(system, qpos, qvel, ctrl, forces):
    """Positions and velocities of all rows under held forces."""
    state = system.begin(jnp.zeros(0), qpos, qvel)
    rows = [jnp.concatenate([qpos, qvel])]
    for u, f in zip(ctrl, forces, strict=True):
        state = system.advance(jnp.zeros(0), state, u, f, system.substeps)
        rows.append(jnp.concatenate([system.positions(state), system.velocities(state)]))
    return jnp.stack(rows)


def test_the_response_to_a_force_is_the_simulators_to_first_order(arm):
    ctrl = 0.3 * jnp.sin(jnp.arange(STEPS))[:, None]
    push = jnp.stack([jnp.cos(jnp.arange(STEPS) / 5.0), jnp.sin(jnp.arange(STEPS) / 7.0)], -1)
    start = jnp.array([0.6, -0.4]), jnp.array([1.0, -2.0])
    plain = simulate(arm, *start, ctrl, jnp.zeros((STEPS, 2)))
    motion = Motion(plain[None, :, :2], plain[None, :, 2:], ctrl[None], jnp.zeros((1, 0, 1)), jnp.zeros(1))
    lin = linearize(arm, motion, [])
    np.testing.assert_allclose(lin.gap, 0.0, atol=1e-10)
    errors = []
    for size in (1e-2, 1e-3):
        moved = simulate(arm, *start, ctrl, size * push)
        seen = Windowed(
            moved[None],
            jnp.ones((1, STEPS + 1, 4), bool),
            plain[None],
            jnp.eye(4) * jnp.ones((1, STEPS + 1, 1, 1)),
            jnp.ones(4),
        )
        forcing = Forcing(size * push[None], jnp.zeros((1, STEPS, 2, 1)))
        rest = weigh(respond(lin, seen, 0), seen, jnp.ones(4))
        _, r = assess(lin, rest, seen, forcing, jnp.zeros(1), jnp.zeros(1), jnp.zeros((1, 4)), jnp.ones(4))
        errors.append(float(jnp.abs(r).max() / jnp.abs(moved - plain).max()))
    assert errors[1] < 1e-3
    assert errors[1] < 0.2 * errors[0]


def linearize(arm, motion, theta, length=1e-6, central=False):
    """Steps linearized along forces, the state and θ, with room for one parameter of a candidate."""
    theta, sides = jnp.asarray(theta, float), (1.0, -1.0) if central else (1.0,)
    count, d = 6 + theta.size, theta.size
    ways = jnp.concatenate([s * length * jnp.eye(count) for s in sides]).reshape(len(sides), count, count)
    ways = jnp.concatenate([jnp.zeros((1, count)), jnp.moveaxis(ways, 0, 1).reshape(-1, count)])
    beside = Beside(theta + ways[:, 6:], ways[:, 2:6], ways[:, :2])
    gaps = find_gaps(arm.engine, _same, motion, beside, len(ways), 2)
    nothing = jnp.zeros(1, int), jnp.array([9])
    along = Ways(jnp.full(count, len(sides) * length), *nothing, jnp.arange(2), 2 + jnp.arange(4), 6 + jnp.arange(d))
    return differ(None, gaps, along, True, central)


def test_slopes_of_steps_are_their_derivatives():
    arm = mjcf_system(DOUBLE, [Unknown("damping", ("joint/a/damping",), 0.0, 1.0)], substeps=2)
    motion, (engine, nv) = random_motion(), (arm.engine, 2)
    q, v, u = motion.qpos[0, 5], motion.qvel[0, 5], motion.ctrl[0, 5]

    def step(theta, q, v, force):
        after = engine.step(theta, engine.init(theta, q, v), u, force, 2)
        return jnp.concatenate([engine.qpos(after), engine.qvel(after)])

    point = jnp.array([0.2]), q, v, jnp.zeros(nv)
    along, by_q, by_v, by_force = jax.jacfwd(step, argnums=(0, 1, 2, 3))(*point)
    for central, tolerance in ((False, 1e-4), (True, 1e-7)):
        lin = linearize(arm, motion, [0.2], central=central)
        np.testing.assert_allclose(lin.a[0, 5], jnp.concatenate([by_q, by_v], 1), atol=tolerance)
        np.testing.assert_allclose(lin.b[0, 5], by_force, atol=tolerance)
        np.testing.assert_allclose(lin.along[0, 5, :, :1], along, atol=tolerance)
        there = jnp.concatenate([motion.qpos[0, 6], motion.qvel[0, 6]])
        np.testing.assert_allclose(lin.gap[0, 5], step(*point) - there, atol=1e-12)


def random_motion():
    rng = np.random.default_rng(0)
    qpos, qvel = (jnp.asarray(rng.normal(0, 0.1, (1, STEPS + 1, 2)).cumsum(1)) for _ in range(2))
    return Motion(qpos, qvel, jnp.zeros((1, STEPS, 1)), jnp.zeros((1, 0, 1)), jnp.zeros(1))


def test_where_steps_lead_is_found_without_linearizing_them():
    arm = mjcf_system(DOUBLE, [Unknown("damping", ("joint/a/damping",), 0.0, 1.0)], substeps=2)
    motion, here, there = random_motion(), *(linearize(arm, random_motion(), [x]) for x in (0.1, 0.2))
    points = jnp.array([[0.2], [0.2 + 1e-5], [0.2], [np.nan]])
    forces = jnp.zeros((4, 2)).at[2, 1].set(1e-4)
    gaps = find_gaps(arm.engine, _same, motion, Beside(points, jnp.zeros((4, 4)), forces), 3, 2)
    assert (gaps[3] == 0.0).all()
    ways = Ways(
        jnp.array([1e-5, 1e-4, 1.0]),
        jnp.array([0]),
        jnp.array([1]),
        jnp.array([2, 1]),
        jnp.zeros(0, int),
        jnp.zeros(1, int),
    )
    found = differ(here, gaps, ways, True, False)
    np.testing.assert_allclose(found.gap, there.gap, atol=1e-12)
    np.testing.assert_allclose(found.along[..., 1], there.along[..., 0], rtol=1e-3, atol=1e-6)
    np.testing.assert_allclose(found.b[..., 1], there.b[..., 1], rtol=1e-3, atol=1e-6)
    np.testing.assert_array_equal(found.a, here.a)
    np.testing.assert_array_equal(found.along[..., 0], here.along[..., 0])
    np.testing.assert_array_equal(differ(here, gaps, ways, False, False).b, here.b)


def test_what_forces_do_is_known_where_masses_are_far_from_those_of_before():
    """Also with damping, which the integrator treats implicitly."""
    unknown = [Unknown("mass", ("body/low/mass",), 0.1, 2.0), Unknown("damping", ("joint/a/damping",), 0.0, 1.0)]
    arm = mjcf_system(DOUBLE.replace("<body pos", '<body name="low" pos'), unknown, substeps=2)
    motion, width = random_motion(), np.array([1e-4, 1e-5])
    here, there = (linearize(arm, motion, theta) for theta in ([0.3, 0.1], [1.2, 0.5]))
    every, by = [], np.array([0.02, -0.01])
    for j in range(2):
        points = np.tile(np.array([0.3, 0.1]) + by * (np.arange(2) == j), (3, 1))
        force = np.concatenate([np.zeros((1, 2)), np.diag(width)])
        every.append(find_gaps(arm.engine, _same, motion, Beside(points, np.zeros((3, 4)), force), 3, 2))
    heavier = find_heavier(here, jnp.stack(every), width, by)
    theta, shift = np.array([1.2, 0.5]), np.array([0.9, 0.4])
    gap, b, gives_way = move_steps(arm.engine, _same, motion, theta, here.b, heavier, shift, 2)
    size = np.abs(there.b).max()
    assert np.abs(here.b - there.b).max() > 0.5 * size
    np.testing.assert_allclose(b, there.b, atol=5e-3 * size)
    np.testing.assert_allclose(gap, there.gap, atol=1e-12)
    assert gives_way
    assert not move_steps(arm.engine, _same, motion, theta, here.b, heavier, -10.0 * shift, 2)[2]
    # also from elsewhere
    _, b, _ = move_steps(arm.engine, _same, motion, np.array([0.3, 0.1]), there.b, heavier, -shift, 2)
    np.testing.assert_allclose(b, here.b, atol=5e-3 * np.abs(here.b).max())


@pytest.mark.parametrize("joint", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_no_force_explains_more_than_any_force_on_its_joint(arm, joint):
    """A force that is held for whole pieces is explained, and on the other joint less of it is."""
    ctrl, start = jnp.zeros((STEPS, 1)), (jnp.array([0.6, -0.4]), jnp.array([1.0, -2.0]))
    plain = simulate(arm, *start, ctrl, jnp.zeros((STEPS, 2)))
    shape = jnp.repeat(jnp.array([1.0, -2.0, 0.5, 0.0, 1.5, -1.0]), STEPS // 6)
    push = 1e-4 * shape[:, None] * (jnp.arange(2) == joint)
    motion = Motion(plain[None, :, :2], plain[None, :, 2:], ctrl[None], jnp.zeros((1, 0, 1)), jnp.zeros(1))
    lin = linearize(arm, motion, [])
    seen = Windowed(
        simulate(arm, *start, ctrl, push)[None],
        jnp.ones((1, STEPS + 1, 4), bool),
        plain[None],
        jnp.eye(4) * jnp.ones((1, STEPS + 1, 1, 1)),
        jnp.full(4, 1e-9),
    )
    sigma, nothing = jnp.full(4, 1e-6), Forcing(jnp.zeros((1, STEPS, 2)), jnp.zeros((1, STEPS, 2, 1)))
    rest = weigh(respond(lin, seen, 0), seen, sigma)
    at = jnp.zeros(1), jnp.zeros(1), jnp.zeros((1, 4)), sigma
    before = assess(lin, rest, seen, nothing, *at)[0].cost
    gains = np.asarray(bound_gains(lin, rest, seen, nothing, *at, pieces=6))
    assert gains[joint] == pytest.approx(float(before), rel=1e-2)
    assert gains[1 - joint] < 0.99 * gains[joint]
    one = Forcing(push[None], jnp.zeros((1, STEPS, 2, 1)))
    explained = float(before - assess(lin, rest, seen, one, *at)[0].cost)
    assert explained <= 1.001 * gains[joint]


def _same(x):
    return x


def test_separate_is_the_inverse_of_displace():
    model = mjcf_system(FREE, []).engine.model
    rng = np.random.default_rng(1)
    turn = rng.normal(size=4)
    qpos = jnp.asarray(np.concatenate([rng.normal(size=3), turn / np.linalg.norm(turn)]))
    move = jnp.asarray(1e-3 * rng.normal(size=6))
    np.testing.assert_allclose(separate(model, qpos, displace(model, qpos, move)), move, atol=1e-8)


def along(velocity):
    n = velocity.shape[1]
    still = jnp.zeros_like(velocity)
    return 0.002 * jnp.arange(n)[None], Joint(still, velocity, still, still + 0.1, still + 0.5)


class Lingering(FlexibleForce):
    """The same force, half of it a time step late."""

    def begin(self, values, moment):
        return jnp.zeros(())

    def force(self, values, memory, moment):
        now = super().force(values, (), moment)[0]
        return 0.5 * (now + memory), now

    def slopes(self, values, moment):
        return None


@pytest.mark.parametrize(("effect", "last"), [(FLEXIBLE, FEATURES - 1), (Lingering(), -1)])
def test_slopes_along_many_parameters_are_those_of_differences(effect, last):
    time, joint = along(jnp.linspace(-3.0, 3.0, 40)[None])
    parameters = effect.parameters("joint/a", Scales())
    names, rates = tuple(p.name for p in parameters), 1.0 + np.arange(len(parameters)) / 7.0
    middle = np.array([0.5 * (p.low + p.high) for p in parameters])
    x = middle + 0.1 * np.random.default_rng(0).normal(size=middle.size) * [p.high - p.low for p in parameters]
    at = lambda x: force_of(effect, names, "", 0.002, 2, x, rates, time, joint, None)  # noqa: E731
    force, slopes = at(x)
    assert force.shape == (1, 20) and slopes.shape == (1, 20, len(parameters))
    for k in (0, 7, 20, last % len(parameters)):
        ahead, behind = (at(x + s * rates * (np.arange(x.size) == k))[0] for s in (1e-5, -1e-5))
        np.testing.assert_allclose(slopes[..., k], (ahead - behind) / 2e-5, atol=1e-6)


def test_units_of_a_flexible_force_may_move_too_little_to_have_slopes():
    time, joint = along(jnp.linspace(-3.0, 3.0, 40)[None])
    parameters = FLEXIBLE.parameters("joint/a", Scales())
    low, high = (
        np.array([0.1] * FEATURES + [getattr(p, side) for p in parameters[FEATURES:]]) for side in ("low", "high")
    )
    names, rates = tuple(p.name for p in parameters), np.ones(len(parameters))
    at = lambda x: force_of(FLEXIBLE, names, "", 0.002, 2, x, rates, time, joint, None)  # noqa: E731
    np.testing.assert_allclose(at(low)[0], at(high)[0], rtol=1e-6, atol=1e-6)
    assert (at(low)[1][..., FEATURES:] == 0.0).all()


def test_friction_along_a_motion_opposes_it_and_grows_with_its_level():
    velocity = jnp.linspace(-3.0, 3.0, 40)[None]
    time, joint = along(velocity)
    effect, rate = EFFECTS["coulomb_friction"], np.array([0.4])
    at = lambda level: force_of(effect, ("coulomb",), "", 0.002, 2, np.array([level]), rate, time, joint, None)  # noqa: E731
    force, slopes = at(0.5)
    assert force.shape == (1, 20) and slopes.shape == (1, 20, 1)
    rows = np.asarray(velocity[0]).reshape(20, 2).mean(1)
    moving = np.abs(rows) > 0.5
    np.testing.assert_allclose(np.asarray(force[0])[moving], -0.5 * np.sign(rows[moving]), rtol=1e-6)
    beside = at(0.5 + 0.4e-5)[0]
    np.testing.assert_allclose((beside - force)[0] / 1e-5, slopes[0, :, 0], rtol=1e-3, atol=1e-6)


@pytest.mark.parametrize("long_ago", [0.0, 2.0])
def test_a_lag_along_the_commands_is_the_difference_of_two_equations(long_ago):
    commands, older = jnp.ones((1, 60, 1)).at[:, :20].set(0.0), jnp.full((1, 7, 1), long_ago)
    time, joint = along(jnp.zeros((1, 40)))
    effect, numbers = EFFECTS["actuator_lag"], (np.array([0.04]), np.ones(1))
    seen = (time, joint, commands, older, jnp.array([3.0]))
    changes, _ = commands_of(effect, ("time_constant",), 0.002, 2, 20, 0.01, *numbers, *seen)
    assert changes.shape == (1, 20, 1)
    after = 0.002 * (np.arange(40).reshape(20, 2).mean(1) + 0.5)
    held = long_ago * np.exp(-1.0) - 1.0
    np.testing.assert_allclose(changes[0, :, 0], 3.0 * held * np.exp(-after / 0.04), atol=5e-3)


def test_commands_pass_a_limit_after_a_lag():
    """1 − e^(−t/T) of a step until it reaches the limit; along T only before that, along the limit only after."""
    commands, older = jnp.ones((1, 60, 1)).at[:, :20].set(0.0), jnp.zeros((1, 0, 1))
    time, joint = along(jnp.zeros((1, 40)))
    passed = Passed(commands, older, jnp.zeros((2, *commands.shape)), jnp.zeros((2, *older.shape)))
    for name, parameter, own in (("actuator_lag", "time_constant", 0), ("actuator_saturation", "limit", 1)):
        numbers = np.array([0.04 if own == 0 else 0.5]), np.eye(2)[:, own : own + 1]
        passed = pass_on(EFFECTS[name], (parameter,), 0.002, 20, 0.01, *numbers, time, joint, passed, jnp.ones(1))
    arrived, t = passed.commands[0, 20:, 0], 0.002 * (np.arange(40) + 0.5)
    np.testing.assert_allclose(arrived, np.minimum(1.0 - np.exp(-t / 0.04), 0.5), atol=5e-3)
    free = arrived < 0.49
    np.testing.assert_allclose(passed.along[1, 0, 20:, 0][~free][1:], 1.0, atol=1e-6)
    np.testing.assert_allclose(passed.along[0, 0, 20:, 0][~free][1:], 0.0, atol=1e-6)
    np.testing.assert_allclose(passed.along[0, 0, 20:, 0][free], (-t / 0.04**2 * np.exp(-t / 0.04))[free], atol=0.3)


def test_a_scaled_sensor_is_undone_with_its_derivatives():
    q = jnp.linspace(-1.0, 1.0, 11)[None]
    still = jnp.zeros_like(q)
    seen = (still, q, still, still, still)
    numbers = (np.array([1.25]), np.array([0.6]))
    true, _, along_x, _, slope = restore_readings(EFFECTS["sensor_scale"], ("scale",), 0.004, False, *numbers, *seen)
    np.testing.assert_allclose(true, q / 1.25, rtol=1e-10)
    np.testing.assert_allclose(slope, 1 / 1.25, rtol=1e-10)
    np.testing.assert_allclose(along_x[..., 0], -0.6 * q / 1.25**2, rtol=1e-6)
    assert Moment(still, 0.1).position == 0.0


def test_a_memory_that_only_one_candidate_has_is_integrated_out():
    """Against the normal density of windows whose rows share an unknown; what all candidates have is profiled out."""
    rng = np.random.default_rng(0)
    slopes, sigma = rng.normal(size=(3, 1, 8)), np.ones(1)
    r = 0.1 * rng.normal(size=(3, 8, 1))
    nothing = (np.zeros((3, 1, 8)), np.zeros(1), np.zeros(1, bool))
    held = (np.concatenate([nothing[0], slopes], 1), np.ones((3, 8, 1), bool), nothing[1], nothing[2])

    def scores(shared):
        floor, folds = sigma, np.eye(3, dtype=bool)
        return np.asarray(cross_validate(r, *held, sigma, floor, folds, np.zeros((3, 1)), np.array([shared])))

    memory, profiled = np.zeros(3), np.zeros(3)
    for w in range(3):
        covariance = np.eye(8) + np.outer(slopes[w, 0], slopes[w, 0])
        square = r[w, :, 0] @ np.linalg.solve(covariance, r[w, :, 0])
        memory[w] = -0.5 * (square + np.linalg.slogdet(covariance)[1])
        left = r[w, :, 0] - slopes[w, 0] * (slopes[w, 0] @ r[w, :, 0]) / (1.0 + slopes[w, 0] @ slopes[w, 0])
        profiled[w] = -0.5 * left @ left
    np.testing.assert_allclose(scores(False), memory, rtol=1e-5)
    np.testing.assert_allclose(scores(True), profiled, rtol=1e-5)


def test_what_sensors_show_beside_a_motion_is_differenced_where_an_engine_has_no_derivatives():
    """MuJoCo's C engine, of models with contacts, against the one that is written out."""
    xml = """<mujoco><worldbody><body name="rod"><joint name="hinge" type="hinge" axis="0 1 0"/>
      <geom type="capsule" fromto="0 0 0 0 0 -.5" size=".02" mass="0.6"/></body></worldbody>
      <actuator><motor name="motor" joint="hinge"/></actuator>
      <sensor><jointpos name="angle" joint="hinge"/><jointvel name="speed" joint="hinge"/></sensor></mujoco>"""
    unknown = Unknown("mass", ("body/rod/mass",), 0.3, 1.2)
    channels = ["sensor/angle", "sensor/speed", "joint/hinge/qvel"]
    q, v = np.random.default_rng(0).normal(size=(2, 2, 5, 1))
    found = []
    for engine, step in (("tree", 0.0), ("mujoco", 1e-3)):
        system = mjcf_system(xml, [unknown], observe=channels, engine=engine)
        margins = Margins.create(["mass"], [uniform(0.3, 1.2)])
        found.append(_see_all(system, margins, jnp.zeros(1), q, v, np.zeros((2, 4, 1)), step))
    (seen, slopes), (its_seen, its_slopes) = found
    assert slopes.shape == (2, 5, 3, 2)
    np.testing.assert_allclose(seen, its_seen, atol=1e-6)
    np.testing.assert_allclose(slopes, its_slopes, atol=1e-4)
