"""Places by name: `kind/name`, and after a `#` what tells apart what lies there."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import mujoco

__all__ = [
    "Site",
    "actuator_name",
    "at",
    "detail",
    "driven_joint",
    "driven_joints",
    "driving_actuators",
    "encoders",
    "find_body",
    "find_site",
    "has_rate",
    "joints",
    "movable_bodies",
    "turned_joint",
]

SCALAR = (mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE)
ON_JOINTS = (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT)


@dataclass(frozen=True)
class Site:
    """A place in a model: its joint or the joint that its actuator drives, −1 for none."""

    joint: int = -1
    actuators: tuple[int, ...] = ()
    other: int = -1
    """The second joint, where there is one."""
    detail: str = ""


def at(place: str) -> str:
    """The place without its detail, as `diagnosis.json` names it."""
    return place.partition("#")[0]


def detail(place: str) -> str:
    """What stands after the `#`."""
    return place.partition("#")[2]


def has_rate(place: str, channels: Collection[str]) -> bool:
    """Whether the velocity that belongs to a position is a channel, too."""
    return at(place).removesuffix("/qpos") + "/qvel" in channels


def joints(model: mujoco.MjModel) -> list[str]:
    """Hinges and slides that have a name."""
    named = [j for j in range(model.njnt) if model.jnt_type[j] in SCALAR and model.joint(j).name]
    return [f"joint/{model.joint(j).name}" for j in named]


def encoders(model: mujoco.MjModel) -> list[str]:
    """Positions of hinges and slides, and sensors of one number."""
    sensors = [f"sensor/{model.sensor(i).name}" for i in range(model.nsensor) if model.sensor_dim[i] == 1]
    return [f"{joint}/qpos" for joint in joints(model)] + sensors


def driven_joints(model: mujoco.MjModel) -> list[str]:
    """Hinges and slides that an actuator drives."""
    driven = {driven_joint(model, i) for i in range(model.nu)}
    return [place for place in joints(model) if find_site(model, place).joint in driven]


def driving_actuators(model: mujoco.MjModel) -> list[str]:
    """Actuators of hinges and slides."""
    return [f"actuator/{actuator_name(model, i)}" for i in range(model.nu) if driven_joint(model, i) >= 0]


def movable_bodies(model: mujoco.MjModel) -> list[str]:
    """Bodies with a name and a mass that are not fixed to the world."""
    movable = [b for b in range(1, model.nbody) if model.body_weldid[b] and model.body_mass[b] > 0.0]
    return [f"body/{model.body(b).name}" for b in movable if model.body(b).name]


def find_body(model: mujoco.MjModel, place: str) -> int:
    """The body of a place, or `ValueError`."""
    number = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, at(place).removeprefix("body/"))
    if number < 0:
        known = ", ".join(movable_bodies(model))
        raise ValueError(f"place {place!r}: the model has no such body; take one of {known}.")
    return number


def turned_joint(model: mujoco.MjModel, place: str) -> int:
    """The joint whose zero is turned by an encoder, by a tilted base or by what hangs from it aside, or −1."""
    where, what = at(place), detail(place)
    if what == "across":
        body = find_body(model, place)
        last = not (model.body_parentid == body).any() and model.body_jntnum[body] == 1
        return int(model.body_jntadr[body]) if last else -1
    name = what if where == "world" else where.removesuffix("/qpos") if where.endswith("/qpos") else ""
    return mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, name.removeprefix("joint/")) if name else -1


def driven_joint(model: mujoco.MjModel, actuator: int) -> int:
    """The hinge or slide that an actuator drives, or −1."""
    if model.actuator_trntype[actuator] not in ON_JOINTS:
        return -1
    joint = int(model.actuator_trnid[actuator, 0])
    return joint if model.jnt_type[joint] in SCALAR else -1


def find_site(model: mujoco.MjModel, place: str) -> Site:
    """Joint and actuators of a place, or `ValueError` for names that the model does not have."""
    kind, _, name = at(place).partition("/")
    if kind == "joint":
        joint = _find_joint(model, place, name.removesuffix("/qpos").removesuffix("/qvel"))
        second = detail(place).partition("/")[2]
        return Site(joint, other=_find_joint(model, place, second) if second else -1, detail=detail(place))
    if kind == "actuator":
        pair = [name, *detail(place).split("#")] if detail(place) else [name]
        found = tuple(_find_actuator(model, place, n.removeprefix("actuator/")) for n in pair)
        return Site(driven_joint(model, found[0]), found)
    if kind == "sensor":
        return Site(_encoder_joint(model, name))
    return Site()


def actuator_name(model: mujoco.MjModel, number: int) -> str:
    """Name of an actuator as systems and recordings give it."""
    return model.actuator(number).name or f"actuator{number}"


def _encoder_joint(model: mujoco.MjModel, name: str) -> int:
    """The joint whose position a sensor shows, or −1."""
    number = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SENSOR, name)
    if number < 0 or model.sensor_type[number] != mujoco.mjtSensor.mjSENS_JOINTPOS:
        return -1
    return int(model.sensor_objid[number])


def _find_joint(model: mujoco.MjModel, place: str, name: str) -> int:
    for joint in range(model.njnt):
        if model.joint(joint).name == name and model.jnt_type[joint] in SCALAR:
            return joint
    raise ValueError(
        f"place {place!r}: the model has no hinge or slide {name!r}; take one of {', '.join(joints(model))}."
    )


def _find_actuator(model: mujoco.MjModel, place: str, name: str) -> int:
    for number in range(model.nu):
        if actuator_name(model, number) == name:
            return number
    known = ", ".join(f"actuator/{actuator_name(model, i)}" for i in range(model.nu))
    raise ValueError(f"place {place!r}: the model has no actuator {name!r}; take one of {known}.")
