"""Springs, stops, ripple, and pushes at a joint."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from bayessim_jax.concealment.law import ForceLaw, Spot
from bayessim_jax.concealment.places import driven_joints, joints

if TYPE_CHECKING:
    from bayessim_jax.concealment.world import World

__all__ = ["DisturbanceEvent", "Hysteresis", "JointCoupling", "JointSpring", "SoftStop", "TorqueRipple"]


@dataclass
class JointSpring(ForceLaw):
    """τ = −k (q − q₀) − k₃ (q − q₀)³."""

    name = "joint_spring"
    stiffness: float
    reference: float
    cubic: float

    @classmethod
    def make(cls, spot: Spot, amplitude: float, rng: np.random.Generator) -> JointSpring:
        """Half of them linear, in the others the cubic part is up to 60 % of the linear one at full reach."""
        stiffness = 2.0 * amplitude * spot.force / spot.reach
        bend = rng.choice([0.0, 1.0]) * rng.uniform(0.2, 0.6)
        return cls(spot, stiffness, spot.centre + rng.uniform(-0.4, 0.4) * spot.reach, bend * stiffness / spot.reach**2)

    def force(self, world: World, q: float, v: float) -> float:
        """Towards the reference."""
        x = q - self.reference
        return -(self.stiffness + self.cubic * x * x) * x


@dataclass
class SoftStop(ForceLaw):
    """τ = −s k p (1 + c ṗ) where p = s (q − q₁) > 0, s = ±1, never pulling: damping grows with depth.

    Source: Hunt and Crossley 1975
    """

    name = "soft_stop"
    angle: float
    stiffness: float
    damping: float

    @classmethod
    def places(cls, model: mujoco.MjModel) -> list[str]:
        """Both sides of every joint."""
        return [f"{joint}#{side}" for joint in joints(model) for side in ("upper", "lower")]

    @classmethod
    def make(cls, spot: Spot, amplitude: float, rng: np.random.Generator) -> SoftStop:
        """A stop at 30 to 60 % of the joint's reach."""
        side = -1.0 if spot.detail == "lower" else 1.0
        angle = spot.centre + side * rng.uniform(0.3, 0.6) * spot.reach
        return cls(spot, angle, 10.0 * amplitude * spot.force / spot.reach, rng.uniform(0.1, 0.4) / spot.speed)

    def force(self, world: World, q: float, v: float) -> float:
        """Away from the stop."""
        side = -1.0 if self.spot.detail == "lower" else 1.0
        depth = side * (q - self.angle)
        return 0.0 if depth <= 0.0 else -side * self.stiffness * depth * max(1.0 + self.damping * side * v, 0.0)


@dataclass
class TorqueRipple(ForceLaw):
    """τ = A [sin(n q + φ) + 0.1 sin 2(n q + φ)]."""

    name = "torque_ripple"
    amplitude: float
    cycles: float
    phase: float

    @classmethod
    def make(cls, spot: Spot, amplitude: float, rng: np.random.Generator) -> TorqueRipple:
        """Some two to five periods within the joint's reach to both sides, a whole number of them in a turn."""
        cycles = 2.0 * math.pi * rng.uniform(2.0, 5.0) / (2.0 * spot.reach)
        return cls(
            spot, 1.4 * amplitude * spot.force, cycles if spot.slides else max(round(cycles), 2), rng.uniform(0, 6.28)
        )

    def force(self, world: World, q: float, v: float) -> float:
        """A function of the position."""
        angle = self.cycles * q + self.phase
        return self.amplitude * (math.sin(angle) + 0.1 * math.sin(2.0 * angle))


@dataclass
class Hysteresis(ForceLaw):
    """τ = −κ z, ż = v [A − (β sign(v z) + γ) |z|ⁿ] with A = 1, integrated by Heun's rule.

    Source: Wen 1976
    """

    name = "hysteresis"
    stiffness: float
    beta: float
    gamma: float
    n: float

    @classmethod
    def make(cls, spot: Spot, amplitude: float, rng: np.random.Generator) -> Hysteresis:
        """Yielding after 15 to 35 % of the joint's reach."""
        n, turn = rng.uniform(1.0, 1.6), rng.uniform(0.6, 0.8)
        yields = rng.uniform(0.15, 0.35) * spot.reach
        return cls(spot, amplitude * spot.force / yields, turn / yields**n, (1.0 - turn) / yields**n, n)

    def begin(self, world: World, rng: np.random.Generator) -> None:
        """Not bent."""
        self._bend = 0.0

    def _rate(self, z: float, v: float) -> float:
        turn = math.copysign(self.beta, v * z) + self.gamma
        return v * (1.0 - turn * abs(z) ** self.n)

    def force(self, world: World, q: float, v: float) -> float:
        """That of the bend after the step."""
        first = self._rate(self._bend, v)
        self._bend += 0.5 * world.h * (first + self._rate(self._bend + world.h * first, v))
        return -self.stiffness * self._bend


@dataclass
class DisturbanceEvent(ForceLaw):
    """τ = P π/(2 w) sin(π (t − t₀)/w) for t₀ < t < t₁ = t₀ + w, or P/w: half a sine or a rectangle of the impulse P.

    t in s since the beginning of every recording.
    """

    name = "disturbance_event"
    start: float
    end: float
    impulse: float
    rectangle: bool = False

    @classmethod
    def make(cls, spot: Spot, amplitude: float, rng: np.random.Generator) -> DisturbanceEvent:
        """A push of 5 to 12 % of the recording's duration, not at its ends."""
        width, start = rng.uniform(0.05, 0.12) * spot.duration, rng.uniform(0.15, 0.7) * spot.duration
        peak = amplitude * spot.force * math.sqrt(2.0 * spot.duration / width)
        impulse = rng.choice([-1.0, 1.0]) * peak * width * 2.0 / math.pi
        return cls(spot, start, start + width, impulse, bool(rng.uniform() < 0.5))

    def force(self, world: World, q: float, v: float) -> float:
        """The push."""
        phase = (world.time - self.start) / (self.end - self.start)
        if not 0.0 < phase < 1.0:
            return 0.0
        shape = 1.0 if self.rectangle else math.pi / 2.0 * math.sin(math.pi * phase)
        return self.impulse / (self.end - self.start) * shape


@dataclass
class JointCoupling(ForceLaw):
    """τⱼ = k x, x the torque of the motors, the position or the velocity of joint i: `joint/j#velocity/i`."""

    name = "joint_coupling"
    gain: float

    @classmethod
    def places(cls, model: mujoco.MjModel) -> list[str]:
        """Every pair of joints, in each way that there is."""
        driven = driven_joints(model)
        return [
            f"{j}#{way}/{i.removeprefix('joint/')}"
            for j in joints(model)
            for i in joints(model)
            for way in ("torque", "position", "velocity")
            if i != j and (way != "torque" or i in driven)
        ]

    @classmethod
    def make(cls, spot: Spot, amplitude: float, rng: np.random.Generator) -> JointCoupling:
        """K of either sign, in units of what the two joints do."""
        scale = {"torque": spot.other_force, "position": spot.other_reach}.get(
            spot.detail.partition("/")[0], spot.other_speed
        )
        return cls(spot, rng.choice([-1.0, 1.0]) * 2.0 * amplitude * spot.force / max(scale, 1e-9))

    def force(self, world: World, q: float, v: float) -> float:
        """In proportion to what the other joint does."""
        way = self.spot.detail.partition("/")[0]
        if way == "torque":
            return self.gain * world.motor(self.spot.other)
        position, velocity = world.state(self.spot.other)
        return self.gain * (position if way == "position" else velocity)
