"""What a planner did: paths around the circle, cost as it accumulates, and the plans that it weighed while driving."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float

from bayessim_jax.report.style import BLUE, GREY, ORANGE, PURPLE, draw_svg
from bayessim_jax.report.viewer import animation

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["POSE", "Drives", "Scene", "cost_plot", "drive_animation", "paths_plot", "shown_rounds"]

POSE = ("base/x", "base/y", "base/yaw")
"""Channels of a vehicle."""
COLOURS = (GREY, ORANGE, BLUE, PURPLE)
CORNERS = 36


@dataclass(frozen=True)
class Drives:
    """The first recording of every round of the first seed."""

    channels: tuple[str, ...]
    times: Float[np.ndarray, "round rows"]
    observations: Float[np.ndarray, "round rows obs"]
    rewards: Float[np.ndarray, "round steps"]
    valid: Bool[np.ndarray, "round steps"]

    def poses(self, index: int) -> Float[np.ndarray, "rows 3"] | None:
        """x, y and heading in a round, counted from 1; nothing where the machine is no vehicle."""
        if not all(name in self.channels for name in POSE):
            return None
        rows = np.concatenate([self.valid[index - 1][:1], self.valid[index - 1]])
        return self.observations[index - 1][rows][:, [self.channels.index(name) for name in POSE]]


@dataclass(frozen=True)
class Scene:
    """A drive, and at some of its moments the paths of the plans that were weighed."""

    time: Float[np.ndarray, " frames"]
    poses: Float[np.ndarray, "frames 3"]
    paths: Float[np.ndarray, "frames plans points 2"]
    best: Float[np.ndarray, "frames points 2"]
    """Of the plan that was made of them."""
    radius: float
    """Of the circle that touches the x axis at the origin, m."""


def shown_rounds(rounds: int) -> list[int]:
    """The first three rounds and the last."""
    return sorted({*range(1, min(rounds, 3) + 1), rounds})


def paths_plot(drives: Drives, radius: float) -> str:
    """The paths of some rounds, beside the circle to follow."""

    def draw(figure: Figure) -> None:
        ax = figure.subplots()
        angle = np.linspace(0, 2 * np.pi, 200)
        ax.plot(radius * np.sin(angle), radius * (1 - np.cos(angle)), color=GREY, linestyle="--", label="to follow")
        for colour, index in zip(COLOURS, shown_rounds(len(drives.times)), strict=False):
            poses = drives.poses(index)
            assert poses is not None
            ax.plot(poses[:, 0], poses[:, 1], color=colour, linewidth=1.3, label=f"round {index}")
            ax.plot(*poses[0, :2], "o", color=colour, markersize=4)
        ax.set_aspect("equal", adjustable="datalim")
        ax.set_xlabel("x [m]")
        ax.set_ylabel("y [m]")
        ax.legend(loc="best")

    return draw_svg(4.8, 4.4, draw, "paths")


def cost_plot(drives: Drives) -> str:
    """Mean cost of a step so far, over the time of a recording, for some rounds."""

    def draw(figure: Figure) -> None:
        ax = figure.subplots()
        for colour, index in zip(COLOURS, shown_rounds(len(drives.times)), strict=False):
            kept = drives.valid[index - 1]
            cost = -drives.rewards[index - 1][kept]
            time = drives.times[index - 1][1:][kept]
            mean = np.cumsum(cost) / np.arange(1, len(cost) + 1)
            ax.plot(time, mean, color=colour, linewidth=1.4, label=f"round {index}")
        ax.set_ylim(bottom=0)
        ax.set_xlabel("time [s]")
        ax.set_ylabel("mean cost of a step so far")
        ax.legend(loc="best")

    return draw_svg(4.8, 3.4, draw, "cost-so-far")


def drive_animation(scene: Scene, caption: str) -> str:
    """The vehicle on its way, with the plans that it weighs and the one that it makes of them."""
    count = len(scene.time)
    angle = np.linspace(0, 2 * np.pi, CORNERS + 1)
    circle = scene.radius * np.stack([np.sin(angle), 1 - np.cos(angle)], -1)
    way = np.stack([_joined(scene.poses[np.minimum(np.arange(count), k), :2]) for k in range(count)])
    bodies = [
        ("circle to follow", GREY, 0.8, 1.5, np.repeat(_joined(circle)[None], count, 0)),
        ("plans weighed", PURPLE, 0.45, 1.0, np.concatenate([_each(p) for p in np.moveaxis(scene.paths, 1, 0)], 1)),
        ("plan made of them", ORANGE, 0.95, 2.0, _each(scene.best)),
        ("way so far", BLUE, 0.7, 1.5, way),
        ("vehicle", "", 1.0, 2.5, np.stack([_outline(*pose) for pose in scene.poses])),
    ]
    return animation(scene.time, bodies, caption, "The vehicle on its way, with the plans that it weighs.")


def _joined(points: np.ndarray) -> np.ndarray:
    """Segments from point to point."""
    return np.concatenate([points[:-1], points[1:]], 1)


def _each(paths: np.ndarray) -> np.ndarray:
    return np.stack([_joined(path) for path in paths])


def _outline(x: float, y: float, yaw: float) -> np.ndarray:
    """A body of 24 by 16 cm with a nose."""
    body = np.array([[0.12, 0.08], [-0.12, 0.08], [-0.12, -0.08], [0.12, -0.08], [0.18, 0.0], [0.12, 0.08]])
    turn = np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])
    return _joined(body @ turn + np.array([x, y]))
