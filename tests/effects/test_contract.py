"""Laws that hold for every effect: neutral, finite, differentiable, stable, composable."""

import itertools
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayessim_jax.contracts import System
from bayessim_jax.effects import (
    EFFECTS,
    Effect,
    Scales,
    at,
    effect_places,
    lookup_effect,
    recorded_scales,
    with_effects,
)
from bayessim_jax.effects.places import find_site
from bayessim_jax.systems import CartPole, Pendulum
from bayessim_jax.systems.mjcf import mjcf_system
from tests.effects.benches import arm, chirp, pendulum, scales_of, simulate, system
from tests.engines.mechanisms import HOPPER

TABLE = {
    "viscous_friction": ("force", ("viscous",)),
    "coulomb_friction": ("force", ("coulomb",)),
    "stribeck_friction": ("force", ("coulomb", "static", "velocity")),
    "asymmetric_friction": ("force", ("positive", "negative")),
    "load_dependent_friction": ("force", ("coulomb", "gain")),
    "lugre_friction": ("force", ("stiffness", "damping", "coulomb", "static", "velocity")),
    "hysteresis": ("force", ("stiffness", "A", "beta", "gamma", "n")),
    "quadratic_drag": ("force", ("coefficient",)),
    "joint_spring": ("force", ("stiffness", "reference", "cubic")),
    "soft_stop": ("force", ("angle", "stiffness", "damping")),
    "torque_ripple": ("force", ("amplitude", "cycles", "phase")),
    "joint_flexibility": ("force", ("stiffness", "damping", "rotor_inertia")),
    "backlash": ("force", ("gap", "rotor_inertia")),
    "armature": ("model", ("inertia",)),
    "payload": ("model", ("mass", "position")),
    "base_tilt": ("model", ("angle",)),
    "link_offset": ("model", ("offset",)),
    "actuator_gain": ("act", ("gain",)),
    "actuator_bias": ("act", ("torque",)),
    "actuator_delay": ("act", ("seconds",)),
    "actuator_lag": ("act", ("time_constant",)),
    "actuator_saturation": ("act", ("limit",)),
    "actuator_rate_limit": ("act", ("rate",)),
    "actuator_deadband": ("act", ("width",)),
    "back_emf": ("act", ("constant", "resistance")),
    "gain_drop": ("act", ("time", "gain")),
    "gain_drift": ("act", ("rate",)),
    "disturbance_event": ("force", ("start", "end", "impulse")),
    "sensor_offset": ("sense", ("offset",)),
    "sensor_scale": ("sense", ("scale",)),
    "sensor_delay": ("sense", ("seconds",)),
    "contact_friction": ("model", ("coefficient",)),
    "ground_slope": ("model", ("angle",)),
    "wheel_slip": ("act", ("longitudinal", "lateral")),
    "joint_coupling": ("force", ("gain",)),
}
MODELS = {"arm": (arm(), "lower"), "pendulum": (pendulum(), "bob")}
ON_ARM = [n for n in TABLE if n not in ("contact_friction", "ground_slope", "wheel_slip")]


def start_of(augmented):
    return jnp.array([0.5, *(p.start for w in augmented.effects for p in w.parameters)])


def neutral_of(augmented):
    return jnp.array([0.5, *(p.neutral for w in augmented.effects for p in w.parameters)])


def attach(name, base):
    place = effect_places(EFFECTS[name], base)[name == "soft_stop"]
    return with_effects(base, [(EFFECTS[name], place)], scales_of(base, place))


def observe_all(augmented, steps=120, force=1.0):
    count = augmented.actions.size
    model = augmented.engine.model
    return simulate(augmented, chirp(steps, 0.01, force, count), jnp.full(model.nq, 0.3), jnp.full(model.nv, -0.5))


def test_the_table_is_what_is_registered():
    assert set(EFFECTS) == set(TABLE)
    for name, (port, parameters) in TABLE.items():
        effect = lookup_effect(name)
        assert isinstance(effect, Effect)
        assert effect.port == port
        place = "joint/elbow#torque/shoulder" if name == "joint_coupling" else "world#joint/hinge"
        assert tuple(p.name for p in effect.parameters(place, Scales())) == parameters
    with pytest.raises(ValueError, match="stribeck_friction"):
        lookup_effect("stribek")


