"""Made-up real machines: rigs with hidden parameters and, concealed in them, a physical effect; written as cases.

A world is not the simulator that is diagnosed: MuJoCo's C engine steps it on a finer grid, and the effects
are written out here once more, in NumPy and in force, so that the library is never judged by its own equations. The
recordings hold what a real log would: positions, commands, mostly velocities, sensor noise.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

__all__ = ["CONCEALED", "RIGS", "UNKNOWN", "Rig", "World", "make_case"]

FINE = 4
"""Steps of a world in one of the simulator's."""
ROW = 2
"""Steps of the simulator from one row of a recording to the next."""


@dataclass(frozen=True)
class Rig:
    """A machine: its model, what is uncertain in it, and how it is driven."""

    name: str
    xml: str
    parameters: tuple[tuple[str, str, float, float, str], ...]
    """Name, target, low and high of a uniform prior, unit."""
    drive: tuple[float, ...] = ()
    """Amplitude of every actuator's command."""
    swing: float = 0.5
    """Scatter of initial positions, rad or m."""
    noise: tuple[float, float] = (1e-3, 1e-2)
    """Sensor noise of positions and velocities."""
    horizon: float = 0.5


def _rig(body: str, actuators: str = "", gravity: str = "0 0 -9.81") -> str:
    return (
        f'<mujoco><option timestep="0.002" gravity="{gravity}" integrator="implicitfast"/>'
        f"<worldbody>{body}</worldbody><actuator>{actuators}</actuator></mujoco>"
    )


RIGS = {
    "pendulum": Rig(
        "pendulum",
        _rig(
            '<body name="rod"><joint name="hinge" axis="0 1 0"/>'
            '<inertial pos="0 0 -0.3" mass="0.5" diaginertia="0.004 0.004 0.0005"/></body>',
            '<motor name="motor" joint="hinge" gear="1"/>',
        ),
        (("mass", "body/rod/mass", 0.3, 0.8, "kg"),),
        drive=(1.2,),
        swing=1.5,
    ),
    "swing": Rig(
        "swing",
        _rig(
            '<body name="rod"><joint name="hinge" axis="0 1 0"/>'
            '<inertial pos="0 0 -0.25" mass="0.4" diaginertia="0.004 0.004 0.0005"/></body>'
        ),
        (("com", "body/rod/ipos/2", -0.4, -0.15, "m"),),
        swing=2.0,
        horizon=1.0,
    ),
    "slide": Rig(
        "slide",
        _rig(
            '<body name="carriage"><joint name="rail" type="slide" axis="1 0 0"/>'
            '<inertial pos="0 0 0" mass="5" diaginertia="0.1 0.1 0.1"/></body>',
            '<motor name="motor" joint="rail" gear="1"/>',
        ),
        (("mass", "body/carriage/mass", 3.0, 8.0, "kg"),),
        drive=(12.0,),
        swing=0.05,
        noise=(2e-4, 2e-3),
    ),
    "double": Rig(
        "double",
        _rig(
            '<body name="upper"><joint name="shoulder" axis="0 1 0"/>'
            '<inertial pos="0 0 -0.15" mass="0.6" diaginertia="0.005 0.005 0.0005"/>'
            '<body name="lower" pos="0 0 -0.3"><joint name="elbow" axis="0 1 0"/>'
            '<inertial pos="0 0 -0.15" mass="0.4" diaginertia="0.003 0.003 0.0003"/></body></body>',
            '<motor name="m1" joint="shoulder" gear="1"/><motor name="m2" joint="elbow" gear="1"/>',
        ),
        (("upper_mass", "body/upper/mass", 0.4, 0.9, "kg"), ("lower_mass", "body/lower/mass", 0.25, 0.6, "kg")),
        drive=(1.5, 0.25),
        swing=0.5,
    ),
    "cart": Rig(
        "cart",
        _rig(
            '<body name="cart"><joint name="rail" type="slide" axis="1 0 0"/>'
            '<inertial pos="0 0 0" mass="1" diaginertia="0.01 0.01 0.01"/>'
            '<body name="pole"><joint name="pivot" axis="0 1 0"/>'
            '<inertial pos="0 0 -0.3" mass="0.3" diaginertia="0.005 0.005 0.0005"/></body></body>',
            '<motor name="motor" joint="rail" gear="1"/>',
        ),
        (("cart_mass", "body/cart/mass", 0.6, 1.5, "kg"), ("pole_mass", "body/pole/mass", 0.15, 0.5, "kg")),
        drive=(5.0,),
        swing=0.6,
    ),
}


