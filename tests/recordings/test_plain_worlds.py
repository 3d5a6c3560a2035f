"""Machines simulated as a stranger would: MuJoCo in a loop, textbook laws, recordings that begin with the motion."""

import jax
import mujoco
import numpy as np
import pytest

from bayessim_jax.diagnosis.belief import moments_of_effects
from bayessim_jax.recordings.diagnosing import diagnose_case
from bayessim_jax.recordings.evaluation import BEFORE
from bayessim_jax.recordings.loading import load_case
from bayessim_jax.recordings.shots import case_model
from tests.recordings.made_up_case import CASE, write_case

STEP, RATE, SECONDS, RECORDINGS = 2e-4, 100, 4.0, 6
MODEL = """
<mujoco><option timestep="0.005"/>
<worldbody><geom name="floor" type="plane" size="1 1 .1"/>
<body name="rod" pos="0 0 1"><joint name="hinge" type="hinge" axis="0 1 0" damping="0.02"/>
<geom name="stick" type="capsule" fromto="0 0 0 0 0 -.5" size=".02" mass="0.6"/></body></worldbody>
<actuator><motor name="motor" joint="hinge" gear="2" ctrlrange="-1 1" ctrllimited="true"/></actuator></mujoco>
"""
HEAVIER = CASE.replace("bob", "rod").replace("low = 0.15, high = 0.6", "low = 0.3, high = 1.2")
COLUMNS = ("time", "joint/hinge/qpos", "joint/hinge/qvel", "actuator/motor/ctrl")


@pytest.fixture(autouse=True, scope="module")
def _in_float64():
    jax.config.update("jax_enable_x64", True)
    yield
    jax.config.update("jax_enable_x64", False)


def smooth_sign(width):
    return lambda q, v, t: -0.25 * v / np.hypot(v, width)


def falling_friction_and_spring(q, v, t):
    return -(0.15 + 0.2 * np.exp(-((v / 0.6) ** 2))) * np.tanh(v / 0.02) - 1.0 * (q + 0.3)


def push(q, v, t):
    return 1.5 if 1.2 < t < 1.6 else 0.0


def square_wave(q, v, t):
    return 0.3 * np.sign(np.sin(2.0 * np.pi * 0.7 * t + 1.0))


class Late:
    """A command that arrives 25 ms late; before the recording there was none."""

    def begin(self):
        self.queue = [0.0] * round(0.025 / STEP)

    def __call__(self, command, q, v):
        self.queue.append(command)
        return self.queue.pop(0), 0.0


class Slow:
    """A command that arrives through a first-order lag of 60 ms, which begins at 0."""

    def begin(self):
        self.arrived = 0.0

    def __call__(self, command, q, v):
        self.arrived += (command - self.arrived) * STEP / 0.06
        return self.arrived, 0.0


class Gap:
    """A rotor between two elastic stops; the joint feels the stops and not the motor."""

    def begin(self):
        self.angle = self.speed = None

    def __call__(self, command, q, v):
        if self.angle is None:
            self.angle, self.speed = q, v
        away = self.angle - q
        depth = np.sign(away) * max(abs(away) - 0.04, 0.0)
        force = 1000.0 * depth + (3.0 * (self.speed - v) if depth else 0.0)
        self.speed += STEP * (2.0 * command - force) / 0.01
        self.angle += STEP * self.speed
        return 0.0, force


