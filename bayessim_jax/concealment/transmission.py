"""What lies between a motor and its joint: a rotor of its own, on a spring or with play."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from bayessim_jax.concealment.law import ForceLaw, Spot
from bayessim_jax.concealment.places import actuators, driven_joints

if TYPE_CHECKING:
    from bayessim_jax.concealment.world import World

__all__ = ["Backlash", "JointFlexibility"]

PARTS = 4
"""Steps of a rotor in one of the world's."""


@dataclass
class JointFlexibility(ForceLaw):
    """J θ̈ = τ_m − τ_s, τ_s = k (θ − q) + d (θ̇ − q̇): the link feels τ_s in place of the motors' τ_m.

    Source: Spong 1987
    """

    name = "joint_flexibility"
    stiffness: float
    damping: float
    rotor_inertia: float

    @classmethod
    def places(cls, model: mujoco.MjModel) -> list[str]:
        """Every joint that is driven."""
        return driven_joints(model)

    @classmethod
    def make(cls, spot: Spot, amplitude: float, rng: np.random.Generator) -> JointFlexibility:
        """A rotor of `amplitude` times what the joint feels, on a spring of 3 to 6 Hz with the link alone."""
        pulse = 2.0 * math.pi * rng.uniform(3.0, 6.0)
        stiffness = spot.inertia * pulse**2
        return cls(spot, stiffness, 2.0 * rng.uniform(0.05, 0.12) * stiffness / pulse, amplitude * spot.inertia)

    def begin(self, world: World, rng: np.random.Generator) -> None:
        """A rotor that moves with the link, the spring bent by what the motors exert."""
        q, v = world.state(self.spot.joint)
        self._angle, self._speed = q + world.motor(self.spot.joint) / self.stiffness, v

    def force(self, world: World, q: float, v: float) -> float:
        """τ_s − τ_m, the mean over the step."""
        if self.rotor_inertia < 1e-4 * self.spot.inertia:
            return 0.0
        motor, h, total = world.motor(self.spot.joint), world.h / PARTS, 0.0
        for _ in range(PARTS):
            torque = self.stiffness * (self._angle - q) + self.damping * (self._speed - v)
            self._speed += h * (motor - torque) / self.rotor_inertia
            self._angle += h * self._speed
            q += h * v
            total += torque
        return total / PARTS - motor


@dataclass
class Backlash(ForceLaw):
    """J θ̈ = τ_m − λ: the motor turns freely while |θ − q| < g/2 and meshes on a spring beyond, never pulling.

    λ = k p + d ṗ at the depth p beyond the gap, d = 2 ζ √(k J); the joint feels λ in place of the motors' τ_m. The
    spring is as stiff as the time step allows, or in half of the machines up to a thousand times softer.
    """

    name = "backlash"
    gap: float
    rotor_inertia: float
    stiffness: float
    damping: float

    @classmethod
    def places(cls, model: mujoco.MjModel) -> list[str]:
        """Every actuator."""
        return actuators(model)

    @classmethod
    def make(cls, spot: Spot, amplitude: float, rng: np.random.Generator) -> Backlash:
        """A gap in units of the joint's reach, and a rotor of at most a tenth of what the joint feels."""
        rotor = min(amplitude, 1.0) * rng.uniform(0.05, 0.1) * spot.inertia
        soft = 10.0 ** rng.uniform(-3.0, 0.0) if rng.uniform() < 0.5 else 1.0
        stiffness = soft * rotor * (0.2 * PARTS / spot.h) ** 2
        return cls(spot, amplitude * spot.reach, rotor, stiffness, rng.uniform(0.2, 0.8))

    def begin(self, world: World, rng: np.random.Generator) -> None:
        """A motor that moves with the joint, at that end of the gap to which it presses."""
        q, v = world.state(self.spot.joint)
        self._angle, self._speed = q + math.copysign(self.gap / 2.0, world.motor(self.spot.joint)), v

    def force(self, world: World, q: float, v: float) -> float:
        """λ − τ_m, the mean over the step."""
        if self.rotor_inertia < 1e-5 * self.spot.inertia:
            return 0.0
        motor, h, total, rotor = world.motor(self.spot.joint), world.h / PARTS, 0.0, self.rotor_inertia
        stiffness, damping = self.stiffness, 2.0 * self.damping * math.sqrt(self.stiffness * rotor)
        for _ in range(PARTS):
            x, rate = self._angle - q, self._speed - v
            if x > self.gap / 2.0:
                meshing = max(stiffness * (x - self.gap / 2.0) + damping * rate, 0.0)
            elif x < -self.gap / 2.0:
                meshing = min(stiffness * (x + self.gap / 2.0) + damping * rate, 0.0)
            else:
                meshing = 0.0
            self._speed += h * (motor - meshing) / rotor
            self._angle += h * self._speed
            q += h * v
            total += meshing
        return total / PARTS - motor
