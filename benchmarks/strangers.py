"""Machines simulated as a stranger would: MuJoCo in a loop, textbook laws, whatever rate, time step and integrator.

Nothing is shared with `bayessim conceal`: neither machines nor laws, motions or noise.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np
from jaxtyping import Float

from bayessim_jax.concealment import UNKNOWN
from benchmarks.concealed import ONE_LAW, diagnose_all
from benchmarks.textbook import COMMANDS, EDITS, ELASTIC, FORCES, GRAVITY, Law, Moment, Spot

if TYPE_CHECKING:
    from argparse import Namespace
    from pathlib import Path

__all__ = ["MACHINES", "READINGS", "diagnose_strangers", "draw_strangers", "make_stranger"]

GROUPS = {"single": 0.5, "pair": 0.15, "unknown": 0.2, "clean": 0.15}
"""Shares of the machines: one effect, two, one of no library, none."""
STEP, INTEGRATOR = 5e-4, "implicitfast"
"""s, the longest time step of a machine, and how it is stepped."""


@dataclass(frozen=True)
class Machine:
    """What is simulated, and how large things are there."""

    bodies: str
    """MJCF of what hangs in the world."""
    joints: tuple[str, ...]
    motors: tuple[str, ...]
    """Of the first joints."""
    body: str
    """The last one, whose mass is unknown."""
    forces: tuple[float, ...]
    """Of each joint: what drives it, or weighs on it."""
    speeds: tuple[float, ...]
    reach: float
    """rad or m that the first joint is to move to each side."""
    weight: float = 0.0
    """What the first motor has to hold."""

    def mjcf(self, integrator: str, timestep: float) -> str:
        """The model as its user believes it."""
        motors = "".join(f'<motor name="{m}" joint="{j}"/>' for m, j in zip(self.motors, self.joints, strict=False))
        return (
            f'<mujoco><compiler angle="radian"/><option timestep="{timestep}" integrator="{integrator}"/>'
            f"<worldbody>{self.bodies}</worldbody><actuator>{motors}</actuator></mujoco>"
        )


def _log(rng: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def _body(name: str, joint: str, inside: str, place: str = "0 0 0") -> str:
    return f'<body name="{name}" pos="{place}"><joint name="{joint}" {inside}</body>'


def _rod(length: float, mass: float) -> str:
    size = f'size="0.02" mass="{mass}" contype="0" conaffinity="0"'
    return f'<geom type="capsule" fromto="0 0 0 0 0 {-length}" {size}/>'


def _box(mass: float) -> str:
    return f'<geom type="box" size="0.1 0.1 0.1" mass="{mass}" contype="0" conaffinity="0"/>'


HINGE, SLIDE, LIFT = ('type="hinge" axis="0 1 0"/>', 'type="slide" axis="1 0 0"/>', 'type="slide" axis="0 0 1"/>')


def _pendulum(rng: np.random.Generator) -> Machine:
    length, mass = _log(rng, 0.2, 0.8), _log(rng, 0.2, 2.0)
    force = 0.4 * mass * GRAVITY * length
    bodies = _body("bar", "hinge", HINGE + _rod(length, mass))
    return Machine(bodies, ("hinge",), ("motor",), "bar", (force,), (3.0,), 0.8)


def _carriage(rng: np.random.Generator) -> Machine:
    mass = _log(rng, 0.5, 5.0)
    return Machine(_body("cart", "rail", SLIDE + _box(mass)), ("rail",), ("drive",), "cart", (2.0 * mass,), (1.0,), 0.3)


def _lift(rng: np.random.Generator) -> Machine:
    mass = _log(rng, 1.0, 6.0)
    bodies = _body("car", "lift", LIFT + _box(mass))
    return Machine(bodies, ("lift",), ("winch",), "car", (3.0 * mass,), (1.0,), 0.3, weight=mass * GRAVITY)


def _crane(rng: np.random.Generator) -> Machine:
    mass, load, length = _log(rng, 0.5, 3.0), _log(rng, 0.05, 0.5), _log(rng, 0.2, 0.6)
    bodies = _body("cart", "rail", SLIDE + _box(mass) + _body("pole", "pivot", HINGE + _rod(length, load)))
    forces = 2.5 * (mass + load), 0.2 * load * GRAVITY
    return Machine(bodies, ("rail", "pivot"), ("drive",), "pole", forces, (1.0, 4.0), 0.3)


def _arm(rng: np.random.Generator) -> Machine:
    upper, fore, m1, m2 = _log(rng, 0.2, 0.5), _log(rng, 0.2, 0.5), _log(rng, 0.5, 2.0), _log(rng, 0.2, 1.0)
    inner = _body("fore", "elbow", HINGE + _rod(fore, m2), f"0 0 {-upper}")
    bodies = _body("upper", "shoulder", HINGE + _rod(upper, m1) + inner)
    forces = 0.7 * GRAVITY * (m1 * upper / 2 + m2 * (upper + fore / 2)), 0.4 * GRAVITY * m2 * fore
    return Machine(bodies, ("shoulder", "elbow"), ("m1", "m2"), "fore", forces, (3.0, 3.0), 0.8)


MACHINES = {"pendulum": _pendulum, "carriage": _carriage, "lift": _lift, "crane": _crane, "arm": _arm}


READINGS = ("sensor_offset", "sensor_scale", "sensor_delay")
ALIKE = (
    *ONE_LAW,
    {"coulomb_friction", "stribeck_friction", "asymmetric_friction", "load_dependent_friction", "lugre_friction"},
    {"lugre_friction", "hysteresis"},
    {"actuator_delay", "actuator_lag", "actuator_rate_limit", "sensor_delay"},
    {"actuator_gain", "gain_drift", "gain_drop", "actuator_saturation"},
    {"joint_flexibility", "backlash", "armature"},
)
"""Effects of which two are not drawn together: they are one of them, or a third, with other numbers."""
ONE_SLIDE = {"base_tilt", "payload", "link_offset", "sensor_offset", "joint_coupling"}
NOT_SEEN = {
    "pendulum": {"joint_coupling"},
    "carriage": {*ONE_SLIDE, "armature", "actuator_gain"},
    "lift": {*ONE_SLIDE, "actuator_saturation", "backlash"},
}
"""What is nothing on a machine, or another mass; a lift's motor can hold its weight, which closes every gap."""