def write_world(folder, law=None, motor=None, seed=0, frictionloss=0.0, damping=0.0, velocities=True):
    """Six recordings of sines and steps, with noise of 1 mrad and 10 mrad/s."""
    rng = np.random.default_rng(seed)
    model = mujoco.MjModel.from_xml_string(MODEL)
    model.dof_frictionloss[0] = frictionloss
    model.dof_damping[0] += damping
    model.opt.timestep = STEP
    model.body_mass[1] *= 1.2
    model.body_inertia[1] *= 1.2
    recordings = {}
    hold, data = round(1.0 / RATE / STEP), mujoco.MjData(model)
    for k in range(RECORDINGS):
        time = np.arange(round(SECONDS * RATE)) / RATE
        waves = [np.sin(2.0 * np.pi * (f * time + rng.uniform())) for f in rng.uniform(0.3, 2.0, 4)]
        signal = np.sign(waves[0]) if k % 3 == 2 else sum(waves) / 2.0
        ctrl = np.clip(rng.uniform(0.3, 0.45) * signal, -1.0, 1.0)
        mujoco.mj_resetData(model, data)
        data.qpos[0] = rng.uniform(-0.5, 0.5)
        if motor:
            motor.begin()
        rows = []
        for step in range(len(time) * hold):
            q, v, command = data.qpos[0], data.qvel[0], ctrl[step // hold]
            if step % hold == 0:
                rows.append((q, v))
            data.ctrl[0], force = motor(command, q, v) if motor else (command, 0.0)
            data.qfrc_applied[0] = force + (law(q, v, step * STEP) if law else 0.0)
            mujoco.mj_step(model, data)
        q, v = np.array(rows).T
        seen = [time, q + 1e-3 * rng.normal(size=len(q)), v + 1e-2 * rng.normal(size=len(v)), ctrl]
        recordings[f"run{k + 1}"] = dict(zip(COLUMNS, seen, strict=True))
        if not velocities:
            del recordings[f"run{k + 1}"]["joint/hinge/qvel"]
    return write_case(folder, HEAVIER, MODEL, **recordings)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("law", "motor", "wanted"),
    [
        (smooth_sign(0.05), None, "coulomb_friction@joint/hinge"),
        (falling_friction_and_spring, None, "joint_spring@joint/hinge stribeck_friction@joint/hinge"),
        (push, None, "disturbance_event@joint/hinge"),
        (None, Late(), "actuator_delay@actuator/motor"),
        (None, Slow(), "actuator_lag@actuator/motor"),
        (None, Gap(), "backlash@actuator/motor"),
        (square_wave, None, ""),
    ],
)
def test_textbook_laws_get_their_names(tmp_path, law, motor, wanted):
    """The empty name stands for what is in no library."""
    model = case_model(load_case(write_world(tmp_path / "plain", law, motor)).check(), before=BEFORE)
    assert model.engine_name == "tree"  # nothing reaches the floor
    table = diagnose_case(jax.random.key(0), model).table()
    if not wanted:
        assert table["verdict"] == "unexplained"
        return
    assert table["verdict"] == "explained"
    assert sorted(f"{e['effect']}@{e['at']}" for e in table["effects"]) == wanted.split()
    mass = table["parameters"]["rod_mass"]["augmented"]
    assert mass["mean"] == pytest.approx(0.72, rel=0.02)
    assert table["fit"]["augmented"]["nrmse"] < 3.0 * table["fit"]["noise_floor"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("world", "wanted", "parameter", "level"),
    [
        ({"frictionloss": 0.25}, "coulomb_friction", "coulomb", 0.25),
        ({"frictionloss": 0.25, "velocities": False}, "coulomb_friction", "coulomb", 0.25),
        ({"damping": 0.1, "velocities": False}, "viscous_friction", "viscous", 0.1),
    ],
)
def test_what_the_model_itself_can_say_gets_its_name_and_number(tmp_path, world, wanted, parameter, level):
    """MuJoCo's own friction is a constraint; without velocities, damping and the time step look alike."""
    model = case_model(load_case(write_world(tmp_path / "plain", **world)).check(), before=BEFORE)
    result = diagnose_case(jax.random.key(0), model)
    name = f"{wanted}@joint/hinge"
    answers = [entry.names for entry in result.result.confusion]
    assert [name] in answers
    # what brakes in proportion to the speed may be the motor, which is always on
    assert answers == [[name]] or (wanted == "viscous_friction" and ["back_emf@actuator/motor"] in answers)
    found = result.result.confusion[answers.index([name])]
    means, _ = moments_of_effects(result.bench, found)
    assert means[f"{name}/{parameter}"] == pytest.approx(level, rel=0.03)