@pytest.mark.parametrize("speed", [0.2, 5.0])
def test_a_coupling_may_be_as_strong_as_its_joint_however_slowly_the_other_moves(speed):
    model = system(*MODELS["arm"]).engine.model
    assert model.nv == 2
    time = np.linspace(0.0, 6.0, 400)
    qpos = np.stack([speed * np.sin(time), np.sin(3.0 * time)], axis=1)
    qvel = np.stack([speed * np.cos(time), 3.0 * np.cos(3.0 * time)], axis=1)
    rows = qpos, qvel, np.zeros((len(time), model.nu))
    for way, usual in (("velocity", speed), ("position", speed)):
        place = f"joint/elbow#{way}/shoulder"
        scales = recorded_scales(model, place, *rows, 0.01, 6.0)
        gain = EFFECTS["joint_coupling"].parameters(place, scales)[0]
        assert gain.high * usual == pytest.approx({"velocity": 1.0, "position": 2.0}[way] * scales.force, rel=0.02)


@pytest.fixture
def in_float64():
    """In every thread: callbacks do not see `jax.enable_x64` of the thread that called."""
    jax.config.update("jax_enable_x64", True)
    yield
    jax.config.update("jax_enable_x64", False)


@cache
def seen_without_effects(engine):
    """What the arm does by itself, in float64."""
    return np.asarray(observe_all(with_effects(system(*MODELS["arm"], engine=engine), []))(jnp.array([0.5])))


