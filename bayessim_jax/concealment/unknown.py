"""Laws that are in no library: what a diagnosis has to refuse to name."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import mujoco
import numpy as np
from jaxtyping import Float

from bayessim_jax.concealment.bristle import Bristle
from bayessim_jax.concealment.law import ForceLaw, SenseLaw, Spot
from bayessim_jax.concealment.places import joints

if TYPE_CHECKING:
    from bayessim_jax.concealment.world import World

__all__ = ["Beat", "Cross", "Dwell", "Jolt", "Spots", "Swirl", "Tired", "Walk", "Wind"]

Steps = Float[np.ndarray, " steps"]


@dataclass
class Spots(ForceLaw):
    """Dry friction of the level F exp(−(x/w)²), x the distance to the nearest of spots p apart; more one way."""

    name = "spots"
    level: float
    distance: float
    width: float
    ratio: float

    @classmethod
    def make(cls, spot: Spot, amplitude: float, rng: np.random.Generator) -> Spots:
        """Some two or three spots within the joint's reach."""
        distance = rng.uniform(0.7, 1.1) * spot.reach
        return cls(spot, 3.0 * amplitude * spot.force, distance, 0.2 * distance, rng.uniform(0.0, 0.4))

    def begin(self, world: World, rng: np.random.Generator) -> None:
        """With a bristle that is not bent."""
        self._bristle = Bristle(self.spot.inertia, world.h)

    def force(self, world: World, q: float, v: float) -> float:
        """The bristle's."""
        x = (q - self.spot.centre + 0.3 * self.distance) % self.distance - self.distance / 2.0
        level = self.level * math.exp(-((x / self.width) ** 2))
        return self._bristle.pull(v, self.ratio * level, level)


@dataclass
class Beat(ForceLaw):
    """τ = ± F, changing in sign with a rhythm of its own, which is anywhere in its period when a recording begins."""

    name = "beat"
    level: float
    frequency: float

    @classmethod
    def make(cls, spot: Spot, amplitude: float, rng: np.random.Generator) -> Beat:
        """At 0.8 to 2.5 Hz."""
        return cls(spot, amplitude * spot.force, rng.uniform(0.8, 2.5))

    def begin(self, world: World, rng: np.random.Generator) -> None:
        """At any phase."""
        self._phase = rng.uniform()

    def force(self, world: World, q: float, v: float) -> float:
        """A square wave."""
        return self.level if (self.frequency * world.time + self._phase) % 1.0 < 0.5 else -self.level


@dataclass
class Tired(ForceLaw):
    """τ = −b v/(1 + (c T)²), Ṫ = (v/v₀)² − T/t₀: a damper that softens with its own heat and recovers at rest."""

    name = "tired"
    viscous: float
    softness: float
    recovery: float

    @classmethod
    def make(cls, spot: Spot, amplitude: float, rng: np.random.Generator) -> Tired:
        """Half as strong after some tenths of a second at full speed."""
        softness, recovery = rng.uniform(8.0, 15.0), rng.uniform(0.5, 1.0)
        return cls(spot, 8.0 * amplitude * spot.force / spot.speed, softness, recovery)

    def begin(self, world: World, rng: np.random.Generator) -> None:
        """Cold."""
        self._heat = 0.0

    def force(self, world: World, q: float, v: float) -> float:
        """Against the velocity."""
        self._heat += world.h * ((v / self.spot.speed) ** 2 - self._heat / self.recovery)
        return -self.viscous * v / (1.0 + (self.softness * self._heat) ** 2)


@dataclass
class Dwell(ForceLaw):
    """Dry friction that grows with the time at rest and wears off with the way: F = F₀ + F₁ a, a between 0 and 1.

    ȧ = (1 − a)/t₁ where |v| < v₁, and −a |v|/d else.
    """

    name = "dwell"
    level: float
    rise: float
    seconds: float
    distance: float

    @classmethod
    def make(cls, spot: Spot, amplitude: float, rng: np.random.Generator) -> Dwell:
        """Ten times as large after a rest, for a good part of the joint's reach."""
        level = 0.15 * amplitude * spot.force
        return cls(spot, level, 20.0 * level, rng.uniform(0.03, 0.1), rng.uniform(0.3, 0.5) * spot.reach)

    def begin(self, world: World, rng: np.random.Generator) -> None:
        """Moving."""
        self._bristle, self._age = Bristle(self.spot.inertia, world.h), 0.0

    def force(self, world: World, q: float, v: float) -> float:
        """The bristle's."""
        rests = abs(v) < 0.15 * self.spot.speed
        self._age += world.h * ((1.0 - self._age) / self.seconds if rests else -self._age * abs(v) / self.distance)
        level = self.level + self.rise * self._age
        return self._bristle.pull(v, level, level)


