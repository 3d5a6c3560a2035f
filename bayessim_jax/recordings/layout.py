"""What can be measured of a model: the names of its channels, in the order of its arrays."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from bayessim_jax.contracts import System

__all__ = ["Layout", "layout_of_model", "layout_of_system"]

WIDTHS = {0: (7, 6), 1: (4, 3), 2: (1, 1), 3: (1, 1)}
"""Numbers in qpos and qvel of free, ball, slide and hinge joints."""
FREE, BALL, SLIDE, HINGE = range(4)


@dataclass(frozen=True)
class Layout:
    """The channels of a simulator, each name in the place that its value has in the simulator's arrays.

    A registered system has no `qpos` and `qvel`: its observations stand under `sensors`.
    """

    ctrl: tuple[str, ...]
    qpos: tuple[str, ...]
    qvel: tuple[str, ...]
    sensors: tuple[str, ...]
    units: dict[str, str]
    """Unit of each channel; `ctrl` has none that is known."""
    joints: tuple[tuple[str, int, int, int], ...] = ()
    """Name, type, first place in `qpos` and first place in `qvel` of each joint."""
    ctrl_range: np.ndarray | None = None
    """Lowest and highest command of each actuator, NaN where it is not limited."""
    joint_range: np.ndarray | None = None
    """Lowest and highest position of each entry of `qpos`, NaN where it is not limited."""
    unnamed: tuple[str, ...] = ()
    """Elements that cannot be measured because they have no name."""

    @property
    def channels(self) -> tuple[str, ...]:
        """Every channel but time."""
        return (*self.qpos, *self.qvel, *self.sensors, *self.ctrl)

    @property
    def single(self) -> tuple[tuple[str, int, int], ...]:
        """Name, place in `qpos` and place in `qvel` of the joints with one coordinate, slides and hinges."""
        return tuple((name, q, v) for name, kind, q, v in self.joints if kind in (SLIDE, HINGE))

    @property
    def hinges(self) -> tuple[tuple[int, int], ...]:
        """Places in `qpos` and `qvel` of the hinge joints."""
        return tuple((q, v) for _, kind, q, v in self.joints if kind == HINGE)

    @property
    def quaternions(self) -> tuple[tuple[int, int], ...]:
        """First places in `qpos` of a quaternion (w, x, y, z) and in `qvel` of its angular velocity."""
        ball = [(q, v) for _, kind, q, v in self.joints if kind == BALL]
        return tuple(ball + [(q + 3, v + 3) for _, kind, q, v in self.joints if kind == FREE])


def layout_of_model(model: Any) -> Layout:
    """The channels of a compiled MJCF."""
    joints, qpos, qvel, units, unnamed = [], [], [], {}, []
    for i in range(model.njnt):
        name, kind = model.joint(i).name, int(model.jnt_type[i])
        if not name:
            unnamed.append(f"joint {i} (of body {model.body(model.jnt_bodyid[i]).name or model.jnt_bodyid[i]})")
            name = f"#{i}"
        wide, slim = WIDTHS[kind]
        joints.append((name, kind, int(model.jnt_qposadr[i]), int(model.jnt_dofadr[i])))
        qpos += _numbered(f"joint/{name}/qpos", wide)
        qvel += _numbered(f"joint/{name}/qvel", slim)
        angular = kind in (BALL, HINGE)
        for k, channel in enumerate(qpos[-wide:]):
            units[channel] = "m" if kind == SLIDE or (kind == FREE and k < 3) else "rad" if kind == HINGE else ""
        for k, channel in enumerate(qvel[-slim:]):
            units[channel] = "rad/s" if angular or (kind == FREE and k >= 3) else "m/s"
    ctrl = []
    for i in range(model.nu):
        if not model.actuator(i).name:
            unnamed.append(f"actuator {i}")
        ctrl.append(f"actuator/{model.actuator(i).name or f'#{i}'}/ctrl")
    sensors = []
    for i in range(model.nsensor):
        name, dim = model.sensor(i).name, int(model.sensor_dim[i])
        if not name:
            unnamed.append(f"sensor {i}")
        sensors += _numbered(f"sensor/{name or f'#{i}'}", dim)
    limits = np.full((model.nq, 2), np.nan)
    for i, (_, kind, q, _) in enumerate(joints):
        if kind in (SLIDE, HINGE) and model.jnt_limited[i]:
            limits[q] = model.jnt_range[i]
    commands = np.where(np.asarray(model.actuator_ctrllimited, bool)[:, None], model.actuator_ctrlrange, np.nan)
    units |= dict.fromkeys((*sensors, *ctrl), "")
    return Layout(
        tuple(ctrl), tuple(qpos), tuple(qvel), tuple(sensors), units, tuple(joints), commands, limits, tuple(unnamed)
    )


def layout_of_system(system: System[Any]) -> Layout:
    """The channels of a registered system: its observations and its actions."""
    seen, acted = system.observations, system.actions
    units = dict(zip(seen.names, seen.units, strict=True)) | dict(zip(acted.names, acted.units, strict=True))
    return Layout(tuple(acted.names), (), (), tuple(seen.names), units)


def _numbered(name: str, count: int) -> list[str]:
    return [name] if count == 1 else [f"{name}/{k}" for k in range(count)]