def diagnose_strangers(options: Namespace) -> None:
    """Diagnose the cases that are not in the file yet, and print what became of all."""
    diagnose_all(draw_strangers(options.cases, options.seed), options, make_stranger)


def draw_strangers(count: int, seed: int) -> list[dict[str, Any]]:
    """A stated random set of machines."""
    return [_draw(seed * 100_000 + k) for k in range(count)]


def _draw(seed: int) -> dict[str, Any]:
    rng = np.random.default_rng(seed)
    group = str(rng.choice(list(GROUPS), p=list(GROUPS.values())))
    rig = str(rng.choice(list(MACHINES)))
    known = [*EDITS, *COMMANDS, *READINGS, *(name for name in FORCES if not name.startswith(UNKNOWN))]
    names = [name for name in known if name not in NOT_SEEN.get(rig, ())]
    if group == "unknown":
        names = [name for name in FORCES if name.startswith(UNKNOWN)]
    effects = [str(rng.choice(names))] if group != "clean" else []
    if group == "pair":
        alike = set(effects).union(*(law for law in ALIKE if effects[0] in law))
        effects.append(str(rng.choice([name for name in names if name not in alike])))
    apart = {"viscous_friction", "back_emf"}.isdisjoint(effects)
    return {
        "rig": rig,
        "group": group,
        "effects": effects,
        "damped": apart and bool(rng.uniform() < 0.4),
        "size": round(float(rng.uniform(0.2, 0.5)), 3),
        "rate": int(rng.choice([50, 60, 100, 125, 200, 250, 500, 1000])),
        "seconds": float(rng.choice([4.0, 6.0, 8.0, 10.0])),
        "recordings": int(rng.choice([5, 6, 8])),
        "velocities": bool(rng.uniform() < 0.5),
        "motion": str(rng.choice(["sines", "steps", "noise", "chirp"])),
        "feedback": rig == "lift" or bool(rng.uniform() < 0.5),
        "noise": float(rng.choice([1e-4, 3e-4, 1e-3, 3e-3])),
        "jitter": float(rng.choice([0.0, 0.0, 0.0, 0.1])),
        "integrator": str(rng.choice(["Euler", "RK4", "implicitfast"])),
        "timestep": float(rng.choice([0.001, 0.002, 0.005])),
        "filter": float(rng.choice([0.0, 0.0, 0.005, 0.02])),
        "seed": seed,
    }


def _signal(motion: str, time: Float[np.ndarray, " rows"], rng: np.random.Generator) -> Float[np.ndarray, " rows"]:
    """What a joint is to follow, or its motor to exert, about 1 in size."""
    if motion == "steps":
        return rng.uniform(-1.0, 1.0, int(time[-1] / 0.4) + 1)[(time / 0.4).astype(int)]
    if motion == "chirp":
        return np.sin(2.0 * np.pi * (0.2 * time + 0.9 * time**2 / time[-1]) + rng.uniform(0.0, 6.28))
    count, high = (3, 1.5) if motion == "sines" else (30, 2.0)
    waves = np.sin(2.0 * np.pi * np.outer(rng.uniform(0.2, high, count), time) + rng.uniform(0.0, 6.28, (count, 1)))
    return 1.4 * rng.dirichlet(np.full(count, 2.0)) @ waves * (1.0 if count == 3 else 2.0)


