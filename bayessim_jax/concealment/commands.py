"""What an actuator makes of its command."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from bayessim_jax.concealment.law import ActLaw, Spot

if TYPE_CHECKING:
    from bayessim_jax.concealment.world import World

__all__ = [
    "ActuatorBias",
    "ActuatorDeadband",
    "ActuatorDelay",
    "ActuatorGain",
    "ActuatorLag",
    "ActuatorRateLimit",
    "ActuatorSaturation",
    "BackEmf",
    "GainDrift",
    "GainDrop",
]

LONGEST = 0.1
"""s; the longest delay."""


def _gain(amplitude: float, rng: np.random.Generator) -> float:
    """1 + a or 1/(1 + a)."""
    return 1.0 + amplitude if rng.uniform() < 0.5 else 1.0 / (1.0 + amplitude)


@dataclass
class ActuatorGain(ActLaw):
    """u ↦ k u."""

    name = "actuator_gain"
    gain: float

    @classmethod
    def make(cls, spot: Spot, amplitude: float, rng: np.random.Generator) -> ActuatorGain:
        """Too strong or too weak."""
        return cls(spot, _gain(amplitude, rng))

    def command(self, world: World, u: float) -> float:
        """The product."""
        return self.gain * u


@dataclass
class ActuatorBias(ActLaw):
    """u ↦ u + u₀."""

    name = "actuator_bias"
    torque: float

    @classmethod
    def make(cls, spot: Spot, amplitude: float, rng: np.random.Generator) -> ActuatorBias:
        """U₀ of either sign, in units of the largest command."""
        return cls(spot, rng.choice([-1.0, 1.0]) * amplitude * spot.command)

    def command(self, world: World, u: float) -> float:
        """The sum."""
        return u + self.torque


@dataclass
class ActuatorDelay(ActLaw):
    """u(t) ↦ u(t − T), between the steps of the world on a straight line."""

    name = "actuator_delay"
    seconds: float

    @classmethod
    def make(cls, spot: Spot, amplitude: float, rng: np.random.Generator) -> ActuatorDelay:
        """T below 0.1 s."""
        return cls(spot, LONGEST * math.tanh(amplitude))

    def begin(self, world: World, rng: np.random.Generator) -> None:
        """The first command has been held for long."""
        self._whole, self._rest = divmod(self.seconds / world.h, 1.0)
        size = int(self._whole) + 2
        self._line = deque([float(world.data.ctrl[self.spot.actuator])] * size, size)

    def command(self, world: World, u: float) -> float:
        """The command T ago."""
        self._line.append(u)
        return self._rest * self._line[0] + (1.0 - self._rest) * self._line[1]


@dataclass
class ActuatorLag(ActLaw):
    """ȧ = (u − a)/T, exactly for a command that is held."""

    name = "actuator_lag"
    time_constant: float

    @classmethod
    def make(cls, spot: Spot, amplitude: float, rng: np.random.Generator) -> ActuatorLag:
        """T in units of 0.1 s."""
        return cls(spot, 0.1 * amplitude)

    def begin(self, world: World, rng: np.random.Generator) -> None:
        """The first command has been held for long."""
        self._arrived = float(world.data.ctrl[self.spot.actuator])
        self._share = -math.expm1(-world.h / self.time_constant) if self.time_constant > 0.0 else 1.0

    def command(self, world: World, u: float) -> float:
        """The state after the step."""
        self._arrived += self._share * (u - self._arrived)
        return self._arrived if self._share < 1.0 else u


@dataclass
class ActuatorSaturation(ActLaw):
    """u ↦ u/(1 + |u/L|¹⁶)^(1/16): clipped at ±L with a rounded corner."""

    name = "actuator_saturation"
    limit: float

    @classmethod
    def make(cls, spot: Spot, amplitude: float, rng: np.random.Generator) -> ActuatorSaturation:
        """L from far above the largest command down to nothing."""
        return cls(spot, 1.2 * spot.command / amplitude**0.5 if amplitude > 0.0 else math.inf)

    def command(self, world: World, u: float) -> float:
        """Clipped."""
        ratio = min(abs(u) / self.limit, 1e9)
        return u / (1.0 + ratio**16) ** (1.0 / 16.0)


@dataclass
class ActuatorRateLimit(ActLaw):
    """|u̇| ≤ r."""

    name = "actuator_rate_limit"
    rate: float

    @classmethod
    def make(cls, spot: Spot, amplitude: float, rng: np.random.Generator) -> ActuatorRateLimit:
        """R such that the largest command is reached in `amplitude` times 0.2 s."""
        return cls(spot, spot.command / (0.2 * amplitude) if amplitude > 0.0 else math.inf)

    def begin(self, world: World, rng: np.random.Generator) -> None:
        """The first command has arrived."""
        self._arrived = float(world.data.ctrl[self.spot.actuator])

    def command(self, world: World, u: float) -> float:
        """As near as it can come."""
        most = self.rate * world.h
        self._arrived = min(max(u, self._arrived - most), self._arrived + most)
        return self._arrived


@dataclass
class ActuatorDeadband(ActLaw):
    """u ↦ sign(u) max(|u| − w, 0)."""

    name = "actuator_deadband"
    width: float

    @classmethod
    def make(cls, spot: Spot, amplitude: float, rng: np.random.Generator) -> ActuatorDeadband:
        """W in units of the largest command."""
        return cls(spot, amplitude * spot.command)

    def command(self, world: World, u: float) -> float:
        """What is beyond the band."""
        return math.copysign(max(abs(u) - self.width, 0.0), u)


@dataclass
class BackEmf(ActLaw):
    """V ↦ (V − k_e v)/ρ, v the joint's velocity and ρ the winding's resistance over what it is believed to be."""

    name = "back_emf"
    constant: float
    resistance: float

    @classmethod
    def make(cls, spot: Spot, amplitude: float, rng: np.random.Generator) -> BackEmf:
        """k_e in units of the largest command over the joint's speed; ρ grows with it."""
        return cls(spot, amplitude * spot.command / spot.speed, math.exp(rng.uniform(0.3, 0.8) * min(amplitude, 2.0)))

    def command(self, world: World, u: float) -> float:
        """What is left of the voltage."""
        return (u - self.constant * world.state(self.spot.joint)[1]) / self.resistance


