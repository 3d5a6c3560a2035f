"""Concealed laws: neutral at zero, as strong as asked, and what they say they are."""

import math

import mujoco
import numpy as np
import pytest

from bayessim_jax.concealment import LAWS, ModelLaw, StrengthError, choose_place, hide, lookup_law, make_scene
from bayessim_jax.concealment.bristle import Bristle, RoundSign, draw_rounding
from bayessim_jax.concealment.world import FINE, LONGEST, build, count_substeps
from benchmarks.worlds import RIGS

SHORT = {"kind": "mixed", "recordings": 3, "seconds": 2.0, "stride": 2, "jitter": 0.0}
PLACES = [
    (rig, name)
    for rig in ("pendulum", "double", "sled")
    for name in LAWS
    if LAWS[name].places(mujoco.MjModel.from_xml_string(RIGS[rig].xml))
    and (rig != "sled" or name in ("contact_friction", "ground_slope"))
]
SCENES = {}


def scene_of(rig):
    if rig not in SCENES:
        spec = mujoco.MjSpec.from_string(RIGS[rig].xml)
        for body in spec.bodies[1:]:
            body.simple = 0
        SCENES[rig] = make_scene(spec.compile(), np.random.default_rng(0), **SHORT)
    return SCENES[rig]


def made(rig, name, place, amplitude=0.0, seed=0):
    scene = scene_of(rig)
    return scene, lookup_law(name).make(scene.spot(place), amplitude, np.random.default_rng(seed))


def test_every_effect_that_mjcf_can_have_is_there():
    from bayessim_jax.effects import EFFECTS

    assert set(EFFECTS) - set(LAWS) == {"wheel_slip"}
    assert sum(name.startswith("unknown:") for name in LAWS) >= 8
    assert not {name.removeprefix("unknown:") for name in LAWS if ":" in name} & set(EFFECTS)


