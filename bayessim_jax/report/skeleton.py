"""A model as a stick figure: its geoms' axes at given positions, projected on the plane that they move in."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
from jaxtyping import Float

__all__ = ["draw_positions", "plane_of"]

BOX = [(a, b) for a in range(8) for b in range(a) if bin(a ^ b).count("1") == 1]


def draw_positions(model: Any, qpos: Float[np.ndarray, "frames nq"]) -> Float[np.ndarray, "frames segments 2 3"]:
    """End points of the segments that stand for the model in every frame; NaN where positions are not finite."""
    data = mujoco.MjData(model)
    frames = []
    for row in qpos:
        if not np.isfinite(row).all():
            frames.append(None)
            continue
        data.qpos[:] = row
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        frames.append(_segments(model, data))
    count = max((len(f) for f in frames if f is not None), default=0)
    return np.array([np.full((count, 2, 3), np.nan) if f is None else f for f in frames])


def _segments(model: Any, data: Any) -> np.ndarray:
    """Geoms that move, and links between the bodies' joints."""
    found = []
    moving = [b for b in range(1, model.nbody) if model.body_weldid[b]]
    shown = set()
    for g in range(model.ngeom):
        body, kind = int(model.geom_bodyid[g]), int(model.geom_type[g])
        if body not in moving:
            continue
        center, turn, size = data.geom_xpos[g], data.geom_xmat[g].reshape(3, 3), model.geom_size[g]
        if kind in (mujoco.mjtGeom.mjGEOM_CAPSULE, mujoco.mjtGeom.mjGEOM_CYLINDER):
            found.append([center - turn[:, 2] * size[1], center + turn[:, 2] * size[1]])
        elif kind == mujoco.mjtGeom.mjGEOM_BOX:
            corners = [center + turn @ (size * [(k & 1) * 2 - 1, (k & 2) - 1, (k & 4) / 2 - 1]) for k in range(8)]
            found += [[corners[a], corners[b]] for a, b in BOX]
        else:
            found.append([center, center])
        shown.add(body)
    for body in moving:
        parent = int(model.body_parentid[body])
        if model.body_weldid[parent]:
            found.append([data.xpos[parent], data.xpos[body]])
        if body not in shown:
            found.append([data.xpos[body], data.xipos[body]])
    return np.array(found).reshape(-1, 2, 3)


def plane_of(points: Float[np.ndarray, "n 3"]) -> tuple[int, int]:
    """The two world axes along which points lie furthest apart; the vertical one upright."""
    points = points[np.isfinite(points).all(1)]
    extent = np.ptp(points, axis=0) if len(points) else np.ones(3)
    first, second = sorted(np.argsort(extent)[-2:].tolist())
    return first, second