def make_stranger(folder: Path, case: dict[str, Any]) -> dict[str, Any]:
    """Write a case that was drawn; returns what is hidden in it."""
    build, hide, move = np.random.default_rng(case["seed"] + 1).spawn(3)
    machine = MACHINES[case["rig"]](build)
    model = mujoco.MjModel.from_xml_string(machine.mjcf(INTEGRATOR, STEP))
    body = model.body(machine.body).id
    believed, factor = float(model.body_mass[body]), build.uniform(0.85, 1.2)
    model.body_mass[body] *= factor
    model.body_inertia[body] *= factor
    unknown = [(f"{machine.body}_mass", f"body/{machine.body}/mass", 0.5 * believed, 2.0 * believed)]
    truth = {unknown[0][0]: float(model.body_mass[body])}
    for j, known in enumerate(machine.joints if case["damped"] else ()):
        damping = build.uniform(0.05, 0.3) * machine.forces[j] / machine.speeds[j]
        model.dof_damping[j], truth[f"{known}_damping"] = damping, damping
        unknown.append((f"{known}_damping", f"joint/{known}/damping", 0.0, 4.0 * damping))
    spots = [(name, _spot(name, machine, model, case, hide)) for name in case["effects"]]
    for name, spot in spots:
        if name in EDITS:
            EDITS[name](model, spot, hide)
    mujoco.mj_setConst(model, mujoco.MjData(model))
    forces = [(spot.joint, FORCES[name](spot, hide)) for name, spot in spots if name in FORCES]
    commanded = sorted((each for each in spots if each[0] in COMMANDS), key=lambda each: each[0] in ELASTIC)
    motors = [(spot.joint, COMMANDS[name](spot, hide)) for name, spot in commanded]
    offset, scaled = machine.reach * hide.uniform(0.05, 0.2), 1.0 + 0.3 * case["size"]
    late = max(1, round(0.02 * case["rate"]))
    (folder / "recordings").mkdir(parents=True)
    for k in range(case["recordings"]):
        laws = [[(j, begin()) for j, begin in each] for each in (motors, forces)]
        q, v, ctrl = _record(model, machine, case, laws[0], laws[1], move)
        for name, spot in spots:
            if name == "sensor_delay":
                q[:, spot.joint] = np.concatenate([np.full(late, q[0, spot.joint]), q[:-late, spot.joint]])
            if name == "sensor_offset":
                q[:, spot.joint] += offset
            if name == "sensor_scale":
                q[:, spot.joint] *= scaled
        _write_recording(folder / "recordings" / f"run{k + 1}.csv", machine, case, q, v, ctrl, move)
    (folder / "model.xml").write_text(machine.mjcf(case["integrator"], case["timestep"]), encoding="utf-8")
    lines = [
        "schema = 1",
        f'name = "stranger-{case["seed"]}"',
        'model = "model.xml"',
        'recordings = "recordings/*.csv"',
    ]
    for parameter, target, low, high in unknown:
        prior = f'{{ distribution = "uniform", low = {low!r}, high = {high!r} }}'
        lines += ["", "[[parameters]]", f'name = "{parameter}"', f'targets = ["{target}"]', f"prior = {prior}"]
    (folder / "case.toml").write_text("\n".join(lines) + "\n", encoding="utf-8")
    return {"effects": [_sealed(name, machine, spot) for name, spot in spots], "parameters": truth}


def _spot(name: str, machine: Machine, model: mujoco.MjModel, case: dict[str, Any], rng: np.random.Generator) -> Spot:
    """Where an effect is, at random."""
    driven = name in COMMANDS or name == "load_dependent_friction"
    joint = int(rng.integers(len(machine.motors if driven else machine.joints)))
    if name == "sensor_offset":
        joint = len(machine.joints) - 1  # where a rail begins is nobody's business
    data, inertia = mujoco.MjData(model), np.zeros((model.nv, model.nv))
    mujoco.mj_forward(model, data)
    mujoco.mj_fullM(model, data, inertia)
    scale = machine.forces[joint], machine.speeds[joint], machine.reach
    return Spot(joint, case["size"], *scale, case["seconds"], float(inertia[joint, joint]))