@dataclass
class Wind(ForceLaw):
    """dτ = −τ dt/t₀ + s √(2/t₀) dW: a force that varies at random (Ornstein and Uhlenbeck), anew in every recording."""

    name = "wind"
    level: float
    seconds: float

    @classmethod
    def make(cls, spot: Spot, amplitude: float, rng: np.random.Generator) -> Wind:
        """With a memory of 0.1 to 0.4 s."""
        return cls(spot, amplitude * spot.force, rng.uniform(0.1, 0.4))

    def begin(self, world: World, rng: np.random.Generator) -> None:
        """Already blowing."""
        self._draw, self._force = rng.standard_normal, rng.standard_normal()

    def force(self, world: World, q: float, v: float) -> float:
        """What blows now."""
        decay = math.exp(-world.h / self.seconds)
        self._force = decay * self._force + math.sqrt(1.0 - decay**2) * self._draw()
        return self.level * self._force


@dataclass
class Jolt(ForceLaw):
    """τ = F s exp(−t/t₀), t since the joint last turned round and s the direction in which it goes since."""

    name = "jolt"
    level: float
    seconds: float

    @classmethod
    def make(cls, spot: Spot, amplitude: float, rng: np.random.Generator) -> Jolt:
        """That drives or brakes, and lasts 0.05 to 0.15 s."""
        return cls(spot, rng.choice([-1.0, 1.0]) * 2.5 * amplitude * spot.force, rng.uniform(0.05, 0.15))

    def begin(self, world: World, rng: np.random.Generator) -> None:
        """Long after it."""
        self._side, self._rest = math.copysign(1.0, world.state(self.spot.joint)[1]), 0.0

    def force(self, world: World, q: float, v: float) -> float:
        """What is left of the last jolt."""
        self._rest *= math.exp(-world.h / self.seconds)
        if self._side * v < -0.03 * self.spot.speed:
            self._side, self._rest = -self._side, 1.0
        return self.level * self._side * self._rest


@dataclass
class Swirl(ForceLaw):
    """τ = c |v| sin(n q + φ): a push that grows with the speed, its direction given by the place."""

    name = "swirl"
    coefficient: float
    cycles: float
    phase: float

    @classmethod
    def make(cls, spot: Spot, amplitude: float, rng: np.random.Generator) -> Swirl:
        """Some period and a half within the joint's reach to both sides."""
        return cls(
            spot, 3.0 * amplitude * spot.force / spot.speed, rng.uniform(3.5, 5.0) / spot.reach, rng.uniform(0.0, 6.28)
        )

    def force(self, world: World, q: float, v: float) -> float:
        """A function of the state."""
        return self.coefficient * abs(v) * math.sin(self.cycles * q + self.phase)


@dataclass
class Cross(ForceLaw):
    """τⱼ = c q̇ᵢ q̇ⱼ, for a machine of several joints: `joint/j#velocity/i`."""

    name = "cross"
    coefficient: float

    @classmethod
    def places(cls, model: mujoco.MjModel) -> list[str]:
        """Every pair of joints."""
        names = joints(model)
        return [f"{j}#velocity/{i.removeprefix('joint/')}" for j in names for i in names if i != j]

    @classmethod
    def make(cls, spot: Spot, amplitude: float, rng: np.random.Generator) -> Cross:
        """Of either sign, in units of the two joints' speeds."""
        sign = rng.choice([-1.0, 1.0])
        return cls(spot, sign * 4.0 * amplitude * spot.force / max(spot.speed * spot.other_speed, 1e-9))

    def force(self, world: World, q: float, v: float) -> float:
        """The product of the velocities."""
        return self.coefficient * v * world.state(self.spot.other)[1]


@dataclass
class Walk(SenseLaw):
    """q ↦ q + x(t), x a random walk seen through three lags of 0.1 s each, zero when a recording begins."""

    name = "walk"
    rate: float

    @classmethod
    def make(cls, spot: Spot, amplitude: float, rng: np.random.Generator) -> Walk:
        """In units of the joint's reach for the square root of a second."""
        return cls(spot, amplitude * spot.reach)

    def read(self, time: Steps, q: Steps, rng: np.random.Generator) -> Steps:
        """The sum."""
        h = float(time[1] - time[0])
        walk = np.cumsum(rng.standard_normal(len(q)) * math.sqrt(h))
        share = -math.expm1(-h / 0.1)
        for _ in range(3):
            walk = _lagged(walk, share)
        return q + self.rate * (walk - np.interp(0.0, time, walk))


def _lagged(x: Steps, share: float) -> Steps:
    """yₖ = yₖ₋₁ + share (xₖ − yₖ₋₁)."""
    y, out = float(x[0]), np.empty(len(x))
    for k, value in enumerate(x.tolist()):
        y += share * (value - y)
        out[k] = y
    return out
