"""What a parameter path names in a MuJoCo model: `kind/name/field`, each a few numbers that are linear in θ."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

__all__ = ["Write", "find_writes", "infers_inertia", "merge_writes", "write_into"]


@dataclass(frozen=True)
class Write:
    """One number of the model: `field[index] = factor · θ[parameter]`."""

    field: str
    """Field of `mjModel`, or `gravity`."""
    index: tuple[int, ...]
    factor: float
    parameter: int
    follows: bool = False
    """Whether it only follows what the path names, as inertia follows mass: a path that names it goes first."""


OBJECTS = {
    "body": mujoco.mjtObj.mjOBJ_BODY,
    "joint": mujoco.mjtObj.mjOBJ_JOINT,
    "geom": mujoco.mjtObj.mjOBJ_GEOM,
    "actuator": mujoco.mjtObj.mjOBJ_ACTUATOR,
}
VECTORS = {
    ("body", "ipos"): ("body_ipos", 3),
    ("body", "pos"): ("body_pos", 3),
    ("body", "inertia"): ("body_inertia", 3),
    ("geom", "friction"): ("geom_friction", 3),
    ("geom", "size"): ("geom_size", 3),
    ("actuator", "gear"): ("actuator_gear", 6),
}
"""Fields with components, `kind/name/field/k`: where they lie, and how many there are."""

DEGREES_OF_FREEDOM = {"damping": "dof_damping", "armature": "dof_armature", "frictionloss": "dof_frictionloss"}


def find_writes(model: mujoco.MjModel, paths: Sequence[str], parameter: int) -> list[Write]:
    """What a parameter writes, θ[parameter] in the units of the compiled model (m, kg, rad), or `ValueError`."""
    return [write for path in paths for write in _path_writes(model, path, parameter)]


def merge_writes(parameters: Sequence[Sequence[Write]]) -> tuple[Write, ...]:
    """All writes of a model: each number is written once, by the path that names it if there is one."""
    chosen: dict[tuple[str, tuple[int, ...]], Write] = {}
    for write in (write for writes in parameters for write in writes):
        place = write.field, write.index
        other = chosen.get(place)
        if other is None or (other.follows and not write.follows):
            chosen[place] = write
        elif other.follows == write.follows:
            raise ValueError(
                f"parameters {other.parameter} and {write.parameter} both write {write.field}{list(write.index)}; "
                "remove one of the two targets."
            )
    return tuple(chosen.values())


def write_into(model: mujoco.MjModel, writes: Sequence[Write], theta: np.ndarray) -> None:
    """Write θ into a model in place; what MuJoCo derives from it is `mj_setConst`'s part."""
    for write in writes:
        array = model.opt.gravity if write.field == "gravity" else getattr(model, write.field)
        array[write.index] = write.factor * theta[write.parameter]


def infers_inertia(spec: mujoco.MjSpec, geom: str) -> bool:
    """Whether the inertia of the body that carries a geom is computed from its geoms' shapes."""
    always = spec.compiler.inertiafromgeom == mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE
    never = spec.compiler.inertiafromgeom == mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_FALSE
    return always or not (never or spec.geom(geom).parent.explicitinertial)