def _sealed(name: str, machine: Machine, spot: Spot) -> dict[str, Any]:
    """What is hidden."""
    place, moved = _place(name, machine, spot.joint)
    return {"effect": name, "at": place, "joint": moved, "strength": {"measured": spot.size}, "parameters": {}}


def _place(name: str, machine: Machine, joint: int) -> tuple[str, str | None]:
    """Where an effect is, and the joint that it is at, if it is at one."""
    at = f"joint/{machine.joints[joint]}"
    if name == "base_tilt":
        return "world", None
    if name in ("payload", "link_offset"):
        return f"body/{machine.body}", None
    if name in COMMANDS and name != "joint_flexibility":
        return f"actuator/{machine.motors[joint]}", at
    return f"{at}/qpos" if name in READINGS else at, at


def _record(
    model: mujoco.MjModel,
    machine: Machine,
    case: dict[str, Any],
    motors: list[tuple[int, Law]],
    forces: list[tuple[int, Law]],
    rng: np.random.Generator,
) -> tuple[Float[np.ndarray, "rows nq"], Float[np.ndarray, "rows nv"], Float[np.ndarray, "rows nu"]]:
    """One recording: what the machine did, its velocities behind the sensors' filter, and what its motors were told."""
    period = 1.0 / case["rate"]
    held = max(1, math.ceil(period / STEP - 1e-9))
    model.opt.timestep = period / held
    time = period * np.arange(int(case["seconds"] * case["rate"]))
    wanted = np.stack([_signal(case["motion"], time, rng) for _ in machine.motors], 1)
    data, count = mujoco.MjData(model), len(machine.motors)
    data.qpos[:] = 0.7 * machine.reach * rng.uniform(-1.0, 1.0, model.nq)
    usual = np.array(machine.forces[:count])
    stiff = 3.0 * usual / machine.reach
    q, v, ctrl = np.zeros((len(time), model.nq)), np.zeros((len(time), model.nv)), np.zeros(wanted.shape)
    filtered = np.zeros(model.nv)
    share = 1.0 - math.exp(-model.opt.timestep / case["filter"]) if case["filter"] else 1.0
    for i in range(len(time)):
        q[i], v[i] = data.qpos, filtered
        place, rate = q[i, :count], data.qvel[:count]
        if case["feedback"]:
            error = machine.reach * wanted[i] - place - 0.12 * rate
            ctrl[i] = np.clip(stiff * error, -4.0 * usual, 4.0 * usual)
        else:
            ctrl[i] = usual * wanted[i]
        if not case["feedback"] and machine.joints[0] == "rail":
            ctrl[i, 0] -= usual[0] * (place[0] + 0.3 * rate[0])
        ctrl[i, 0] += machine.weight
        for _ in range(held):
            data.ctrl[:] = ctrl[i]
            for j, law in motors:
                data.ctrl[j] = law(_moment(model, data, j))
            data.qfrc_applied[:] = 0.0
            for j, law in forces:
                data.qfrc_applied[j] += law(_moment(model, data, j))
            mujoco.mj_step(model, data)
            filtered += share * (data.qvel - filtered)
    return q, v, ctrl


def _moment(model: mujoco.MjModel, data: mujoco.MjData, joint: int) -> Moment:
    """What there is to be known of a joint; motors are those of the first joints."""
    other = 1 - joint if model.nv > 1 else joint
    u = float(data.ctrl[joint]) if joint < model.nu else 0.0
    now = float(data.qpos[joint]), float(data.qvel[joint]), data.time, model.opt.timestep
    return Moment(u, *now, (float(data.qpos[other]), float(data.qvel[other])))


def _write_recording(
    path: Path,
    machine: Machine,
    case: dict[str, Any],
    q: Float[np.ndarray, "rows nq"],
    v: Float[np.ndarray, "rows nv"],
    ctrl: Float[np.ndarray, "rows nu"],
    rng: np.random.Generator,
) -> None:
    """What sensors showed of it, with their noise; velocities have twenty times as much as positions."""
    period = 1.0 / case["rate"]
    time = period * (np.arange(len(q)) + case["jitter"] * rng.uniform(-0.5, 0.5, len(q)))
    names = ["time", *(f"joint/{joint}/qpos" for joint in machine.joints)]
    columns = [time[:, None], q + case["noise"] * rng.normal(size=q.shape)]
    if case["velocities"]:
        names += [f"joint/{joint}/qvel" for joint in machine.joints]
        columns.append(v + 20.0 * case["noise"] * rng.normal(size=v.shape))
    names += [f"actuator/{motor}/ctrl" for motor in machine.motors]
    table = np.concatenate([*columns, ctrl], 1)
    np.savetxt(path, table, fmt="%.9g", delimiter=",", header=",".join(names), comments="")
