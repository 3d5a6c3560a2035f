"""Target and simulator side by side: the same actions from the same beginning, as figures of lines that move."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from jaxtyping import Float

from bayessim_jax.report.skeleton import BOX, draw_positions
from bayessim_jax.report.style import BLUE, GREY, ORANGE, PURPLE
from bayessim_jax.report.viewer import animation

__all__ = ["Beside", "beside_animation", "deviation"]

AZIMUTH, ELEVATION = np.radians(20.0), np.radians(35.0)
"""Where a table is looked at from, rad: from the side along which things slide, and from above."""
CORNERS = 16
SECONDS = 2.0
"""What is over sooner is shown slower."""
PATH = 12
"""Pieces of the way that the object has come."""


@dataclass(frozen=True)
class Beside:
    """The target's newest recording, and what the simulator shows at one θ under the recorded actions."""

    system: str
    time: Float[np.ndarray, " frames"]
    target: Float[np.ndarray, "frames obs"]
    simulated: Float[np.ndarray, "frames obs"]
    channels: tuple[str, ...]
    theta: Float[np.ndarray, " d"]
    """The mean of the belief that the recording led to."""
    model: Any
    """MuJoCo's model of the machine, for the sizes of things."""
    round: int


def deviation(beside: Beside) -> tuple[str, float]:
    """How far apart both are in the end, and what is compared: the object's place, or the torso's way, m."""
    if beside.system == "hopper":
        ways = [_coordinates(beside, seen)[-1, :2] for seen in (beside.target, beside.simulated)]
        return "torsos", float(np.linalg.norm(ways[0] - ways[1]))
    places = [_columns(beside, seen, "object")[-1] for seen in (beside.target, beside.simulated)]
    return "objects", float(np.linalg.norm(places[0] - places[1]))


def beside_animation(beside: Beside) -> str:
    """Left the target, right the simulator; the things of both move together."""
    draw = _draw_leg if beside.system == "hopper" else _draw_table
    parts = [draw(beside, seen) for seen in (beside.target, beside.simulated)]
    everything = np.concatenate([lines.reshape(-1, 2) for part in parts for *_, lines in part])
    everything = everything[np.isfinite(everything).all(1)]
    low, high = everything.min(0), everything.max(0)
    apart = np.array([1.15 * (high[0] - low[0]), 0.0])
    bodies = [
        (label, colour, 0.95, width, np.concatenate([left, right + np.tile(apart, 2)], 1))
        for (label, colour, width, left), (*_, right) in zip(*parts, strict=True)
    ]
    middle, top = (low[0] + high[0]) / 2, high[1] + 0.06 * (high[1] - low[1])
    labels = [("target", middle, top), ("simulator", middle + apart[0], top)]
    what, gap = deviation(beside)
    lasts = max(float(beside.time[-1] - beside.time[0]), 1e-9)
    slower = max(SECONDS / lasts, 1.0)
    caption = (
        f"Round {beside.round}: the target as recorded, and the simulator at the mean of the belief, θ = "
        f"{', '.join(f'{x:.3g}' for x in beside.theta)}, given the same actions from the same beginning. In the end "
        f"the two {what} are {100 * gap:.2g} cm apart."
    )
    caption += f" Shown {slower:.2g} times slower than it was." if slower > 1.01 else ""
    return animation(beside.time, bodies, caption, "Target and simulator side by side.", labels, slower)


def _columns(beside: Beside, seen: np.ndarray, name: str) -> np.ndarray:
    return seen[:, [beside.channels.index(f"{name}_{axis}") for axis in "xyz"]]


def _draw_table(beside: Beside, seen: np.ndarray) -> list[tuple[str, str, float, np.ndarray]]:
    """Table, goal, gripper and object of Fetch, looked at from the side and from above."""
    model, count = beside.model, len(seen)
    table, thing = int(model.body("table0").geomadr[0]), int(model.geom("object0").id)
    half, middle = model.geom_size[table], model.body("table0").pos
    top = middle[2] + half[2]
    signs = ((-1, -1), (1, -1), (1, 1), (-1, 1), (-1, -1))
    board = np.array([[*(middle[:2] + half[:2] * sign), top] for sign in signs])
    angle = np.linspace(0.0, 2 * np.pi, CORNERS + 1)
    ring = np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], -1)
    grip, place, goal = (_columns(beside, seen, name) for name in ("grip", "object", "goal"))
    finger = np.array([[-0.02, 0, 0], [-0.02, 0, 0.06], [0.02, 0, 0.06], [0.02, 0, 0], [-0.02, 0, 0]])
    wrist = np.array([[0, 0, 0.06], [0, 0, 0.14]])
    turned = np.stack([_turn(*angles) for angles in _columns(beside, seen, "turn")])
    body = np.einsum("fij,spj->fspi", turned, _solid(model, thing, ring)) + place[:, None, None]
    marks = np.linspace(0, count - 1, PATH + 1).round().astype(int)
    way = np.stack([_joined(place[np.minimum(marks, k)]) for k in range(count)])
    hand = np.concatenate([_joined(finger), _joined(wrist)]) + grip[:, None, None]
    shapes = [
        ("table", GREY, 1.2, _joined(board)[None]),
        ("goal, 5 cm around", ORANGE, 2.0, _joined(goal[-1] + 0.05 * ring)[None]),
        ("the object's way", PURPLE, 1.4, way),
        ("gripper", "", 2.0, hand),
        ("object", BLUE, 2.2, body),
    ]
    return [(label, colour, width, _project(lines)) for label, colour, width, lines in shapes]


