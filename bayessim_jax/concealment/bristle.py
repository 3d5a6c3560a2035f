"""Dry friction that sticks: bristles as stiff as the time step allows, which slip at a level."""

from __future__ import annotations

import math

__all__ = ["Bristle"]

STIFF = 0.3
"""ω h of a joint on its bristles."""


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