@dataclass
class World:
    """The machine while it runs; effects change what is between command, force, model and sensor."""

    model: Any
    data: Any
    h: float
    time: float = 0.0
    memory: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Concealed:
    """An effect in a world: how it changes the model, the command, the forces and the sensors."""

    name: str
    model: Callable[[Any, int, float], None] | None = None
    act: Callable[[World, np.ndarray, int, float], np.ndarray] | None = None
    force: Callable[[World, int, float], float] | None = None
    sense: Callable[[World, np.ndarray, np.ndarray, int, float], tuple[np.ndarray, np.ndarray]] | None = None
    strength: float = 1.0
    """Of the joint's own scale: a moderate effect."""
    motor: bool = False
    """Whether it sits at an actuator."""


def _scale(world: World, j: int) -> float:
    """Torque or force that the joint sees: gravity's and the motors', at its largest."""
    return world.memory["scale"][j]


def _speed(world: World, j: int) -> float:
    return world.memory["speed"][j]


def _stribeck(w: World, j: int, s: float) -> float:
    v, level = w.data.qvel[j], 0.05 * s * _scale(w, j)
    edge = 0.08 * _speed(w, j)
    return -level * (1 + 1.2 * np.exp(-((v / edge) ** 2))) * np.tanh(v / (1e-3 * _speed(w, j)))


def _asymmetric(w: World, j: int, s: float) -> float:
    v = w.data.qvel[j]
    level = 0.15 * s * _scale(w, j) * (1.0 if v > 0 else 0.35)
    return -level * np.tanh(v / (1e-3 * _speed(w, j)))


def _coulomb(w: World, j: int, s: float) -> float:
    return -0.1 * s * _scale(w, j) * float(np.tanh(w.data.qvel[j] / (1e-3 * _speed(w, j))))


def _delay(w: World, u: np.ndarray, i: int, s: float) -> np.ndarray:
    line = w.memory.setdefault("line", [])
    line.append(u.copy())
    back = round(0.03 * s / w.h)
    out = u.copy()
    out[i] = line[max(len(line) - 1 - back, 0)][i]
    return out


def _lag(w: World, u: np.ndarray, i: int, s: float) -> np.ndarray:
    a = w.memory.get("lag", u[i])
    a = a + (u[i] - a) * (1 - np.exp(-w.h / (0.05 * s)))
    w.memory["lag"] = a
    out = u.copy()
    out[i] = a
    return out


def _at(i: int, u: np.ndarray, value: float) -> np.ndarray:
    out = u.copy()
    out[i] = value
    return out


def _largest(w: World, i: int) -> float:
    return float(w.memory["drive"][i])


def _armature(model: Any, j: int, s: float) -> None:
    model.dof_armature[j] += 0.35 * s / model.dof_invweight0[j]


def _tilt(model: Any, j: int, s: float) -> None:
    angle = 0.08 * s
    g = np.linalg.norm(model.opt.gravity)
    model.opt.gravity[:] = [g * np.sin(angle), 0, -g * np.cos(angle)]


CONCEALED = {
    "viscous_friction": Concealed(
        "viscous_friction", force=lambda w, j, s: -0.15 * s * _scale(w, j) / _speed(w, j) * w.data.qvel[j]
    ),
    "coulomb_friction": Concealed("coulomb_friction", force=_coulomb),
    "stribeck_friction": Concealed("stribeck_friction", force=_stribeck, strength=1.5),
    "asymmetric_friction": Concealed("asymmetric_friction", force=_asymmetric),
    "quadratic_drag": Concealed(
        "quadratic_drag",
        force=lambda w, j, s: -0.3 * s * _scale(w, j) / _speed(w, j) ** 2 * w.data.qvel[j] * abs(w.data.qvel[j]),
    ),
    "joint_spring": Concealed("joint_spring", force=lambda w, j, s: -0.3 * s * _scale(w, j) * (w.data.qpos[j] - 0.1)),
    "torque_ripple": Concealed(
        "torque_ripple", force=lambda w, j, s: 0.12 * s * _scale(w, j) * np.sin(6 * w.data.qpos[j] + 0.7)
    ),
    "armature": Concealed("armature", model=_armature),
    "base_tilt": Concealed("base_tilt", model=_tilt),
    "actuator_gain": Concealed("actuator_gain", act=lambda w, u, i, s: _at(i, u, u[i] * (1 - 0.25 * s)), motor=True),
    "actuator_bias": Concealed(
        "actuator_bias", act=lambda w, u, i, s: _at(i, u, u[i] + 0.15 * s * _largest(w, i)), motor=True
    ),
    "actuator_delay": Concealed("actuator_delay", act=_delay, motor=True),
    "actuator_lag": Concealed("actuator_lag", act=_lag, motor=True),
    "actuator_saturation": Concealed(
        "actuator_saturation",
        act=lambda w, u, i, s: _at(i, u, float(np.clip(u[i], -0.6 * _largest(w, i) / s, 0.6 * _largest(w, i) / s))),
        motor=True,
    ),
    "actuator_deadband": Concealed(
        "actuator_deadband",
        act=lambda w, u, i, s: _at(i, u, float(np.sign(u[i]) * max(abs(u[i]) - 0.15 * s * _largest(w, i), 0.0))),
        motor=True,
    ),
    "gain_drop": Concealed(
        "gain_drop", act=lambda w, u, i, s: _at(i, u, u[i] * (1 - 0.4 * s * (w.time > 2.0))), motor=True
    ),
    "sensor_scale": Concealed("sensor_scale", sense=lambda w, q, v, j, s: (_at(j, q, q[j] * (1 + 0.1 * s)), v)),
}
"""What the library can name."""