@pytest.mark.parametrize("engine", ["tree", pytest.param("mujoco", marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", ON_ARM)
def test_at_neutral_parameters_the_simulator_is_the_original(name, engine, in_float64):
    base = system(*MODELS["arm"], engine=engine)
    augmented = attach(name, base)
    assert isinstance(augmented, System)
    plain, observed = seen_without_effects(engine), observe_all(augmented)
    neutral, started = observed(neutral_of(augmented)), observed(start_of(augmented))
    if engine == "mujoco":
        np.testing.assert_array_equal(neutral, plain)
    else:
        np.testing.assert_allclose(neutral, plain, rtol=0, atol=1e-13)
    assert np.abs(started - plain).max() > 1e-4


@pytest.mark.parametrize("name", ["contact_friction", "ground_slope", "base_tilt", "armature", "coulomb_friction"])
def test_neutral_in_contact(name, in_float64):
    base = mjcf_system(HOPPER, [], substeps=4, engine="mujoco")
    place = effect_places(EFFECTS[name], base)[-1]
    rows = np.tile(np.array(base.qpos), (5, 1)), np.ones((5, base.engine.model.nv)), np.ones((5, 2))
    augmented = with_effects(
        base, [(EFFECTS[name], place)], recorded_scales(base.engine.model, place, *rows, base.dt, 1.0)
    )
    actions = jnp.asarray(chirp(30, base.dt, 0.4, 2))
    theta = jnp.array([p.neutral for p in augmented.effects[0].parameters], float)
    state = augmented.begin(theta, base.qpos, base.qvel, actions[0])
    new = augmented.positions(jax.jit(augmented.replay)(theta, state, actions))
    bare = jnp.zeros(0)
    old = base.positions(jax.jit(base.replay)(bare, base.begin(bare, base.qpos, base.qvel), actions))
    np.testing.assert_allclose(new, old, rtol=0, atol=0 if EFFECTS[name].port == "model" else 1e-9)


@pytest.mark.parametrize("name", ON_ARM)
def test_derivatives_are_finite_and_not_zero_where_a_fit_begins(name):
    base = system(*MODELS["arm"])
    augmented = attach(name, base)
    with jax.enable_x64(True):
        jacobian = jax.jacfwd(observe_all(augmented))
        start = jacobian(start_of(augmented))
        assert jnp.isfinite(start).all()
        assert (jnp.abs(start).max((0, 1)) > 0).all()
        assert jnp.isfinite(jacobian(neutral_of(augmented))).all()


@pytest.mark.slow
@pytest.mark.parametrize("name", ON_ARM)
def test_derivatives_are_those_of_finite_differences(name):
    base = system(*MODELS["arm"])
    augmented = attach(name, base)
    with jax.enable_x64(True):
        observed, start = observe_all(augmented, 25), start_of(augmented)
        jacobian = jax.jacfwd(observed)(start)
        for k in range(1, len(start)):
            step = 1e-6 * jnp.maximum(jnp.abs(start[k]), 1e-3)
            slope = (observed(start.at[k].add(step)) - observed(start.at[k].add(-step))) / (2 * step)
            scale = jnp.abs(jacobian[..., k]).max()
            assert jnp.abs(slope - jacobian[..., k]).max() < 0.02 * scale + 1e-7 / step * 1e-6


@pytest.mark.slow
@pytest.mark.parametrize("name", ON_ARM)
@pytest.mark.parametrize("timestep", [0.002, 0.005])
def test_corners_of_the_ranges_are_stable_in_float32(name, timestep):
    base = system(arm(timestep), "lower")
    augmented = attach(name, base)
    edges = [(p.low, p.high) for p in augmented.effects[0].parameters]
    corners = jnp.array([[0.5, *corner] for corner in itertools.product(*edges)])
    steps = round(1000 * timestep / 0.01)
    seen = jax.vmap(observe_all(augmented, steps))(corners)
    assert seen.dtype == jnp.float32
    assert jnp.isfinite(seen).all()
    model = augmented.engine.model
    assert jnp.abs(seen[:, :, model.nq :]).max() < 2000


def test_effects_compose_in_their_order():
    base = system(*MODELS["pendulum"])
    pair = [("actuator_gain", "actuator/m"), ("actuator_bias", "actuator/m")]
    actions = chirp(50)
    runs = []
    for order in (pair, pair[::-1]):
        augmented = with_effects(base, [(EFFECTS[n], p) for n, p in order], Scales())
        named = {"gain": 2.0, "torque": 0.3}
        values = [named[p.name] for w in augmented.effects for p in w.parameters]
        runs.append(simulate(augmented, actions, 0.2, 0.0)(jnp.array([0.5, *values])))
    plain = simulate(with_effects(base, []), 2 * actions + 0.3, 0.2, 0.0)(jnp.array([0.5]))
    other = simulate(with_effects(base, []), 2 * (actions + 0.3), 0.2, 0.0)(jnp.array([0.5]))
    np.testing.assert_allclose(runs[0], plain, atol=1e-5)
    np.testing.assert_allclose(runs[1], other, atol=1e-5)


@pytest.mark.parametrize("port", ["sense", pytest.param("", marks=pytest.mark.slow)])
def test_companions_that_are_neutral_change_nothing(port, in_float64):
    """One simulator with every effect in it is each of them in turn."""
    base = system(*MODELS["pendulum"])
    names = [n for n in ON_ARM if TABLE[n][0].startswith(port) and effect_places(EFFECTS[n], base)]
    pairs = [(EFFECTS[n], effect_places(EFFECTS[n], base)[n == "soft_stop"]) for n in names]
    scales = {place: scales_of(base, place) for _, place in pairs}
    union = with_effects(base, pairs, scales)
    first = np.cumsum([0, *(len(w.parameters) for w in union.effects)])
    every = observe_all(union, steps=60)
    for k, pair in enumerate(pairs):
        alone = with_effects(base, [pair], scales)
        own = np.asarray(start_of(alone))[1:] * (1.3 if names[k] == "sensor_scale" else 1.0)
        values = np.asarray(neutral_of(union)).copy()
        values[1 + first[k] : 1 + first[k + 1]] = own
        found, expected = every(jnp.asarray(values)), observe_all(alone, steps=60)(jnp.array([0.5, *own]))
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12, err_msg=names[k])


def test_readings_are_restored_in_the_reverse_of_their_order(in_float64):
    """A window begins where the sensors show what was recorded, whatever acts on them together."""
    base = system(*MODELS["pendulum"])
    place = "joint/hinge/qpos"
    names = ("sensor_offset", "sensor_scale", "sensor_delay")
    values = {"sensor_offset": 0.05, "sensor_scale": 1.3, "sensor_delay": 0.013}
    for order in itertools.permutations(names):
        augmented = with_effects(base, [(EFFECTS[n], place) for n in order], Scales(period=0.01))
        theta = jnp.array([0.5, *(values[n] for n in order)])
        state = augmented.begin(theta, jnp.array([0.3]), jnp.array([-0.5]))
        shown = augmented.observe(theta, state)
        np.testing.assert_allclose(shown[0], 0.3, atol=3e-3, err_msg=str(order))


def test_names_units_and_ranges_are_in_the_box():
    base = system(*MODELS["arm"])
    places = [("stribeck_friction", "joint/elbow"), ("actuator_delay", "actuator/m0")]
    augmented = with_effects(base, [(EFFECTS[n], p) for n, p in places], {p: Scales() for _, p in places})
    assert augmented.parameters.names == (
        "mass",
        "stribeck_friction@joint/elbow/coulomb",
        "stribeck_friction@joint/elbow/static",
        "stribeck_friction@joint/elbow/velocity",
        "actuator_delay@actuator/m0/seconds",
    )
    assert augmented.parameters.units[1:] == ("N m", "N m", "rad/s", "s")
    assert (augmented.parameters.low < augmented.parameters.high).all()


def test_step_and_replay_are_the_same():
    base = system(*MODELS["arm"])
    pairs = [
        ("actuator_delay", "actuator/m0"),
        ("coulomb_friction", "joint/elbow"),
        ("sensor_delay", "joint/elbow/qpos"),
    ]
    augmented = with_effects(base, [(EFFECTS[n], p) for n, p in pairs], Scales())
    theta, actions = start_of(augmented), jnp.asarray(chirp(30, actuators=2), float)
    state = augmented.begin(theta, jnp.full(2, 0.3), jnp.zeros(2), actions[0])
    states = jax.jit(augmented.replay)(theta, state, actions)
    step = jax.jit(augmented.step)
    for action in actions:
        state = step(theta, state, action)
    for one, many in zip(jax.tree.leaves(state), jax.tree.leaves(states), strict=True):
        np.testing.assert_allclose(one, many[-1], atol=2e-6)


def test_windows_restarted_with_past_commands_go_on_as_the_whole():
    base = system(*MODELS["pendulum"])
    pairs = [("actuator_delay", "actuator/m"), ("actuator_lag", "actuator/m"), ("gain_drop", "actuator/m")]
    augmented = with_effects(base, [(EFFECTS[n], p) for n, p in pairs], Scales(duration=1.0))
    theta, actions = start_of(augmented), jnp.asarray(chirp(80, force=0.5), float)
    state = augmented.begin(theta, jnp.array([0.3]), jnp.zeros(1), actions[0])
    states = jax.jit(augmented.replay)(theta, state, actions)
    middle = jax.tree.map(lambda x: x[39], states)
    restarted = augmented.begin(
        theta, augmented.positions(middle), augmented.velocities(middle), actions[40], time=0.4, past=actions[:40]
    )
    later = jax.jit(augmented.replay)(theta, restarted, actions[40:])
    np.testing.assert_allclose(later.base.physics.qpos[0], states.base.physics.qpos[0][40:], atol=1e-5)


def test_a_long_past_is_gone_through_in_few_steps():
    """A limit that is always behind, and a delay before it: the beginning counts for as long as it lasts."""
    base = system(*MODELS["pendulum"])
    pairs = [("actuator_delay", "actuator/m"), ("actuator_rate_limit", "actuator/m")]
    augmented = with_effects(base, [(EFFECTS[n], p) for n, p in pairs], Scales(duration=8.0))
    theta = jnp.array([0.5, 0.05, 0.4])
    actions = jnp.asarray(0.4 * np.sign(np.sin(2.1 * 0.01 * np.arange(700)))[:, None], float)
    state = augmented.begin(theta, jnp.array([0.3]), jnp.zeros(1), actions[0])
    states = jax.jit(augmented.replay)(theta, state, actions)
    middle = jax.tree.map(lambda x: x[599], states)
    where = (augmented.positions(middle), augmented.velocities(middle), actions[600])
    wanted = float(middle.memories[1])
    whole, short = (augmented.begin(theta, *where, time=6.0, past=actions[600 - k : 600]) for k in (600, 20))
    assert abs(float(whole.memories[1]) - wanted) < 0.06
    assert abs(float(short.memories[1]) - wanted) > 0.15


def every_state(augmented, theta, begun, actions):
    """The one that a replay begins in, and those after each control period."""
    after = jax.jit(augmented.replay)(theta, begun, actions)
    return jax.tree.map(lambda first, rest: jnp.concatenate([first[None], rest]), begun, after)


@pytest.mark.parametrize(("yields", "move", "tolerance"), [(0.05, 0.0, 0.15), (0.5, -3.0, 0.01)])
def test_a_bent_joint_remembers_how_it_has_moved(yields, move, tolerance):
    """Whatever it was before, where it yields soon; where it does not, what it was before is asked for."""
    base = system(*MODELS["pendulum"])
    augmented = with_effects(base, [(EFFECTS["hysteresis"], "joint/hinge")], Scales(position=20.0 * yields))
    theta, actions = start_of(augmented), jnp.asarray(chirp(80, force=0.5), float)
    begun = augmented.begin(theta, jnp.array([0.3]), jnp.zeros(1), actions[0])
    states = every_state(augmented, theta, begun, actions)
    middle = jax.tree.map(lambda x: x[60], states)
    motion = tuple(jax.vmap(read)(states)[:60] for read in (augmented.positions, augmented.velocities))
    where = (augmented.positions(middle), augmented.velocities(middle), actions[60])
    moved = augmented.begin(theta, *where, time=0.6, motion=motion, moves=jnp.array([move]))
    bent = float(middle.memories[0])
    assert float(moved.memories[0]) == pytest.approx(bent, rel=tolerance)
    assert float(augmented.begin(theta, *where, time=0.6).memories[0]) != pytest.approx(bent, rel=0.3)


@pytest.mark.parametrize(
    ("effect", "values"),
    [
        ("actuator_gain", [2.0]),
        pytest.param("actuator_lag", [0.04], marks=pytest.mark.slow),
        ("back_emf", [0.1, 0.4]),
    ],
)
def test_a_rotor_remembers_what_arrived_of_commands(effect, values):
    """A soft drive, bent by what its motor exerts, which is not what was commanded."""
    base = system(*MODELS["pendulum"])
    pairs = [("joint_flexibility", "joint/hinge"), (effect, "actuator/m")]
    augmented = with_effects(base, [(EFFECTS[n], p) for n, p in pairs], Scales())
    theta, actions = jnp.array([0.5, 8.0, 0.05, 0.005, *values]), jnp.asarray(chirp(80, force=0.5), float)
    begun = augmented.begin(theta, jnp.array([0.3]), jnp.zeros(1), actions[0])
    states = every_state(augmented, theta, begun, actions)
    for k in (40, 50, 60, 70):
        middle = jax.tree.map(lambda x: x[k], states)  # noqa: B023
        motion = tuple(jax.vmap(read)(states)[:k] for read in (augmented.positions, augmented.velocities))
        where = (augmented.positions(middle), augmented.velocities(middle), actions[k])
        recalled = augmented.begin(theta, *where, time=0.01 * k, motion=motion, past=actions[:k])
        bend, wanted = (float(s.memories[0][0] - augmented.positions(middle)[0]) for s in (recalled, middle))
        assert bend == pytest.approx(wanted, abs=0.01)


@pytest.mark.parametrize(
    ("effect", "values"),
    [
        ("sensor_offset", [0.2]),
        pytest.param("sensor_scale", [1.3], marks=pytest.mark.slow),
        pytest.param("sensor_delay", [0.015], marks=pytest.mark.slow),
    ],
)
def test_a_rotor_remembers_the_motion_behind_what_was_shown(effect, values):
    """A spring is bent by what the joint did, and not by what a sensor made of it."""
    base = system(*MODELS["pendulum"])
    pairs = [("joint_flexibility", "joint/hinge"), (effect, "joint/hinge/qpos")]
    augmented = with_effects(base, [(EFFECTS[n], p) for n, p in pairs], Scales(period=base.dt))
    theta, actions = jnp.array([0.5, 8.0, 0.05, 0.005, *values]), jnp.asarray(chirp(80, force=0.5), float)
    begun = augmented.begin(theta, jnp.array([0.3]), jnp.zeros(1), actions[0])
    states = every_state(augmented, theta, begun, actions)
    place = [channel.name for channel in base.channels].index("joint/hinge/qpos")
    shown = jax.vmap(lambda s: augmented.observe(theta, s))(states)[:, place, None]
    velocities = jax.vmap(augmented.velocities)(states)
    for k in (40, 50, 60, 70):
        motion = shown[:k], velocities[:k]
        recalled = augmented.begin(
            theta, shown[k], velocities[k], actions[k], time=0.01 * k, motion=motion, past=actions[:k]
        )
        bend = float(recalled.memories[0][0] - augmented.positions(recalled)[0])
        wanted = float(states.memories[0][0][k] - augmented.positions(jax.tree.map(lambda x: x[k], states))[0])  # noqa: B023
        assert bend == pytest.approx(wanted, abs=0.015)


def test_what_a_system_lacks_is_told():
    base = system(*MODELS["pendulum"])
    with pytest.raises(ValueError, match="no hinge or slide 'knee'"):
        with_effects(base, [(EFFECTS["coulomb_friction"], "joint/knee")])
    with pytest.raises(ValueError, match="no actuator 'x'"):
        with_effects(base, [(EFFECTS["actuator_gain"], "actuator/x")])
    with pytest.raises(ValueError, match="MuJoCo"):
        with_effects(Pendulum.create(), [(EFFECTS["coulomb_friction"], "joint/hinge")])
    with pytest.raises(ValueError, match="choice among few"):
        with_effects(CartPole.create(), [(EFFECTS["actuator_gain"], "actuator/push")])
    with pytest.raises(ValueError, match="not observed"):
        with_effects(base, [(EFFECTS["sensor_offset"], "sensor/imu")])


@pytest.mark.parametrize("name", [n for n, (port, _) in TABLE.items() if port in ("act", "sense")])
def test_any_system_takes_effects_of_its_actuators_and_sensors(name):
    base, effect = Pendulum.create(), EFFECTS[name]
    places = effect_places(effect, base)
    if not places:
        pytest.skip("looks at joints, or takes a pair of wheels")
    augmented = with_effects(base, [(effect, places[0])], Scales(period=0.05, timestep=0.05, duration=2.0))
    assert isinstance(augmented, System)
    theta = jnp.array([0.7, 0.5, *(p.neutral for p in augmented.effects[0].parameters)])
    actions = jnp.asarray(chirp(40, 0.05, 1.5), float)
    states = jax.jit(augmented.replay)(theta, augmented.reset(jax.random.key(0), theta), actions)
    seen = jax.jit(jax.vmap(augmented.observe, (None, 0)))(theta, states)
    state, step = base.reset(jax.random.key(0), theta[:2]), jax.jit(base.step)
    for action, row in zip(actions, seen, strict=True):
        state = step(theta[:2], state, action)
        np.testing.assert_allclose(base.observe(theta[:2], state), row, atol=2e-4)


def test_places_of_every_effect_can_be_found():
    model = system(*MODELS["arm"]).engine.model
    for name in ON_ARM:
        places = EFFECTS[name].places(model)
        assert places and len(set(places)) == len(places)
        for place in places:
            find_site(model, place)
            assert at(place).split("/")[0] in ("joint", "actuator", "sensor", "body", "world")