@pytest.mark.parametrize(("rig", "name"), PLACES)
def test_at_amplitude_zero_nothing_changes(rig, name):
    scene = scene_of(rig)
    for place in lookup_law(name).places(scene.model)[:2]:
        _, law = made(rig, name, place)
        for track, clean in zip(scene.play([law]), scene.clean, strict=True):
            np.testing.assert_allclose(track.shown, clean.qpos, rtol=0, atol=1e-10)
            np.testing.assert_allclose(track.qvel, clean.qvel, rtol=0, atol=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize(("rig", "name"), PLACES)
def test_the_strength_asked_for_is_reached(rig, name):
    scene, rng = scene_of(rig), np.random.default_rng(1)
    place = {"contact_friction": "geom/runner"}.get(name) or choose_place(scene.model, name, None, rng)
    hidden = hide(scene, name, place, 0.15, seed=2)
    assert hidden.strength == pytest.approx(0.15, rel=0.1)
    again = scene.strength(hidden.law.spot, scene.play([hidden.law]))
    assert again == pytest.approx(hidden.strength, rel=1e-9)
    assert all(math.isfinite(value) for value in hidden.law.parameters().values())


@pytest.mark.parametrize("name", ["coulomb_friction", "armature", "actuator_lag", "sensor_offset", "unknown:jolt"])
def test_the_strength_of_one_at_each_port_is_reached(name):
    scene = scene_of("pendulum")
    place = lookup_law(name).places(scene.model)[0]
    assert hide(scene, name, place, 0.3, seed=1).strength == pytest.approx(0.3, rel=0.1)


def test_a_machine_without_laws_lacks_nothing():
    for rig in ("pendulum", "double"):
        scene = scene_of(rig)
        for joint in range(scene.model.njnt):
            assert scene.strength(scene.spot(f"joint/{scene.model.joint(joint).name}"), scene.clean) < 1e-9


def test_the_strength_of_a_spring_is_that_of_its_force():
    scene, law = made("pendulum", "joint_spring", "joint/hinge", 0.2)
    tracks = scene.play([law])
    q = np.concatenate([t.qpos[: t.rows[-1], 0] for t in tracks])
    force = np.array([law.force(None, x, 0.0) for x in q])
    expected = np.sqrt(np.mean(force**2)) / scene.spot("joint/hinge").force
    applied = scene.strength(law.spot, tracks)
    assert applied == pytest.approx(expected, rel=0.5)
    _, double = made("pendulum", "joint_spring", "joint/hinge", 0.02)
    assert scene.strength(law.spot, scene.play([double])) < 0.25 * applied


def test_what_the_true_model_lacks_is_the_strength_also_of_what_is_short():
    scene, law = made("pendulum", "actuator_rate_limit", "actuator/motor", 0.3)
    tracks = scene.play([law])
    lacks = scene.lack(scene.model, tracks)
    motors = np.sort(np.abs(lacks[:, 0]))
    assert (motors[-len(motors) // 10 :] ** 2).sum() > 0.7 * (motors**2).sum()  # in a tenth of the rows
    assert np.sqrt(np.mean(lacks[:, 0] ** 2)) == pytest.approx(scene.strength(law.spot, tracks), rel=1e-9)


def test_what_cannot_be_as_strong_is_refused():
    with pytest.raises(StrengthError, match="out of reach") as told:
        hide(scene_of("pendulum"), "actuator_saturation", "actuator/motor", 5.0, seed=0)
    assert 0.1 < told.value.most < 5.0 and "\n" not in str(told.value)


def slide_to_rest(level, v=1.0, inertia=2.0, push=0.0, h=0.0005, steps=4000):
    bristle, q = Bristle(inertia, h), 0.0
    for _ in range(steps):
        v += h * (push + bristle.pull(v, level, level)) / inertia
        q += h * v
    return q, v


def test_bristles_take_force_times_distance_and_then_hold():
    q, v = slide_to_rest(3.0)
    assert q == pytest.approx(0.5 * 2.0 / 3.0, rel=0.01)
    assert abs(v) < 1e-6
    q, v = slide_to_rest(3.0, v=0.0, push=2.9)
    assert abs(v) < 1e-9 and abs(q) < 1e-4
    assert slide_to_rest(3.0, v=0.0, push=3.3)[1] == pytest.approx(0.3 / 2.0 * 2.0, rel=0.01)


def test_a_third_of_all_dry_friction_is_a_constraint_of_the_solver():
    made_of = [made("slide", "coulomb_friction", "joint/rail", 0.3, seed)[1] for seed in range(60)]
    braked = [law for law in made_of if isinstance(law, ModelLaw)]
    assert 10 < len(braked) < 30 and {law.coulomb for law in made_of} == {made_of[0].coulomb}
    model = build(scene_of("slide").model, braked[:1])
    data = mujoco.MjData(model)
    data.qvel[0] = 1.0
    mujoco.mj_step(model, data, 200)
    assert data.qvel[0] == pytest.approx(1.0 - 200 * model.opt.timestep * made_of[0].coulomb / 5.0, rel=0.02)


def test_what_is_let_go_begins_at_rest():
    spec = mujoco.MjSpec.from_string(RIGS["pivot"].xml)
    scene = make_scene(spec.compile(), np.random.default_rng(0), **SHORT | {"kind": "released"})
    for track in scene.clean:
        assert track.time[0] == track.rows[0] == 0 and track.qvel[0, 0] == 0.0
        assert 0.3 < abs(track.qpos[0, 0]) < 1.3 and np.ptp(track.qpos[:, 0]) > abs(track.qpos[0, 0])


def test_half_of_all_dry_friction_has_a_rounded_sign():
    spot = scene_of("pendulum").spot("joint/hinge")
    widths = [draw_rounding(spot, 0.1, np.random.default_rng(seed)) for seed in range(200)]
    drawn = np.array([w for w in widths if w > 0.0]) / spot.speed
    assert 70 < len(drawn) < 130
    assert drawn.min() >= 0.004 and drawn.max() <= 0.04
    sign = RoundSign(0.1)
    assert sign.pull(10.0, 1.0, 3.0) == pytest.approx(-3.0) and sign.pull(-10.0, 1.0, 3.0) == pytest.approx(1.0)
    assert sign.pull(1e-3, 1.0, 3.0) == pytest.approx(-3.0 * 0.01, rel=1e-3)


def test_friction_takes_no_energy_from_nowhere():
    for name in ("coulomb_friction", "stribeck_friction", "asymmetric_friction", "viscous_friction", "quadratic_drag"):
        drawn = (made("pendulum", name, "joint/hinge", 0.3, seed)[1] for seed in range(20))
        law = next(law for law in drawn if not isinstance(law, ModelLaw))
        law.begin(type("Still", (), {"h": law.spot.h, "state": lambda self, joint: (0.0, 0.0)})(), None)
        rng = np.random.default_rng(0)
        v = np.repeat(rng.normal(0, law.spot.speed, 40), 400)
        power = np.array([law.force(None, 0.0, x) * x for x in v])
        assert power.mean() < 0 and (power[200::400] <= 0).all(), name


def test_a_delay_shifts_the_command_and_a_drop_comes_in_its_time():
    class Still:
        h = 0.0005
        time = 0.0
        data = mujoco.MjData(scene_of("pendulum").model)

    _, law = made("pendulum", "actuator_delay", "actuator/motor", 0.2)
    law.begin(Still, None)
    u = np.sin(20 * np.arange(2000) * Still.h)
    late = np.array([law.command(Still, x) for x in u])
    time = np.arange(2000) * Still.h
    np.testing.assert_allclose(late[400:], np.sin(20 * (time - law.seconds))[400:], atol=1e-4)
    _, drop = made("pendulum", "gain_drop", "actuator/motor", 0.5)
    Still.time = drop.time - 1e-6
    assert drop.command(Still, 2.0) == 2.0
    Still.time = drop.time + 1e-6
    assert drop.command(Still, 2.0) == pytest.approx(2.0 * drop.gain)
    assert 0.0 < drop.gain < 2.0


def test_readings_are_late_scaled_and_shifted():
    time = np.arange(-400, 2000) * 0.0005
    q = np.sin(5 * time)
    _, law = made("pendulum", "sensor_delay", "joint/hinge/qpos", 0.3)
    np.testing.assert_allclose(law.read(time, q, None)[400:], np.sin(5 * (time - law.seconds))[400:], atol=1e-8)
    _, scale = made("pendulum", "sensor_scale", "joint/hinge/qpos", 0.3)
    np.testing.assert_allclose(scale.read(time, q, None), scale.scale * q)
    _, offset = made("pendulum", "sensor_offset", "joint/hinge/qpos", 0.3)
    np.testing.assert_allclose(offset.read(time, q, None) - q, offset.offset)


def test_sensors_leave_the_motion_as_it_is():
    scene, law = made("pendulum", "sensor_scale", "joint/hinge/qpos", 0.3)
    for track, clean in zip(scene.play([law]), scene.clean, strict=True):
        np.testing.assert_array_equal(track.qpos, clean.qpos)
        np.testing.assert_array_equal(track.qvel, clean.qvel)
        assert np.abs(track.shown - clean.shown).max() > 0.05


@pytest.mark.parametrize("rectangle", [False, True])
def test_a_push_hands_over_its_impulse(rectangle):
    drawn = [made("pendulum", "disturbance_event", "joint/hinge", 0.3, seed)[1] for seed in range(10)]
    law = next(law for law in drawn if law.rectangle == rectangle)

    class Now:
        time = 0.0

    total = 0.0
    for Now.time in np.arange(0, law.spot.duration, 1e-4):
        total += 1e-4 * law.force(Now, 0.0, 0.0)
    assert total == pytest.approx(law.impulse, rel=1e-3)


def test_a_payload_is_what_a_body_welded_to_the_link_is():
    scene, law = made("double", "payload", "body/lower", 0.7)
    edited = build(scene.model, [law])
    spec = mujoco.MjSpec.from_string(RIGS["double"].xml)
    load = spec.body("lower").add_body(pos=[0, 0, -law.position])
    load.explicitinertial, load.mass, load.ipos, load.inertia = True, law.mass, [0, 0, 0], [1e-12] * 3
    welded = spec.compile()
    for model in (edited, welded):
        model.opt.timestep = 0.001
    rng = np.random.default_rng(0)
    q, v = rng.normal(size=2), rng.normal(size=2)
    after = []
    for model in (edited, welded):
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:] = q, v
        mujoco.mj_step(model, data, 500)
        after.append(data.qpos.copy())
    np.testing.assert_allclose(*after, atol=1e-5)


def test_the_world_is_finer_than_the_model_and_begins_before_the_recording():
    scene = scene_of("pendulum")
    track = scene.clean[0]
    assert track.time[1] - track.time[0] == pytest.approx(scene.model.opt.timestep / FINE)
    assert track.time[track.rows[0]] == pytest.approx(0.0) and track.rows[0] > 0
    assert (np.diff(track.rows) == 2 * FINE).all()
    assert count_substeps(0.002) == FINE and 0.02 / count_substeps(0.02) == pytest.approx(LONGEST)