def _solid(model: Any, geom: int, ring: np.ndarray) -> np.ndarray:
    """Edges of a box or a cylinder about its centre."""
    size = model.geom_size[geom]
    if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_BOX:
        corners = np.array([size * [(k & 1) * 2 - 1, (k & 2) - 1, (k & 4) / 2 - 1] for k in range(8)])
        return np.stack([corners[[a, b]] for a, b in BOX])
    rims = [_joined(size[0] * ring + np.array([0.0, 0.0, z])) for z in (-size[1], size[1])]
    spoke = size[0] * ring[[0, CORNERS // 2]] + np.array([0.0, 0.0, size[1]])
    return np.concatenate([*rims, spoke[None]])


def _draw_leg(beside: Beside, seen: np.ndarray) -> list[tuple[str, str, float, np.ndarray]]:
    """The Hopper in its plane, the floor, and the way of its torso."""
    qpos = _coordinates(beside, seen)
    torso = qpos[:, :2].copy()
    # the model counts the height from where the torso stands upright
    qpos[:, 1] -= beside.model.body("torso").pos[2]
    limbs = np.count_nonzero(beside.model.geom_bodyid)  # they come first, then links from joint to joint
    lines = draw_positions(beside.model, qpos)[:, :limbs, :, [0, 2]].reshape(len(seen), -1, 4)
    ways = [_coordinates(beside, other)[:, 0] for other in (beside.target, beside.simulated)]
    reach = min(w.min() for w in ways) - 0.5, max(w.max() for w in ways) + 0.5
    marks = np.linspace(0, len(seen) - 1, PATH + 1).round().astype(int)
    way = np.stack([_joined(torso[np.minimum(marks, k)]).reshape(-1, 4) for k in range(len(seen))])
    floor = np.array([[[reach[0], 0.0, reach[1], 0.0]]])
    return [("floor", GREY, 1.2, floor), ("the torso's way", PURPLE, 1.4, way), ("hopper", BLUE, 3.0, lines)]


def _coordinates(beside: Beside, seen: np.ndarray) -> np.ndarray:
    """Place of the torso, x and z, its pitch and three angles; x, which is not seen, is the sum of the speeds shown."""
    rate = seen[:, beside.channels.index("x_rate")]
    x = np.concatenate([[0.0], np.cumsum((rate[1:] + rate[:-1]) / 2 * np.diff(beside.time))])
    rest = [beside.channels.index(name) for name in ("z", "pitch", "thigh", "leg", "foot")]
    return np.column_stack([x, seen[:, rest]])


def _joined(points: np.ndarray) -> np.ndarray:
    """Segments from point to point, (n − 1, 2, axes)."""
    return np.stack([points[:-1], points[1:]], 1)


def _project(lines: Float[np.ndarray, "frames n 2 3"]) -> Float[np.ndarray, "frames n 4"]:
    """As seen from far away."""
    across = np.array([np.cos(AZIMUTH), np.sin(AZIMUTH), 0.0])
    away = np.array([-np.sin(AZIMUTH), np.cos(AZIMUTH), 0.0])
    upwards = np.sin(ELEVATION) * away + np.array([0.0, 0.0, np.cos(ELEVATION)])
    return (lines @ np.stack([across, upwards], 1)).reshape(*lines.shape[:2], 4)


def _turn(a: float, b: float, c: float) -> np.ndarray:
    """Rx(a) Ry(b) Rz(c)."""
    matrices = []
    for axis, angle in enumerate((a, b, c)):
        i, j = (axis + 1) % 3, (axis + 2) % 3
        matrix = np.eye(3)
        matrix[i, i] = matrix[j, j] = np.cos(angle)
        matrix[j, i] = np.sin(angle)
        matrix[i, j] = -np.sin(angle)
        matrices.append(matrix)
    return matrices[0] @ matrices[1] @ matrices[2]
