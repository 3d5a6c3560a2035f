"""Cases of a skid-steered vehicle, driven here in NumPy: wheels that are late, and ground on which they slip."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

__all__ = ["THETA", "Vehicle", "drive", "write_case"]

DT, FINE = 0.05, 40
BEFORE = 60
"""Control periods before a recording begins: it knows nothing of their commands."""
PRIORS = {"wheel_radius": (0.04, 0.1), "axial_distance": (0.3, 0.7), "icr_offset": (-0.3, 0.3)}
THETA = (0.07, 0.5, 0.1)
HEADER = "time,base/x,base/y,base/yaw,input/left,input/right"


@dataclass(frozen=True)
class Vehicle:
    """ω̇ = (u(t − T) − ω)/τ for each side's wheels, and what the ground makes of their speeds at a time."""

    lag: tuple[float, float] = (0.0, 0.0)
    """τ of the left and right wheels, s."""
    delay: float = 0.0
    """T, s."""
    slip: float = 0.0
    """Of the speed, lost."""
    turning_slip: float = 0.0
    """Of the turning rate, lost on average."""
    swing: float = 0.0
    """By how much that changes, up and down with a period of 1.7 s."""


def _commands(rng: np.random.Generator, rows: int) -> np.ndarray:
    """Steps that last half a second to one and a half, rad/s."""
    signal, row = np.zeros((rows, 2)), 0
    while row < rows:
        length = rng.integers(10, 30)
        signal[row : row + length] = rng.uniform(-6, 6, 2)
        row += length
    return signal


def drive(vehicle: Vehicle, rng: np.random.Generator, rows: int, noise: float) -> np.ndarray:
    """Columns of a recording: time, pose with noise, commands."""
    signal, (radius, distance, icr), h = _commands(rng, BEFORE + rows), THETA, DT / FINE
    flat, late = np.repeat(signal, FINE, axis=0), round(vehicle.delay / h)
    decay = np.array([np.exp(-h / lag) if lag else 0.0 for lag in vehicle.lag])
    wheels, pose, poses = signal[0], np.zeros(3), []
    for k in range(len(flat)):
        if k % FINE == 0:
            poses.append(pose)
        asked = flat[max(k - late, 0)]
        after = asked + (wheels - asked) * decay
        left, right = (wheels + after) / 2 if decay.any() else asked
        wheels = after
        lost = vehicle.turning_slip + vehicle.swing * np.sin(2 * np.pi * k * h / 1.7)
        speed = radius * (left + right) / 2 * (1 - vehicle.slip)
        rate = radius * (right - left) / distance * (1 - lost)
        yaw, aside = pose[2] + rate * h / 2, -icr * rate
        along = np.array([np.cos(yaw), np.sin(yaw)]), np.array([-np.sin(yaw), np.cos(yaw)])
        pose = pose + h * np.array([*(speed * along[0] + aside * along[1]), rate])
    seen = np.array(poses[BEFORE:]) - poses[BEFORE] + noise * rng.normal(size=(rows, 3))
    seen[:, :2] = _turn(seen[:, :2], poses[BEFORE][2])
    return np.column_stack([DT * np.arange(rows), seen, signal[BEFORE:]])


def write_case(
    folder: Path,
    vehicle: Vehicle,
    seed: int = 0,
    recordings: int = 8,
    rows: int = 100,
    noise: float = 0.01,
    priors: Mapping[str, tuple[float, float]] = PRIORS,
) -> Path:
    """A case of `skid_steer` whose recordings a vehicle made; every recording begins at the origin, along x."""
    (folder / "recordings").mkdir(parents=True)
    rng = np.random.default_rng(seed)
    for k in range(recordings):
        rows_of = drive(vehicle, rng, rows, noise)
        path = folder / "recordings" / f"run{k}.csv"
        np.savetxt(path, rows_of, delimiter=",", header=HEADER, comments="", fmt="%.9g")
    text = 'schema = 1\nname = "vehicle"\nsystem = "skid_steer"\nrecordings = "recordings/*.csv"\nhorizon = 1.0\n'
    for name, (low, high) in priors.items():
        text += f'[[parameters]]\nname = "{name}"\nunit = "m"\ntargets = ["{name}"]\n'
        text += f'prior = {{ distribution = "uniform", low = {low}, high = {high} }}\n'
    (folder / "case.toml").write_text(text)
    return folder


def _turn(points: np.ndarray, angle: float) -> np.ndarray:
    """Points in a frame that is turned by an angle."""
    cos, sin = np.cos(angle), np.sin(angle)
    return points @ np.array([[cos, -sin], [sin, cos]])
