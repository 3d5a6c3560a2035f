"""What is seen of a MuJoCo model: channels by the names that recordings use."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco

__all__ = ["Channel", "find_channels", "observed_sensors", "state_columns"]


@dataclass(frozen=True)
class Channel:
    """One number that is measured, and the range that axes are drawn with."""

    name: str
    source: str
    """`qpos`, `qvel` or `sensor`: which array of the simulation it is taken from."""
    index: int
    low: float
    high: float
    unit: str


WIDTHS = {
    mujoco.mjtJoint.mjJNT_FREE: (7, 6),
    mujoco.mjtJoint.mjJNT_BALL: (4, 3),
    mujoco.mjtJoint.mjJNT_SLIDE: (1, 1),
    mujoco.mjtJoint.mjJNT_HINGE: (1, 1),
}
"""For each kind of joint how many positions and velocities it has."""

SAME = {mujoco.mjtSensor.mjSENS_JOINTPOS: "qpos", mujoco.mjtSensor.mjSENS_JOINTVEL: "qvel"}
"""Sensors that show a joint's position or velocity, which every engine has."""


def find_channels(model: mujoco.MjModel, names: Sequence[str] | None = None) -> tuple[Channel, ...]:
    """The named channels in their order, or all joints' positions, then all joints' velocities; else `ValueError`."""
    if names is None:
        joints = [model.joint(i).name or f"#{i}" for i in range(model.njnt)]
        names = [f"joint/{joint}/{what}" for what in ("qpos", "qvel") for joint in joints]
    return tuple(channel for name in names for channel in _expand(model, name))


def observed_sensors(model: mujoco.MjModel, channels: Sequence[Channel]) -> tuple[str, ...]:
    """Names of the sensors that a simulation has to compute for these channels."""
    needed = {c.index for c in channels if c.source == "sensor"}
    return tuple(
        model.sensor(i).name
        for i in range(model.nsensor)
        if needed & set(range(model.sensor_adr[i], model.sensor_adr[i] + model.sensor_dim[i]))
    )


def state_columns(model: mujoco.MjModel, channels: Sequence[Channel]) -> tuple[list[int], list[int]]:
    """The channel that shows each entry of `qpos` and of `qvel`; raises `ValueError` where one is not observed."""
    columns: dict[str, list[int]] = {"qpos": [], "qvel": []}
    for wanted in find_channels(model):
        showing = [k for k, c in enumerate(channels) if (c.source, c.index) == (wanted.source, wanted.index)]
        if not showing:
            raise ValueError(f"a state cannot be made of what is observed: {wanted.name} is missing; observe it.")
        columns[wanted.source].append(showing[0])
    return columns["qpos"], columns["qvel"]


def _expand(model: mujoco.MjModel, name: str) -> list[Channel]:
    """A channel, or the components `name/0`, `name/1`, … of one that has several."""
    kind, _, rest = name.partition("/")
    pieces = rest.split("/")
    component = None
    if pieces[-1].isdigit() and len(pieces) > (2 if kind == "joint" else 1):
        component = int(pieces.pop())
    if kind == "joint" and len(pieces) > 1 and pieces[-1] in ("qpos", "qvel"):
        first, count, source, low, high, unit = _joint(model, name, "/".join(pieces[:-1]), pieces[-1])
    elif kind == "sensor":
        first, count, source, low, high, unit = _sensor(model, name, "/".join(pieces))
    else:
        raise ValueError(f"channel {name!r}: write joint/<name>/qpos, joint/<name>/qvel or sensor/<name>.")
    if component is not None and component >= count:
        raise ValueError(f"channel {name!r}: there are the components 0 to {count - 1}.")
    chosen = range(count) if component is None else [component]
    base = name if component is None else name.rpartition("/")[0]
    return [Channel(base if count == 1 else f"{base}/{k}", source, first + k, low, high, unit) for k in chosen]


def _joint(model: mujoco.MjModel, channel: str, name: str, what: str) -> tuple[int, int, str, float, float, str]:
    number = int(name[1:]) if name[:1] == "#" else mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, name)
    if number < 0:
        raise ValueError(f"channel {channel!r}: the model has no joint {name!r}.")
    kind = mujoco.mjtJoint(model.jnt_type[number])
    slides = kind == mujoco.mjtJoint.mjJNT_SLIDE
    unit = "m" if slides else "rad" if kind == mujoco.mjtJoint.mjJNT_HINGE else ""
    if what == "qvel":
        return int(model.jnt_dofadr[number]), WIDTHS[kind][1], what, -10.0, 10.0, f"{unit}/s" if unit else ""
    low, high = (float(x) for x in model.jnt_range[number]) if model.jnt_limited[number] else (-3.2, 3.2)
    return int(model.jnt_qposadr[number]), WIDTHS[kind][0], what, low, max(high, low + 1e-9), unit


def _sensor(model: mujoco.MjModel, channel: str, name: str) -> tuple[int, int, str, float, float, str]:
    number = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SENSOR, name)
    if number < 0:
        raise ValueError(f"channel {channel!r}: the model has no sensor {name!r}.")
    kind, joint = mujoco.mjtSensor(model.sensor_type[number]), int(model.sensor_objid[number])
    if kind in SAME and not model.sensor_cutoff[number]:
        what = SAME[kind]
        first = model.jnt_qposadr[joint] if what == "qpos" else model.jnt_dofadr[joint]
        return int(first), 1, what, -10.0, 10.0, ""
    return int(model.sensor_adr[number]), int(model.sensor_dim[number]), "sensor", -10.0, 10.0, ""
