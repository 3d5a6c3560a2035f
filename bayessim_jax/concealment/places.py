"""Places of a model by name, and what lies there: `joint/elbow`, `actuator/motor`, `body/arm`, `geom/foot`, `world`."""

from __future__ import annotations

import mujoco
import numpy as np

from bayessim_jax.spelling import near_miss

__all__ = [
    "actuators",
    "bodies",
    "driven_joint",
    "driven_joints",
    "dry_geoms",
    "encoders",
    "find",
    "find_joint",
    "joints",
    "level_places",
    "nearest_joint",
    "touched",
    "turns",
]

SCALAR = (mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE)


def joints(model: mujoco.MjModel) -> list[str]:
    """Hinges and slides that have a name."""
    return [f"joint/{model.joint(j).name}" for j in range(model.njnt) if _scalar(model, j) and model.joint(j).name]


def encoders(model: mujoco.MjModel) -> list[str]:
    """The positions of hinges and slides, as they are measured."""
    return [f"{joint}/qpos" for joint in joints(model)]


def driven_joint(model: mujoco.MjModel, actuator: int) -> int:
    """The hinge or slide that an actuator drives directly, or −1."""
    direct = (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT)
    joint = int(model.actuator_trnid[actuator, 0])
    return joint if model.actuator_trntype[actuator] in direct and _scalar(model, joint) else -1


def driven_joints(model: mujoco.MjModel) -> list[str]:
    """Hinges and slides that an actuator drives."""
    driven = {driven_joint(model, i) for i in range(model.nu)}
    return [place for place in joints(model) if find_joint(model, place) in driven]


def actuators(model: mujoco.MjModel) -> list[str]:
    """Actuators with a name that drive a hinge or slide."""
    named = [i for i in range(model.nu) if model.actuator(i).name and driven_joint(model, i) >= 0]
    return [f"actuator/{model.actuator(i).name}" for i in named]


def bodies(model: mujoco.MjModel) -> list[str]:
    """Bodies with a name and a mass that a hinge or slide moves."""
    moved = [b for b in range(1, model.nbody) if model.body_mass[b] > 0.0 and nearest_joint(model, b) >= 0]
    return [f"body/{model.body(b).name}" for b in moved if model.body(b).name]


def dry_geoms(model: mujoco.MjModel) -> list[str]:
    """Geoms with a name that a hinge or slide moves, and that can rub on something fixed to the world."""
    moving = [g for g in range(model.ngeom) if nearest_joint(model, int(model.geom_bodyid[g])) >= 0]
    return [f"geom/{model.geom(g).name}" for g in moving if model.geom(g).name and touched(model, g)]


def touched(model: mujoco.MjModel, geom: int) -> list[int]:
    """Geoms fixed to the world with which a geom can collide."""
    fixed = [g for g in range(model.ngeom) if model.body_weldid[model.geom_bodyid[g]] == 0]
    return [
        g
        for g in fixed
        if model.geom_contype[g] & model.geom_conaffinity[geom] or model.geom_contype[geom] & model.geom_conaffinity[g]
    ]


def nearest_joint(model: mujoco.MjModel, body: int) -> int:
    """The hinge or slide that moves a body most directly: its own last one or that of an ancestor; −1 for none."""
    while body:
        if model.body_jntnum[body]:
            joint = int(model.body_jntadr[body] + model.body_jntnum[body] - 1)
            return joint if _scalar(model, joint) else -1
        body = int(model.body_parentid[body])
    return -1


def turns(model: mujoco.MjModel, body: int) -> bool:
    """Whether a hinge, its own or that of an ancestor, turns a body."""
    while body:
        first, count = int(model.body_jntadr[body]), int(model.body_jntnum[body])
        if any(model.jnt_type[j] == mujoco.mjtJoint.mjJNT_HINGE for j in range(first, first + count)):
            return True
        body = int(model.body_parentid[body])
    return False


def find_joint(model: mujoco.MjModel, place: str) -> int:
    """The joint of `joint/name`, with or without `/qpos` and what follows a `#`."""
    name = place.partition("#")[0].removeprefix("joint/").removesuffix("/qpos")
    return int(model.joint(name).id)


def find(place: str, known: list[str]) -> list[str]:
    """The places meant: that of the name, or all of them that differ after the `#` only; raises `ValueError`."""
    fitting = [p for p in known if place in (p, p.partition("#")[0])]
    if not fitting:
        raise ValueError(f"unknown place {place!r}: {near_miss(place, known)}")
    return fitting


def _scalar(model: mujoco.MjModel, joint: int) -> bool:
    return 0 <= joint < model.njnt and model.jnt_type[joint] in SCALAR


def level_places(model: mujoco.MjModel) -> list[str]:
    """The world, where it has gravity; `world#joint/hinge` where all that turns does so about axes along that hinge."""
    if not np.any(model.opt.gravity):
        return []
    data, axes = mujoco.MjData(model), []
    mujoco.mj_forward(model, data)
    for joint in range(model.njnt):
        if not _scalar(model, joint):
            return ["world"]
        if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_HINGE:
            axes.append((model.joint(joint).name, np.array(data.xaxis[joint])))
    if not axes or not axes[0][0]:
        return ["world"]
    name, first = axes[0]
    down = np.array(model.opt.gravity) / np.linalg.norm(model.opt.gravity)
    plane = all(np.linalg.norm(np.cross(axis, first)) < 1e-3 for _, axis in axes)
    return [f"world#joint/{name}"] if plane and abs(first @ down) < 0.5 else ["world"]