def _spots(w: World, j: int, s: float) -> float:
    """Friction that grips in places: no effect of the library depends on position and direction together."""
    grip = 0.3 * s * _scale(w, j) * np.exp(-(((w.data.qpos[j] % 1.0) - 0.5) ** 2) / 0.02)
    return -grip * float(np.tanh(w.data.qvel[j] / (2e-2 * _speed(w, j))))


def _beat(w: World, j: int, s: float) -> float:
    """A force with a rhythm of its own."""
    return 0.15 * s * _scale(w, j) * float(np.sign(np.sin(2 * np.pi * 1.7 * w.time)))


def _tired(w: World, j: int, s: float) -> float:
    """A damper that softens with use and recovers at rest."""
    heat = w.memory.get("heat", 0.0)
    v = w.data.qvel[j]
    heat += w.h * ((v / _speed(w, j)) ** 2 - 0.3 * heat)
    w.memory["heat"] = heat
    return (
        0.25 * s * _scale(w, j) * heat * v / _speed(w, j) / (1 + heat)
        - 0.2 * s * _scale(w, j) * v**3 / _speed(w, j) ** 3
    )


UNKNOWN = {
    "spots": Concealed("spots", force=_spots),
    "beat": Concealed("beat", force=_beat),
    "tired": Concealed("tired", force=_tired),
}
"""What it cannot."""


def _commands(rng: np.random.Generator, rig: Rig, rows: int, dt: float) -> np.ndarray:
    """Sums of a few sines, with a stretch without command at the end."""
    time = np.arange(rows) * dt
    u = np.zeros((rows, len(rig.drive)))
    for i, amplitude in enumerate(rig.drive):
        for _ in range(3):
            u[:, i] += np.sin(2 * np.pi * rng.uniform(0.2, 1.6) * time + rng.uniform(0, 2 * np.pi)) / 2
        u[:, i] = amplitude * np.clip(u[:, i], -1, 1)
        u[int(0.85 * rows) :, i] = 0.0
    return u