def _path_writes(model: mujoco.MjModel, path: str, parameter: int) -> list[Write]:
    kind, _, rest = path.partition("/")
    if kind == "option":
        return _option_writes(path, rest, parameter)
    if kind not in OBJECTS:
        raise ValueError(f"target {path!r}: the kind is one of {', '.join(OBJECTS)} and option, not {kind!r}.")
    name, field, component = _split(model, kind, path, rest)
    number = mujoco.mj_name2id(model, OBJECTS[kind], name)

    def one(array: str, index: tuple[int, ...], factor: float = 1.0, follows: bool = False) -> Write:
        return Write(array, index, float(factor), parameter, follows)

    if (kind, field) in VECTORS:
        array, size = VECTORS[kind, field]
        if component is None and field != "gear":
            raise ValueError(f"target {path!r}: {field} has components; write {path}/0 to {path}/{size - 1}.")
        if component is not None and not 0 <= component < size:
            raise ValueError(f"target {path!r}: {field} has the components 0 to {size - 1}, not {component}.")
        return [one(array, (number, component or 0))]
    if component is not None and field != "ctrlrange":
        raise ValueError(f"target {path!r}: {field} is one number; write {path.rpartition('/')[0]}.")
    if (kind, field) == ("body", "mass"):
        mass, inertia = float(model.body_mass[number]), model.body_inertia[number]
        scaled = [
            one("body_inertia", (number, k), inertia[k] / mass, follows=True) for k in range(3) if mass and inertia[k]
        ]
        return [one("body_mass", (number,)), *scaled]
    if kind == "joint":
        return _joint_writes(model, path, number, field, one)
    if (kind, field) == ("actuator", "gain"):
        return [one("actuator_gainprm", (number, 0)), *_servo_writes(model, number, one)]
    if (kind, field) == ("actuator", "ctrlrange"):
        return _range_writes(model, path, number, component, one)
    raise ValueError(f"target {path!r}: a {kind} has no field {field!r} that can be a parameter.")


def _split(model: mujoco.MjModel, kind: str, path: str, rest: str) -> tuple[str, str, int | None]:
    """Name, field and component; a name may hold slashes."""
    pieces = rest.split("/")
    component = int(pieces.pop()) if len(pieces) > 2 and pieces[-1].lstrip("-").isdigit() else None
    name, field = "/".join(pieces[:-1]), pieces[-1]
    if mujoco.mj_name2id(model, OBJECTS[kind], name) < 0:
        raise ValueError(f"target {path!r}: the model has no {kind} {name!r}.")
    return name, field, component


def _option_writes(path: str, rest: str, parameter: int) -> list[Write]:
    if rest not in ("gravity/0", "gravity/1", "gravity/2"):
        raise ValueError(f"target {path!r}: of the options only gravity/0, gravity/1 and gravity/2 can be parameters.")
    return [Write("gravity", (int(rest[-1]),), 1.0, parameter)]


def _joint_writes(model: mujoco.MjModel, path: str, number: int, field: str, one: Any) -> list[Write]:
    kind = model.jnt_type[number]
    free, ball = kind == mujoco.mjtJoint.mjJNT_FREE, kind == mujoco.mjtJoint.mjJNT_BALL
    first, count = int(model.jnt_dofadr[number]), 6 if free else 3 if ball else 1
    if field in DEGREES_OF_FREEDOM:
        return [one(DEGREES_OF_FREEDOM[field], (dof,)) for dof in range(first, first + count)]
    if field == "stiffness":
        return [one("jnt_stiffness", (number,))]
    if field == "springref" and count == 1:
        return [one("qpos_spring", (int(model.jnt_qposadr[number]),))]
    raise ValueError(f"target {path!r}: this joint has no field {field!r} that can be a parameter.")


def _servo_writes(model: mujoco.MjModel, number: int, one: Any) -> list[Write]:
    """The bias of a position or velocity servo, −kp q or −kv q̇, follows its gain."""
    gain, bias = model.actuator_gainprm[number, 0], model.actuator_biasprm[number]
    affine = model.actuator_biastype[number] == mujoco.mjtBias.mjBIAS_AFFINE
    return [
        one("actuator_biasprm", (number, k), -1.0, follows=True) for k in (1, 2) if affine and gain and bias[k] == -gain
    ]


def _range_writes(model: mujoco.MjModel, path: str, number: int, component: int | None, one: Any) -> list[Write]:
    if component is not None:
        if component not in (0, 1):
            raise ValueError(f"target {path!r}: ctrlrange has the components 0 and 1, not {component}.")
        return [one("actuator_ctrlrange", (number, component))]
    low, high = model.actuator_ctrlrange[number]
    if not (model.actuator_ctrllimited[number] and high > 0.0):
        raise ValueError(f"target {path!r}: the upper bound of the control must be limited and above 0.")
    return [one("actuator_ctrlrange", (number, 0), low / high), one("actuator_ctrlrange", (number, 1))]
