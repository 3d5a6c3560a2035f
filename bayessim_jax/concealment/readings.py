"""What an encoder shows of a joint's position."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from bayessim_jax.concealment.law import SenseLaw, Spot

__all__ = ["SensorDelay", "SensorOffset", "SensorScale"]

Steps = Float[np.ndarray, " steps"]
LONGEST = 0.1
"""s; the longest delay."""


@dataclass
class SensorOffset(SenseLaw):
    """q ↦ q + q₀."""

    name = "sensor_offset"
    offset: float

    @classmethod
    def make(cls, spot: Spot, amplitude: float, rng: np.random.Generator) -> SensorOffset:
        """q₀ of either sign, in units of the joint's reach."""
        return cls(spot, rng.choice([-1.0, 1.0]) * amplitude * spot.reach)

    def read(self, time: Steps, q: Steps, rng: np.random.Generator) -> Steps:
        """The sum."""
        return q + self.offset


@dataclass
class SensorScale(SenseLaw):
    """q ↦ k q."""

    name = "sensor_scale"
    scale: float

    @classmethod
    def make(cls, spot: Spot, amplitude: float, rng: np.random.Generator) -> SensorScale:
        """Too much or too little, fivefold at most: less is a sensor that shows nothing."""
        scale = 1.0 + min(amplitude, 4.0)
        return cls(spot, scale if rng.uniform() < 0.5 else 1.0 / scale)

    def read(self, time: Steps, q: Steps, rng: np.random.Generator) -> Steps:
        """The product."""
        return self.scale * q


@dataclass
class SensorDelay(SenseLaw):
    """q(t) ↦ q(t − T)."""

    name = "sensor_delay"
    seconds: float

    @classmethod
    def make(cls, spot: Spot, amplitude: float, rng: np.random.Generator) -> SensorDelay:
        """T below 0.1 s."""
        return cls(spot, LONGEST * math.tanh(amplitude))

    def read(self, time: Steps, q: Steps, rng: np.random.Generator) -> Steps:
        """Between the steps of the world on parabolas, so that the acceleration is that of then."""
        h = float(time[1] - time[0])
        back = np.arange(len(q)) - self.seconds / h
        near = np.clip(np.round(back).astype(int), 1, len(q) - 2)
        x = back - near
        late = q[near] + 0.5 * x * (q[near + 1] - q[near - 1]) + 0.5 * x * x * (q[near + 1] - 2 * q[near] + q[near - 1])
        return np.where(back < 0, q[0], late) if self.seconds > 0.0 else q