def _run(
    rig: Rig,
    model: Any,
    concealed: Concealed | None,
    place: int,
    strength: float,
    rng: np.random.Generator,
    rows: int,
    dt: float,
    scales: tuple[np.ndarray, np.ndarray],
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    data = mujoco.MjData(model)
    u = _commands(rng, rig, rows, dt)
    data.qpos[:] = rng.uniform(-rig.swing, rig.swing, model.nq)
    world = World(model, data, model.opt.timestep)
    world.memory |= {"scale": scales[0], "speed": scales[1], "drive": np.array(rig.drive)}
    qpos, qvel = np.zeros((rows, model.nq)), np.zeros((rows, model.nv))
    for row in range(rows):
        q, v = data.qpos.copy(), data.qvel.copy()
        if concealed is not None and concealed.sense:
            q, v = concealed.sense(world, q, v, place, strength)
        qpos[row], qvel[row] = q, v
        for _ in range(FINE * ROW):
            command = u[row].copy()
            if concealed is not None and concealed.act:
                command = concealed.act(world, command, place, strength)
            data.ctrl[:] = command
            data.qfrc_applied[:] = 0.0
            if concealed is not None and concealed.force:
                data.qfrc_applied[place] = concealed.force(world, place, strength)
            mujoco.mj_step(model, data)
            world.time += world.h
    return qpos, qvel, u


@functools.cache
def _scales(name: str) -> tuple[np.ndarray, np.ndarray]:
    """Force and speed of every joint of a rig in ordinary motion."""
    rig = RIGS[name]
    model = mujoco.MjModel.from_xml_string(rig.xml)
    dt = model.opt.timestep
    model.opt.timestep = dt / FINE
    rng = np.random.default_rng(0)
    force, speed = [], []
    for _ in range(4):
        qpos, qvel, u = _run(rig, model, None, 0, 0.0, rng, 400, ROW * dt, (np.ones(model.nv), np.ones(model.nv)))
        data = mujoco.MjData(model)
        for row in range(0, 400, 10):
            data.qpos[:], data.qvel[:] = qpos[row], qvel[row]
            data.ctrl[:] = u[row]
            mujoco.mj_forward(model, data)
            force.append(np.abs(data.qfrc_actuator) + np.abs(data.qfrc_bias))
            speed.append(np.abs(data.qvel))
    return np.quantile(force, 0.9, axis=0), np.quantile(speed, 0.9, axis=0)


def make_case(
    folder: Path,
    rig: str,
    effect: str | None = None,
    *,
    place: int = 0,
    strength: float = 1.0,
    seed: int = 0,
    recordings: int = 6,
    seconds: float = 4.0,
    velocities: bool = True,
    noise: float = 1.0,
) -> dict[str, float]:
    """Write a case whose recordings come from a world; returns the hidden parameters.

    `effect` is one of `CONCEALED` or `UNKNOWN`, or None for a clean machine; `place` the joint or actuator that it
    sits at, and `strength` multiplies a moderate one.
    """
    about, rng = RIGS[rig], np.random.default_rng(seed)
    concealed = (CONCEALED | UNKNOWN)[effect] if effect else None
    spec = mujoco.MjSpec.from_string(about.xml)
    naive = spec.compile()
    dt = naive.opt.timestep
    truth = {}
    for name, target, low, high, _ in about.parameters:
        value = float(rng.uniform(low + 0.15 * (high - low), high - 0.15 * (high - low)))
        truth[name] = value
        _, element, what, *index = target.split("/")
        body = spec.body(element)
        if what == "mass":
            body.inertia = np.array(body.inertia) * value / body.mass
            body.mass = value
        else:
            ipos = np.array(body.ipos)
            ipos[int(index[0])] = value
            body.ipos = ipos
    model = spec.compile()
    model.opt.timestep = dt / FINE
    if concealed is not None and concealed.model:
        concealed.model(model, place, strength * concealed.strength)
        mujoco.mj_setConst(model, mujoco.MjData(model))
    (folder / "recordings").mkdir(parents=True, exist_ok=True)
    (folder / "model.xml").write_text(about.xml, encoding="utf-8")
    lines = ["schema = 1", f'name = "{folder.name}"', 'model = "model.xml"', 'recordings = "recordings/*.csv"']
    lines.append(f"horizon = {about.horizon}")
    for name, target, low, high, unit in about.parameters:
        lines += ["", "[[parameters]]", f'name = "{name}"', f'unit = "{unit}"', f'targets = ["{target}"]']
        lines.append(f'prior = {{ distribution = "uniform", low = {low}, high = {high} }}')
    (folder / "case.toml").write_text("\n".join(lines) + "\n", encoding="utf-8")
    rows = int(seconds / (ROW * dt))
    joints = [model.joint(i).name for i in range(model.njnt)]
    motors = [model.actuator(i).name for i in range(model.nu)]
    header = ["time", *(f"joint/{j}/qpos" for j in joints)]
    header += [f"joint/{j}/qvel" for j in joints] if velocities else []
    header += [f"actuator/{m}/ctrl" for m in motors]
    factor = strength * (concealed.strength if concealed else 1.0)
    for k in range(recordings):
        qpos, qvel, u = _run(about, model, concealed, place, factor, rng, rows, ROW * dt, _scales(rig))
        qpos = qpos + noise * about.noise[0] * rng.standard_normal(qpos.shape)
        qvel = qvel + noise * about.noise[1] * rng.standard_normal(qvel.shape)
        table = np.column_stack([np.arange(rows) * ROW * dt, qpos, *([qvel] if velocities else []), u])
        path = folder / "recordings" / f"run{k + 1}.csv"
        np.savetxt(path, table, delimiter=",", header=",".join(header), comments="", fmt="%.8g")
    return truth
