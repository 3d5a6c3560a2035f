"""The amplitude at which a law has the strength asked for."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from bayessim_jax.concealment.registry import lookup_law
from bayessim_jax.concealment.world import RunawayError

if TYPE_CHECKING:
    from bayessim_jax.concealment.law import Law
    from bayessim_jax.concealment.scene import Scene

__all__ = ["Hidden", "StrengthError", "hide"]

TOLERANCE = 0.05
"""Relative error of the strength with which the search is content."""
ACCEPTED = 0.1
"""Relative error with which it still succeeds after all its trials."""
TRIALS = 14
LARGEST = 1e3
"""Amplitudes beyond which a law that does not reach the strength never will."""


class StrengthError(ValueError):
    """A law that cannot be as strong as asked; `most` is what came nearest."""

    def __init__(self, name: str, place: str, asked: float, most: float) -> None:
        self.most = most
        super().__init__(
            f"effect {name!r} at {place!r}: strength {asked:g} is out of reach in these motions, nearest is "
            f"{most:.2g}; ask for that, or choose another place or other motions."
        )


@dataclass(frozen=True)
class Hidden:
    """A law of the strength that it was found to have alone."""

    name: str
    law: Law
    strength: float


def hide(scene: Scene, name: str, place: str, strength: float, seed: int) -> Hidden:
    """A law with the amplitude that gives this strength, or `StrengthError`.

    Bodies of the scene's model must not be simple ones (`mujoco.MjSpec`), or laws of masses cannot change them.

    Strengths are nearly proportional to amplitudes: from there by secants of log strength over log amplitude, within
    what is known to be too little and too much.
    """
    kind, spot = lookup_law(name), scene.spot(place)
    low, high = -np.inf, np.inf
    tried: list[tuple[float, float]] = []
    best: Hidden | None = None
    x, goal = np.log(strength), np.log(strength)
    for _ in range(TRIALS):
        law = kind.make(spot, float(np.exp(x)), np.random.default_rng(seed))
        try:
            found = scene.strength(spot, scene.play([law]))
        except RunawayError:
            found = np.inf
        if np.isfinite(found) and (best is None or abs(found - strength) < abs(best.strength - strength)):
            best = Hidden(name, law, found)
        if abs(found - strength) <= TOLERANCE * strength:
            break
        low, high = (max(low, x), high) if found < strength else (low, min(high, x))
        if np.isfinite(found) and found > 0.0:
            tried.append((x, float(np.log(found))))
        x = _next(tried, low, high, goal)
        if x > np.log(LARGEST):
            break
    if best is None or abs(best.strength - strength) > ACCEPTED * strength:
        raise StrengthError(name, place, strength, best.strength if best else 0.0)
    return best


def _next(tried: list[tuple[float, float]], low: float, high: float, goal: float) -> float:
    """The next log amplitude."""
    slope, (x, y) = 1.0, tried[-1] if tried else (low if np.isfinite(low) else high + 1.0, goal - 1.0)
    if len(tried) > 1:
        near = sorted(tried, key=lambda t: abs(t[1] - goal))[:2]
        (x, y), (x2, y2) = near
        slope = (y - y2) / (x - x2) if x != x2 else 1.0
        slope = float(np.clip(slope, 0.3, 3.0))
    x = x + float(np.clip((goal - y) / slope, -3.0, 3.0))
    if np.isfinite(low) and np.isfinite(high):
        margin = 0.1 * (high - low)
        return x if low + margin < x < high - margin else (low + high) / 2
    if np.isfinite(low):
        return max(x, low + 0.1)
    return min(x, high - 0.1)
