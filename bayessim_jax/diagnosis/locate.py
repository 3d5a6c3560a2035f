"""Where a mismatch sits: which joint, in which region of its state, and when."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from bayessim_jax.effects import Scales

__all__ = ["Location", "find_regime", "find_windows_of", "shares_from_left"]

QUANTILES = (0.1, 0.2, 0.3, 0.5, 0.7, 0.8, 0.9)
CONTRAST = 0.25
"""Share of the force's power beyond the share of the time, from which a region is worth naming."""
MOST = 12


@dataclass
class Location:
    """A part of the misfit."""

    at: str
    share: float
    regime: str = ""
    windows: list[tuple[str, float, float]] = field(default_factory=list)
    """Recording, from, to in s."""


def shares_from_left(left: Sequence[float]) -> Float[np.ndarray, " places"]:
    """Shares of places in a misfit, from what is left of it when each alone may exert any force."""
    weight = 1 / np.maximum(np.asarray(left, float), 1e-3)
    return weight / weight.sum()


def find_regime(
    force: Float[np.ndarray, " samples"],
    position: Float[np.ndarray, " samples"],
    velocity: Float[np.ndarray, " samples"],
    drive: Float[np.ndarray, " samples"],
    time: Float[np.ndarray, " samples"],
    scales: Scales,
) -> str:
    """The region of a joint's state in which a residual force is strong: a threshold on one quantity, or everywhere."""
    unit = scales.unit
    power = force**2
    if not power.sum() > 0:
        return "everywhere"
    offset = position - scales.centre
    regions: list[tuple[str, np.ndarray]] = []

    def levels(name: str, values: np.ndarray, unit: str) -> None:
        for level in np.unique(np.quantile(values, QUANTILES)):
            regions.append((f"{name} > {level:.3g} {unit}".strip(), values > level))
            regions.append((f"{name} < {level:.3g} {unit}".strip(), values < level))

    levels("|velocity|", np.abs(velocity), f"{unit}/s")
    levels("time", time, "s")
    levels("position", offset + scales.centre, unit)
    if np.ptp(drive) > 1e-9 * scales.force:
        levels("|drive|", np.abs(drive), scales.force_unit)
    regions += [("velocity > 0", velocity > 0), ("velocity < 0", velocity < 0)]
    best, found = CONTRAST, "everywhere"
    for name, inside in regions:
        if 0.05 <= inside.mean() <= 0.95:
            contrast = power[inside].sum() / power.sum() - inside.mean()
            if contrast > best:
                best, found = contrast, name
    return found


def find_windows_of(
    excess: Float[np.ndarray, " windows"],
    recording: Sequence[str],
    start: Float[np.ndarray, " windows"],
    length: float,
) -> list[tuple[str, float, float]]:
    """Stretches of time in which the misfit is, windows next to each other joined, the strongest first."""
    if not len(excess) or not excess.max() > 0:
        return []
    strong = np.flatnonzero(excess > 0.2 * excess.max()).tolist()
    stretches: list[list[float | str]] = []
    for w in sorted(strong, key=lambda w: (recording[w], start[w])):
        begin, end = float(start[w]), float(start[w] + length)
        if stretches and stretches[-1][0] == recording[w] and begin <= float(stretches[-1][2]) + 0.1 * length:
            stretches[-1][2] = end
            stretches[-1][3] = float(stretches[-1][3]) + float(excess[w])
        else:
            stretches.append([recording[w], begin, end, float(excess[w])])
    stretches.sort(key=lambda s: -float(s[3]))
    return [(str(s[0]), round(float(s[1]), 4), round(float(s[2]), 4)) for s in stretches[:MOST]]
