"""Dry friction in the forms that machines have: bristles that stick and slip, and a sign that is rounded."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np

    from bayessim_jax.concealment.law import Spot

__all__ = ["ROUND", "Bristle", "RoundSign", "draw_rounding", "grip"]

STIFF = 0.3
"""ω h of a joint on its bristles."""
ROUND = (0.004, 0.04)
"""Of a joint's speed: where the sign is rounded, if it is."""
STABLE = 2.0
"""Times the speed that friction takes away in a time step, below which a sign is not rounded."""


class Bristle:
    """A spring and a damper in parallel that slip where they reach a level (Prandtl's element).

    ṡ = k v within −F₋ < s < F₊, and τ = −clip(s + d ṡ/k, −F₋, F₊): at rest the joint is held after a displacement
    of F/k, which is some 10⁻⁵ rad.
    """

    def __init__(self, inertia: float, h: float) -> None:
        """For a joint that feels `inertia`, stepped by h seconds."""
        self.h = h
        self.stiffness = inertia * (STIFF / h) ** 2
        self.rate = math.sqrt(inertia / self.stiffness)
        self.bend = 0.0

    def pull(self, v: float, low: float, high: float) -> float:
        """The force at a velocity, between −high and low, and the bend after the step."""
        before = self.bend
        self.bend = min(max(before + self.stiffness * self.h * v, -low), high)
        whole = self.bend + self.rate * (self.bend - before) / self.h
        return -min(max(whole, -low), high)


class RoundSign:
    """τ = −F tanh(v/ε): friction that creeps where it should hold."""

    def __init__(self, width: float) -> None:
        """With ε, rad/s or m/s."""
        self.width = width

    def pull(self, v: float, low: float, high: float) -> float:
        """The force at a velocity, between −high and low."""
        return -math.tanh(v / self.width) * (high if v > 0.0 else low)


def draw_rounding(spot: Spot, level: float, rng: np.random.Generator) -> float:
    """ε of friction of a level, rad/s or m/s; 0 in half of all machines, and where ε would be most of the speed."""
    low, high = ROUND
    width = math.exp(rng.uniform(math.log(low), math.log(high))) * spot.speed
    least = STABLE * abs(level) * spot.h / spot.inertia
    return max(width, least) if rng.uniform() < 0.5 and least <= high * spot.speed else 0.0


def grip(spot: Spot, rounding: float) -> Bristle | RoundSign:
    """What exerts the friction of a joint: bristles, or a sign that is rounded."""
    return RoundSign(rounding) if rounding > 0.0 else Bristle(spot.inertia, spot.h)