@dataclass
class GainDrop(ActLaw):
    """u ↦ k u from the time t* on, in s since the beginning of every recording."""

    name = "gain_drop"
    time: float
    gain: float

    @classmethod
    def make(cls, spot: Spot, amplitude: float, rng: np.random.Generator) -> GainDrop:
        """In the middle of the recording; to less, or to more, which is at most twice as much."""
        change = amplitude / (1.0 + amplitude)
        return cls(spot, rng.uniform(0.25, 0.6) * spot.duration, 1.0 + rng.choice([-1.0, 1.0]) * change)

    def command(self, world: World, u: float) -> float:
        """The command, or the product."""
        return self.gain * u if world.time >= self.time else u


@dataclass
class GainDrift(ActLaw):
    """u ↦ [1 + r τ (1 − exp(−t/τ))] u, t in s since the beginning of the recording: at first 1 + r t.

    τ, with which a motor comes to its temperature, is five times as long as the recording.
    """

    name = "gain_drift"
    rate: float

    @classmethod
    def make(cls, spot: Spot, amplitude: float, rng: np.random.Generator) -> GainDrift:
        """R in units of one over the recording's duration; above −1."""
        up = rng.uniform() < 0.5
        return cls(spot, (2.0 * amplitude if up else -2.0 * amplitude / (1.0 + 2.0 * amplitude)) / spot.duration)

    def command(self, world: World, u: float) -> float:
        """The command times the gain of this time."""
        settle = 5.0 * self.spot.duration
        return u * (1.0 - self.rate * settle * math.expm1(-max(world.time, 0.0) / settle))
