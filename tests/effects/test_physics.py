"""What each effect does to a machine, against its closed form."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import scipy.linalg

from bayessim_jax.effects import EFFECTS, Scales, open_form, with_effects, write_mjcf
from bayessim_jax.effects.contract import Past
from bayessim_jax.effects.mjcf_edits import WRITERS
from bayessim_jax.systems.mjcf import mjcf_system
from tests.effects.benches import arm, cart, chirp, pendulum, run, simulate, system

MASS = 2.0
RAIL = "joint/rail"


@pytest.fixture(autouse=True)
def _in_float64():
    with jax.enable_x64(True):
        yield


def ride(effects, values, actions, q=0.0, v=0.0, timestep=0.002, gravity="0 0 -9.81", **begin):
    """Position and velocity of the cart after each control period of 10 ms."""
    base = system(cart(timestep, gravity), "cart")
    seen = run(base, effects, values, np.asarray(actions), q, v, MASS, **begin)
    return np.asarray(seen[:, 0]), np.asarray(seen[:, 1])


def past(h, positions, velocities, drives):
    """How a joint moved, all of it recorded."""
    moved = map(jnp.asarray, (positions, velocities, drives))
    return Past(*moved, recorded=jnp.ones(len(drives), bool), period=h)


def push(force, steps=300):
    return np.full((steps, 1), force)


def test_viscous_friction_and_drag_end_at_their_terminal_velocities():
    _, v = ride([("viscous_friction", RAIL)], [4.0], push(6.0, 600))
    assert v[-1] == pytest.approx(6.0 / 4.0, rel=1e-4)
    assert v[49] == pytest.approx(1.5 * (1 - np.exp(-0.5 * 4.0 / MASS)), rel=1e-3)
    _, v = ride([("quadratic_drag", RAIL)], [4.0], push(6.0, 600))
    assert v[-1] == pytest.approx(np.sqrt(6.0 / 4.0), rel=1e-4)


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("coulomb_friction", [3.0]),
        ("stribeck_friction", [3.0, 3.0, 0.1]),
        ("asymmetric_friction", [3.0, 1.0]),
        ("load_dependent_friction", [3.0, 0.2]),
    ],
)
def test_dry_friction_takes_force_times_distance_and_then_holds(name, values):
    q, v = ride([(name, RAIL)], values, push(0.0), v=1.5)
    assert q[-1] == pytest.approx(0.5 * MASS * 1.5**2 / 3.0, rel=0.01)
    assert np.abs(v[-100:]).max() < 1e-12


@pytest.mark.parametrize("name", ["coulomb_friction", "stribeck_friction", "asymmetric_friction"])
@pytest.mark.parametrize("ratio", [0.5, 0.95, 1.05, 2.0])
def test_friction_holds_on_a_slope_up_to_its_level_and_not_beyond(name, ratio):
    pull = 3.0 * MASS
    level = pull / ratio
    values = {"coulomb_friction": [level], "stribeck_friction": [level, level, 0.1]}.get(name, [level, level])
    q, v = ride([(name, RAIL)], values, push(0.0), gravity="3 0 -9.81")
    if ratio < 1.0:
        assert np.abs(v).max() < 1e-10
        assert np.abs(q).max() < 1e-10
    else:
        assert v[-1] == pytest.approx((pull - level) / MASS * 3.0, rel=0.01)


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_friction_holds_a_pendulum_against_gravity_without_creep(dtype):
    with jax.enable_x64(dtype == "float64"):
        base = system(pendulum(), "bob")
        load = 0.5 * 9.81 * 0.3 * np.sin(0.8)
        seen = run(base, [("coulomb_friction", "joint/hinge")], [1.05 * load], push(0.0, 1000), 0.8, 0.0)
        assert np.abs(seen[:, 1]).max() < 1e-5
        assert np.abs(seen[:, 0] - 0.8).max() < 1e-5


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("coulomb_friction", [3.0]),
        ("asymmetric_friction", [3.0, 1.0]),
        ("stribeck_friction", [3.0, 3.0, 1.0]),
        ("load_dependent_friction", [3.0, 0.0]),
    ],
)
@pytest.mark.parametrize("onset", [1e-9, 0.02, 0.2])
def test_a_rounded_sign_lets_a_joint_creep_below_its_onset_and_no_further(name, values, onset):
    """Pushed with half the level it moves at half the onset; pushed with more than the level, as with a sharp sign."""
    rounded = open_form(EFFECTS[name])
    base = system(cart(0.002, "0 0 -9.81"), "cart")
    creeping = run(base, [(rounded, RAIL)], [*values, onset, 0.0], push(1.5, 600), 0.0, 0.0, MASS)
    assert float(creeping[-1, 1]) == pytest.approx(0.5 * onset, rel=1e-3, abs=1e-8)
    sliding = run(base, [(rounded, RAIL)], [*values, onset, 0.0], push(3.5, 600), 0.0, 0.0, MASS)
    assert float(sliding[-1, 1] - sliding[-101, 1]) == pytest.approx((3.5 - 3.0) / MASS, rel=1e-3)


def test_what_moves_a_joint_below_the_onset_is_held_in_part():
    """Pushed with half the level it creeps at half the onset, at less, or not at all, and comes to that slowly."""
    base, rounded = system(cart(0.002, "0 0 -9.81"), "cart"), open_form(EFFECTS["coulomb_friction"])
    creep = []
    for hold in (0.0, 0.5, 1.0):
        seen = np.asarray(run(base, [(rounded, RAIL)], [3.0, 0.2, hold], push(1.5, 600), 0.0, 0.15, MASS))[:, 1]
        assert np.all(np.diff(seen) < 1e-9) and seen[10] > 0.1 * (0.15 - seen[-1]) + seen[-1]
        creep.append(seen[-1])
    assert creep[0] == pytest.approx(0.1, rel=1e-3) and 0.04 < creep[1] < 0.07
    assert creep[2] == pytest.approx(0.0, abs=1e-5)


def test_friction_that_holds_is_what_mujoco_makes_of_frictionloss():
    """Where its constraint does not slip, a = (1 − d) a₀ − d b v; impedance d = 0.9 and b = 2/(0.95 · 0.02 s)."""
    xml, actions = cart(0.0005, "0 0 -9.81"), 4.0 * np.sin(0.01 * 2.0 * np.pi * np.arange(300))[:, None]
    model = mujoco.MjModel.from_xml_string(xml)
    model.dof_frictionloss[0], data, wanted = 3.0, mujoco.MjData(model), []
    for (force,) in actions:
        data.ctrl[0] = force
        mujoco.mj_step(model, data, 20)
        wanted.append(data.qvel[0])
    base, rounded = system(xml, "cart"), open_form(EFFECTS["coulomb_friction"])
    ride = simulate(with_effects(base, [(rounded, RAIL)], Scales()), actions, 0.0, 0.0)

    def error(hold):
        onsets = 3.0 / (MASS * 0.9 * 105.3) * np.array([0.1, 0.5, 0.7, 1.0, 1.4, 2.0])
        return min(np.abs(ride(jnp.array([MASS, 3.0, v, hold]))[:, 1] - np.array(wanted)).max() for v in onsets)

    holding, creeping = min(map(error, (0.85, 0.9, 0.93, 0.96))), error(0.0)
    assert holding < 0.01 * np.abs(wanted).max()
    assert holding < 0.3 * creeping


@pytest.mark.parametrize(("onset", "counts"), [(0.02, 0.02), (0.05, 0.05), (0.2, 0.05)])
def test_a_sign_is_not_rounded_beyond_half_of_the_speed_at_which_friction_falls(onset, counts):
    """Or a fall within the onset would be another form of the sign of friction that does not fall."""
    base, rounded = system(cart(0.002, "0 0 -9.81"), "cart"), open_form(EFFECTS["stribeck_friction"])
    creeping = run(base, [(rounded, RAIL)], [3.0, 3.0, 0.1, onset, 0.0], push(1.5, 600), 0.0, 0.0, MASS)
    assert float(creeping[-1, 1]) == pytest.approx(0.5 * counts, rel=1e-3)


def test_a_form_is_open_only_in_what_asks_for_it():
    place, scales = "joint/hinge", Scales()
    assert [p.name for p in EFFECTS["coulomb_friction"].parameters(place, scales)] == ["coulomb"]
    rounded = open_form(EFFECTS["coulomb_friction"])
    assert [p.name for p in rounded.parameters(place, scales)] == ["coulomb", "onset", "hold"]
    assert open_form(EFFECTS["viscous_friction"]) is EFFECTS["viscous_friction"]


@pytest.mark.parametrize(
    ("name", "values", "tolerance"),
    [
        ("coulomb_friction", [0.2], 0.01),
        ("asymmetric_friction", [0.3, 0.1], 0.01),
        ("load_dependent_friction", [0.1, 0.1], 0.01),
        ("stribeck_friction", [0.1, 0.3, 0.3], 0.03),
        ("lugre_friction", [50.0, 0.5, 0.1, 0.2, 0.3], 0.03),
        ("hysteresis", [10.0, 1.0, 20.0, 2.0, 1.1], 0.02),
        ("viscous_friction", [0.1], 0.01),
        ("quadratic_drag", [0.1], 0.01),
        ("soft_stop", [0.4, 30.0, 0.1], 0.04),
        ("joint_flexibility", [8.0, 0.02, 0.01], 0.02),
        ("backlash", [0.1, 0.01], 0.03),
    ],
)
def test_a_fiftieth_of_the_time_step_gives_the_same_motion(name, values, tolerance):
    place = {"backlash": "actuator/m", "soft_stop": "joint/hinge#upper"}.get(name, "joint/hinge")
    actions = chirp(150, force=0.7)
    coarse, fine = (
        np.asarray(run(system(pendulum(h), "bob"), [(name, place)], values, actions, 0.2, 0.0)) for h in (2e-3, 4e-5)
    )
    assert np.sqrt(((coarse - fine) ** 2).mean(0) / fine.var(0)).max() < tolerance


def test_stribeck_friction_breaks_away_at_its_static_level_and_slides_at_its_coulomb_level():
    effects, values = [("stribeck_friction", RAIL)], [1.0, 3.0, 0.05]
    assert np.abs(ride(effects, values, push(2.9))[0]).max() < 1e-9
    _, v = ride(effects, values, push(3.1))
    assert (v[-1] - v[-101]) == pytest.approx((3.1 - 1.0) / MASS, rel=0.01)


def test_load_dependent_friction_grows_with_the_motor_s_force():
    _, v = ride([("load_dependent_friction", RAIL)], [0.5, 0.25], push(8.0))
    assert v[-1] == pytest.approx((8.0 - 0.5 - 0.25 * 8.0) / MASS * 3.0, rel=1e-3)


def test_bristles_bend_before_they_slip():
    values = [1000.0, 60.0, 2.0, 3.0, 0.1]
    q, _ = ride([("lugre_friction", RAIL)], values, np.concatenate([push(0.0, 1), push(1.0, 600)]))
    assert q[-1] == pytest.approx(-3.0 / 1000.0 * np.log(1.0 - 1.0 / 3.0), rel=0.1)
    _, v = ride([("lugre_friction", RAIL)], values, push(5.0, 600))
    assert v[-1] - v[-101] == pytest.approx((5.0 - 2.0) / MASS, rel=0.01)


@pytest.mark.parametrize(("k", "d", "rotor"), [(900.0, 3.0, 1.5), (900.0, 90.0, 1.5), (4e6, 10.0, 1.5)])
def test_a_rotor_is_recalled_as_it_rang(k, d, rotor):
    """Against the same equation in steps fifty times as fine; ringing, creeping, and too stiff for its steps."""
    h, many = 0.005, 50
    t = h * np.arange(201)
    position, velocity = 0.1 * np.sin(5.0 * t), 0.5 * np.cos(5.0 * t)
    drive = 4.0 * np.sign(np.sin(9.0 * t[:-1]))
    angle, speed = position[0] + drive[0] / k, velocity[0]
    ahead = scipy.linalg.expm(np.array([[0.0, 1.0], [-k / rotor, -d / rotor]]) * h / many)
    for i in range(200):
        for part in range(many):
            now = t[i] + h * (part + 0.5) / many
            rest = 0.1 * np.sin(5.0 * now) + (drive[i] + d * 0.5 * np.cos(5.0 * now)) / k
            angle, speed = np.array([rest, 0.0]) + ahead @ (np.array([angle, speed]) - np.array([rest, 0.0]))
    values = {"stiffness": k, "damping": d, "rotor_inertia": rotor}
    recalled = EFFECTS["joint_flexibility"].recall(values, (0.0, 0.0), past(h, position, velocity, drive))
    assert float(recalled[0]) == pytest.approx(angle, abs=0.02 * np.ptp(position))
    bend, wanted = float(recalled[0]) - position[-1], angle - position[-1]
    assert bend == pytest.approx(wanted, abs=0.15 * abs(wanted) + 1e-4)


def test_hysteresis_ends_at_the_force_of_its_last_deflection():
    stiffness, beta, gamma = 200.0, 40.0, 10.0
    q, v = ride([("hysteresis", RAIL)], [stiffness, 1.0, beta, gamma, 1.0], push(8.0, 400))
    assert v[-1] - v[-101] == pytest.approx((8.0 - stiffness / (beta + gamma)) / MASS, rel=0.01)
    energy = 0.5 * MASS * v[-1] ** 2
    assert energy < 8.0 * q[-1] - 0.9 * stiffness / (beta + gamma) * q[-1]


def test_a_spring_sets_the_frequency():
    q, _ = ride([("joint_spring", RAIL)], [50.0, 0.1, 0.0], push(0.0, 400), q=0.3)
    time = 0.01 * np.arange(1, 401)
    np.testing.assert_allclose(q, 0.1 + 0.2 * np.cos(np.sqrt(50.0 / MASS) * time), atol=0.01)


def test_a_stop_gives_as_much_as_it_is_pressed():
    q, _ = ride([("soft_stop", RAIL + "#upper")], [0.2, 500.0, 60.0], push(5.0, 600))
    assert q[-1] == pytest.approx(0.2 + 5.0 / 500.0, abs=1e-5)
    q, _ = ride([("soft_stop", RAIL + "#lower")], [-0.2, 500.0, 60.0], push(-5.0, 600))
    assert q[-1] == pytest.approx(-0.2 - 5.0 / 500.0, abs=1e-5)
    free, _ = ride([("soft_stop", RAIL + "#lower")], [-0.2, 500.0, 60.0], push(5.0))
    np.testing.assert_array_equal(free, ride([], [], push(5.0))[0])


def test_ripple_is_a_sine_of_the_position():
    _, v = ride([("torque_ripple", RAIL)], [3.0, 20.0, 0.4], push(0.0, 1), q=0.13, timestep=0.01)
    assert v[0] == pytest.approx(0.01 * 3.0 * np.sin(20.0 * 0.13 + 0.4) / MASS, rel=1e-9)


def test_a_flexible_joint_rings_at_its_frequency_about_the_stiff_motion():
    stiffness, rotor = 400.0, 0.5
    _, v = ride([("joint_flexibility", RAIL)], [stiffness, 0.0, rotor], push(1.0, 300), timestep=0.0005)
    time = 0.01 * np.arange(1, 301)
    rest = v - time / (MASS + rotor)
    spectrum = np.abs(np.fft.rfft((rest - rest.mean()) * np.hanning(300), 8192))
    frequency = np.fft.rfftfreq(8192, 0.01)[spectrum.argmax()]
    assert frequency == pytest.approx(np.sqrt(stiffness * (1 / MASS + 1 / rotor)) / (2 * np.pi), rel=0.05)
    assert v[-1] / time[-1] == pytest.approx(1.0 / (MASS + rotor), rel=0.05)


def test_backlash_loses_motion_at_a_reversal():
    gap, rotor, force = 0.02, 0.5, 2.0
    there = np.concatenate([push(force, 100), push(-force, 200)])
    _, v = ride([("backlash", "actuator/m")], [gap, rotor], there)
    assert v[50] - v[40] == pytest.approx(0.1 * force / (MASS + rotor), rel=1e-3)
    crossing = np.sqrt(2 * gap * rotor / force)
    free = v[100 : 100 + int(crossing / 0.01) - 1]
    assert np.ptp(free) < 1e-6
    assert v[-1] - v[-11] == pytest.approx(-0.1 * force / (MASS + rotor), rel=1e-3)
    stiff = ride([("armature", RAIL)], [rotor], there)[0]
    tight = ride([("backlash", "actuator/m")], [0.0, rotor], there)[0]
    np.testing.assert_allclose(tight, stiff, atol=5e-3)


def test_teeth_that_give_way_ring_as_a_spring_between_two_inertias_and_rigid_ones_mesh():
    rotor, k, force, rounded = 0.5, 400.0, 2.0, open_form(EFFECTS["backlash"])
    _, v = ride([(rounded, "actuator/m")], [0.0, rotor, k, 0.02], np.concatenate([push(0.0, 20), push(force, 280)]))
    t = 0.01 * np.arange(280)
    rings = v[20:] - np.polyval(np.polyfit(t, v[20:], 1), t)
    crossings = np.flatnonzero((rings[:60] < 0.0) & (rings[1:61] >= 0.0))
    period = 2.0 * np.pi * np.sqrt(rotor * MASS / (rotor + MASS) / k)
    assert 0.01 * np.diff(crossings).mean() == pytest.approx(period, rel=0.1)
    assert v[-1] - v[-101] == pytest.approx(force / (MASS + rotor), rel=0.01)
    gap, there = 0.02, np.concatenate([push(force, 100), push(-force, 200)])
    rigid = ride([("backlash", "actuator/m")], [gap, rotor], there)[1]
    stiff = ride([(rounded, "actuator/m")], [gap, rotor, 1e7, 1.0], there)[1]
    np.testing.assert_allclose(stiff, rigid, atol=0.02)


def test_armature_is_inertia_of_the_joint_alone():
    _, v = ride([("armature", RAIL)], [3.0], push(5.0, 100))
    assert v[-1] == pytest.approx(5.0 / (MASS + 3.0), rel=1e-9)


def test_a_tilted_base_moves_the_equilibrium():
    base = system(pendulum(), "bob")
    pair = [("base_tilt", "world#joint/hinge"), ("viscous_friction", "joint/hinge")]
    seen = run(base, pair, [0.1, 0.5], push(0.0, 1500), 0.0, 0.0)
    assert abs(seen[-1, 0]) == pytest.approx(0.1, abs=1e-4)


def test_an_actuator_s_effects_are_what_they_say_of_the_command():
    u = chirp(100, force=2.0)
    time = 0.01 * np.arange(100)[:, None]
    cases = {
        "actuator_gain": ([0.7], 0.7 * u),
        "actuator_bias": ([0.3], u + 0.3),
        "actuator_saturation": ([1.2], np.clip(u, -1.2, 1.2)),
        "actuator_deadband": ([0.4], np.sign(u) * np.maximum(np.abs(u) - 0.4, 0.0)),
        "gain_drop": ([0.5, 0.6], np.where(time < 0.5 - 1e-9, u, 0.6 * u)),
        "actuator_delay": ([0.03], np.concatenate([u[:1], u[:1], u[:1], u[:-3]])),
    }
    for name, (values, commands) in cases.items():
        ours, _ = ride([(name, "actuator/m")], values, u)
        np.testing.assert_allclose(ours, ride([], [], commands)[0], atol=1e-9, err_msg=name)
    half, _ = ride([("actuator_delay", "actuator/m")], [0.005], u, timestep=0.01)
    np.testing.assert_allclose(half, ride([], [], (u + np.concatenate([u[:1], u[:-1]])) / 2, timestep=0.01)[0])


def test_drift_starts_at_the_beginning_of_the_recording():
    u = chirp(50)
    late, _ = ride([("gain_drift", "actuator/m")], [0.2], u, timestep=0.01, time=3.0)
    commands = u * (1 + 0.2 * (3.0 + 0.01 * np.arange(50)[:, None]))
    np.testing.assert_allclose(late, ride([], [], commands, timestep=0.01)[0], rtol=1e-9)


def test_a_lag_answers_a_step_exponentially():
    _, v = ride([("actuator_lag", "actuator/m")], [0.2], push(4.0, 100), past=np.zeros((1, 1)))
    time = 0.01 * np.arange(1, 101)
    np.testing.assert_allclose(v, 4.0 / MASS * (time - 0.2 * (1 - np.exp(-time / 0.2))), atol=1e-9)


def test_a_rate_limit_makes_a_ramp_of_a_step():
    _, v = ride([("actuator_rate_limit", "actuator/m")], [10.0], push(4.0, 60), past=np.zeros((1, 1)))
    ramp = np.minimum(10.0 * 0.002 * np.arange(1, 301), 4.0)
    np.testing.assert_allclose(v, np.cumsum(ramp)[4::5] * 0.002 / MASS, atol=1e-12)


def test_back_emf_sets_the_speed_without_load():
    _, v = ride([("back_emf", "actuator/m")], [2.0, 1.0], push(3.0, 1000))
    assert v[-1] == pytest.approx(3.0 / 2.0, rel=1e-4)
    _, v = ride([("back_emf", "actuator/m")], [0.0, 2.0], push(3.0, 100))
    assert v[-1] == pytest.approx(3.0 / 2.0 / MASS, rel=1e-9)


@pytest.mark.parametrize("taper", [None, 0.05, 0.5, 1.0])
def test_an_event_hands_over_its_impulse_and_nothing_before_or_after(taper):
    event, rounded = EFFECTS["disturbance_event"], () if taper is None else (taper,)
    _, v = ride([(open_form(event) if rounded else event, RAIL)], [0.31, 0.52, 3.0, *rounded], push(0.0, 100))
    assert np.abs(v[:31]).max() == 0.0
    np.testing.assert_allclose(v[53:], 3.0 / MASS, rtol=1e-3 if rounded else 1e-6)
    top = 3.0 / (0.21 * (1.0 - 0.5 * (taper or 1.0))) / MASS
    np.testing.assert_allclose(np.diff(v).max() / 0.01, top, rtol=0.02)


def test_sensors_show_what_they_are_said_to_and_states_begin_as_measured():
    u, channel = chirp(100), RAIL + "/qpos"
    true, _ = ride([], [], u, q=0.2, v=0.5)
    shown, _ = ride([("sensor_offset", channel)], [0.07], u, q=0.27, v=0.5)
    np.testing.assert_allclose(shown, true + 0.07, atol=1e-12)
    shown, _ = ride([("sensor_scale", channel)], [1.1], u, q=0.22, v=0.5)
    np.testing.assert_allclose(shown, 1.1 * true, atol=1e-12)


@pytest.mark.parametrize("moved", [0.0, 0.3, 1.0, 4.0])
def test_bristles_are_recalled_as_they_bent(moved):
    """After lasting motion one way, and a way x back: s = −F + 2 F exp(−σ₀ x / F)."""
    level, stiffness, h = 2.0, 500.0, 1e-4
    values = {"stiffness": stiffness, "damping": 3.0, "coulomb": level, "static": level, "velocity": 0.1}
    back = round(moved * level / stiffness / (0.1 * h))
    velocities = jnp.concatenate([jnp.full(3000, 0.1), jnp.full(back + 1, -0.1)])
    still = jnp.zeros_like(velocities)
    bent = EFFECTS["lugre_friction"].recall(values, jnp.zeros(()), past(h, still, velocities, still[1:]))
    assert float(bent) == pytest.approx(-level + 2 * level * np.exp(-moved), abs=0.01 * level)


@pytest.mark.parametrize("back", [0.05, 0.25, 0.6])
def test_a_spring_that_yields_is_recalled_as_it_was_bent(back):
    """After lasting motion one way, and a way x back: z = 1/(2β) − x as far as 0, and (exp(−2β x') − 1)/(2β) beyond."""
    beta, h, speed = 2.0, 0.01, 0.5
    velocities = jnp.concatenate([jnp.full(600, speed), jnp.full(round(back / (speed * h)), -speed)])
    velocities = jnp.append(velocities, -speed)
    still = jnp.zeros_like(velocities)
    values = {"stiffness": 3.0, "A": 1.0, "beta": beta, "gamma": beta, "n": 1.0}
    most = 0.5 / beta
    beyond = max(back - most, 0.0)
    wanted = most - back if back < most else most * np.expm1(-beyond / most)
    for move in (-1.0, 0.0, 1.0):
        bent = EFFECTS["hysteresis"].recall(values, jnp.zeros(()), past(h, still, velocities, still[1:]), move)
        assert float(bent) == pytest.approx(wanted, abs=0.02 * most)


def test_what_a_spring_was_bent_before_a_recording_is_left_open():
    """What was not recorded bends nothing; rest leaves all as it is, up to `move`; a path leaves less of a guess."""
    values = {"stiffness": 3.0, "A": 1.0, "beta": 2.0, "gamma": 2.0, "n": 1.0}
    most, still = 0.25, jnp.zeros(101)
    recall = EFFECTS["hysteresis"].recall
    coasted = past(0.01, still, still + 0.5, still[1:])._replace(recorded=jnp.zeros(100, bool))
    for before in (coasted, past(0.01, still, still, still[1:])):
        assert float(recall(values, 0.4 * most, before)) == pytest.approx(0.36 * most)
        assert float(recall(values, 0.4 * most, before, 9.0)) == pytest.approx(most, rel=1e-3)
        assert float(recall(values, 0.4 * most, before, -9.0)) == pytest.approx(-most, rel=1e-3)
    there_and_back = past(0.01, still, 0.02 * jnp.where(jnp.arange(101) < 50, 1.0, -1.0), still[1:])
    bent = float(recall(values, 0.4 * most, there_and_back))
    assert 0.2 * most < bent < 0.36 * most


def test_what_bristles_were_bent_before_a_recording_is_left_open():
    """Rest leaves all as it is, up to `move`; slipping over their reach leaves nothing of either."""
    values = {"stiffness": 4.0, "damping": 0.1, "coulomb": 0.2, "static": 0.3, "velocity": 0.1}
    still, recall = jnp.zeros(101), EFFECTS["lugre_friction"].recall
    resting, slipping = past(0.01, still, still, still[1:]), past(0.01, still, still + 1.0, still[1:])
    assert float(recall(values, 0.1, resting)) == pytest.approx(0.09)
    assert float(recall(values, 0.1, resting, 9.0)) == pytest.approx(0.3, rel=1e-3)
    assert float(recall(values, 0.1, resting, -9.0)) == pytest.approx(-0.3, rel=1e-3)
    for move in (-1.0, 0.0, 1.0):
        assert float(recall(values, 0.1, slipping, move)) == pytest.approx(0.2, rel=1e-3)


@pytest.mark.parametrize("rows", [150, 158, 165, 180, 201])
def test_a_motor_is_recalled_where_it_was_within_its_gap(rows):
    """Against the same motor in steps a hundred times as fine: pressed to either end, and on its way between them."""
    h, many, rotor, gap = 0.01, 800, 0.02, 0.05
    t = h * np.arange(rows)
    drive = 0.05 * np.sign(np.sin(4.0 * t[:-1]))
    angle, speed, where = 0.5 * gap * np.sign(drive[0]), 0.5, []
    for i in range(rows - 1):
        for part in range(many):
            now = t[i] + h * (part + 1) / many
            speed += h / many * drive[i] / rotor
            angle += h / many * speed
            q, v = 0.1 * np.sin(5.0 * now), 0.5 * np.cos(5.0 * now)
            if abs(angle - q) >= 0.5 * gap:
                end = np.sign(angle - q)
                angle, speed = q + 0.5 * gap * end, end * min(end * speed, end * v)
        where.append((angle - q) / gap)
    assert min(where) < -0.499 and max(where) > 0.499 and np.mean(np.abs(where) < 0.4) > 0.1
    values = {"gap": gap, "rotor_inertia": rotor}
    motion = past(h, 0.1 * np.sin(5.0 * t), 0.5 * np.cos(5.0 * t), drive)
    recalled = EFFECTS["backlash"].recall(values, (0.0, 0.0), motion)
    assert float(recalled[0]) == pytest.approx(angle, abs=0.01 * gap)
    assert float(recalled[1]) == pytest.approx(speed, abs=0.02)


@pytest.mark.parametrize("prompt", [False, True])
@pytest.mark.parametrize("delay", [0.01, 0.023, 0.05])
def test_a_late_sensor_shows_what_was(delay, prompt):
    """Positions come late; velocities with them, or of themselves and in time."""
    channels = ["joint/hinge/qpos", "joint/hinge/qvel"][: 1 + prompt]
    base = mjcf_system(pendulum(), [], observe=channels, substeps=5, engine="tree")
    fine = mjcf_system(pendulum(1e-4), [], engine="tree")
    bare = jnp.zeros(0)
    begun = fine.begin(bare, jnp.array([0.9]), jnp.array([0.0]))
    path = fine.replay(bare, begun, jnp.zeros((20000, 1))).physics
    measured = 3000 - round(delay / 1e-4)
    augmented = with_effects(base, [(EFFECTS["sensor_delay"], "joint/hinge/qpos")], Scales())
    start = float(path.qpos[0][measured]), float(path.qvel[0][3000 if prompt else measured])
    seen = simulate(augmented, np.zeros((100, 1)), *start)(jnp.array([delay]))
    assert np.abs(seen[:, 0] - path.qpos[0][measured + 100 * np.arange(1, 101)]).max() < 0.01


def test_slip_slows_a_vehicle_and_its_turning():
    left, right = EFFECTS["wheel_slip"].command({"longitudinal": 0.1, "lateral": 0.4}, (), (1.0, 3.0), None)[0]
    assert (left + right) / 2 == pytest.approx(0.9 * 2.0)
    assert (right - left) / 2 == pytest.approx(0.6 * 1.0)
    assert EFFECTS["wheel_slip"].choose(["left_wheel", "right_wheel"]) == ["actuator/left_wheel#actuator/right_wheel"]


def test_a_coupled_joint_feels_the_other_s_motor():
    base, actions = system(arm(), "lower"), np.tile([0.4, 0.0], (50, 1))
    ours = run(base, [("joint_coupling", "joint/elbow#torque/shoulder")], [0.3], actions, [0.1, 0.2], [0.0, 0.0])
    both = run(base, [], [], np.tile([0.4, 0.12], (50, 1)), [0.1, 0.2], [0.0, 0.0])
    np.testing.assert_allclose(ours, both, atol=1e-12)


BOX = (
    '<mujoco><option timestep="0.002" cone="elliptic" impratio="100"/><worldbody>'
    '<geom name="floor" type="plane" size="5 5 1" friction="0.8 0 0"/>'
    '<body name="box" pos="0 0 0.1"><joint name="x" type="slide" axis="1 0 0"/>'
    '<joint name="z" type="slide" axis="0 0 1" damping="300"/>'
    '<joint name="tip" axis="0 1 0" stiffness="1000" damping="10"/>'
    '<geom name="crate" type="box" size="0.2 0.2 0.1" mass="1" friction="0.8 0 0"/></body></worldbody></mujoco>'
)


def test_contact_friction_and_slope_of_the_ground():
    base = mjcf_system(BOX, [], substeps=5, engine="mujoco")

    def slide(name, place, value, speed=8.0):
        augmented = with_effects(base, [(EFFECTS[name], place)], Scales(friction=0.8))
        theta, actions = jnp.array([value]), jnp.zeros((50, 0))
        state = augmented.begin(theta, base.qpos, jnp.array([speed, 0.0, 0.0]))
        return np.asarray(augmented.velocities(augmented.replay(theta, state, actions)))[:, 0]

    for coefficient in (0.2, 0.8, 1.2):
        v = slide("contact_friction", "geom/crate", coefficient)
        assert v[9] - v[44] == pytest.approx(coefficient * 9.81 * 0.35, rel=0.15)
        spec = mujoco.MjSpec.from_string(BOX)
        assert write_mjcf(spec, EFFECTS["contact_friction"], "geom/crate", {"coefficient": coefficient})
        written = mjcf_system(spec, [], substeps=5, engine="mujoco")
        bare = jnp.zeros(0)
        begun = written.begin(bare, base.qpos, jnp.array([8.0, 0.0, 0.0]))
        np.testing.assert_allclose(v, written.replay(bare, begun, jnp.zeros((50, 0))).physics.qvel[:, 0], atol=1e-9)
    for angle in (-0.5, 0.5):
        v = slide("ground_slope", "world#joint/tip", angle)
        spec = mujoco.MjSpec.from_string(BOX)
        spec.option.gravity = [-9.81 * np.sin(angle), 0.0, -9.81 * np.cos(angle)]
        slope = mjcf_system(spec, [], substeps=5, engine="mujoco")
        begun = slope.begin(bare, base.qpos, jnp.array([8.0, 0.0, 0.0]))
        np.testing.assert_allclose(v, slope.replay(bare, begun, jnp.zeros((50, 0))).physics.qvel[:, 0], atol=1e-9)


WRITTEN = {
    "viscous_friction": ("joint/elbow", [0.05]),
    "quadratic_drag": ("joint/elbow", [0.02]),
    "coulomb_friction": ("joint/elbow", [0.1]),
    "joint_spring": ("joint/elbow", [2.0, 0.1, 0.5]),
    "armature": ("joint/elbow", [0.05]),
    "payload": ("body/lower", [0.2, 0.4]),
    "link_offset": ("body/lower", [0.05]),
    "base_tilt": ("world#joint/shoulder", [0.2]),
    "actuator_gain": ("actuator/m0", [1.3]),
    "actuator_bias": ("actuator/m0", [0.2]),
    "actuator_saturation": ("actuator/m0", [0.4]),
    "actuator_lag": ("actuator/m0", [0.05]),
    "actuator_delay": ("actuator/m0", [0.0131]),
    "back_emf": ("actuator/m0", [0.1, 1.2]),
}


@pytest.mark.parametrize("name", WRITTEN)
def test_a_model_with_the_effect_written_in_moves_as_the_simulator_with_the_effect(name):
    place, values = WRITTEN[name]
    base = mjcf_system(arm(), [], substeps=5, engine="tree")
    augmented = with_effects(base, [(EFFECTS[name], place)], Scales())
    actions = chirp(60, actuators=2)
    ours = simulate(augmented, actions, [0.3, 0.3], [0.0, 0.0])(jnp.array(values))
    spec = mujoco.MjSpec.from_string(arm())
    names = [p.name for p in augmented.effects[0].parameters]
    assert write_mjcf(spec, EFFECTS[name], place, dict(zip(names, values, strict=True)))
    model = spec.compile()
    data, rows = mujoco.MjData(model), []
    data.qpos[:] = 0.3
    for action in actions:
        data.ctrl[:] = action
        for _ in range(5):
            mujoco.mj_step(model, data)
        rows.append([*data.qpos, *data.qvel])
    nq = np.sqrt(((np.asarray(ours) - rows) ** 2).mean(0) / np.var(rows, axis=0)).max()
    assert nq < 0.03


def test_what_mjcf_cannot_say_is_left_alone():
    spec = mujoco.MjSpec.from_string(arm())
    before = spec.to_xml()
    for name in set(EFFECTS) - set(WRITERS):
        assert not write_mjcf(spec, EFFECTS[name], "joint/elbow", {})
    assert spec.to_xml() == before
