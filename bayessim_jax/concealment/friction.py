"""Friction and drag at a joint."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from bayessim_jax.concealment.bristle import ROUND, STIFF, draw_rounding, grip
from bayessim_jax.concealment.law import ForceLaw, ModelLaw, Spot
from bayessim_jax.concealment.places import driven_joints

if TYPE_CHECKING:
    from bayessim_jax.concealment.world import World

__all__ = [
    "AsymmetricFriction",
    "CoulombFriction",
    "LoadDependentFriction",
    "LuGreFriction",
    "QuadraticDrag",
    "StribeckFriction",
    "ViscousFriction",
]


BRAKED = 1 / 3
"""Share of machines whose Coulomb friction is a constraint of MuJoCo's own solver."""
BRAKING = 945.0
"""1/s: the acceleration against a speed below which such a constraint creeps, over that speed, by MuJoCo's defaults
b d/(1 − d) with b = 2/(0.95 · 0.02 s) and d = 0.9."""
SHARP = 0.2
"""Of Stribeck's velocity: a sign that is rounded over more of it hides what falls there."""


@dataclass
class ViscousFriction(ForceLaw):
    """τ = −b v."""

    name = "viscous_friction"
    viscous: float

    @classmethod
    def make(cls, spot: Spot, amplitude: float, rng: np.random.Generator) -> ViscousFriction:
        """B in units of the joint's force over its speed."""
        return cls(spot, 2.0 * amplitude * spot.force / spot.speed)

    def force(self, world: World, q: float, v: float) -> float:
        """Against the velocity."""
        return -self.viscous * v


@dataclass
class QuadraticDrag(ForceLaw):
    """τ = −c v √(v² + ε²): c v|v| without its corner, ε 2 % of the joint's speed."""

    name = "quadratic_drag"
    coefficient: float

    @classmethod
    def make(cls, spot: Spot, amplitude: float, rng: np.random.Generator) -> QuadraticDrag:
        """C in units of the joint's force over its speed squared."""
        return cls(spot, 3.0 * amplitude * spot.force / spot.speed**2)

    def force(self, world: World, q: float, v: float) -> float:
        """Against the velocity."""
        return -self.coefficient * v * math.hypot(v, 0.02 * self.spot.speed)


class DryFriction(ForceLaw):
    """What holds a joint: stiff bristles, or a sign that is rounded."""

    rounding: float
    """ε, rad/s or m/s; 0 with bristles."""

    def begin(self, world: World, rng: np.random.Generator) -> None:
        """With bristles that are not bent."""
        self._grip = grip(self.spot, self.rounding)


@dataclass
class CoulombFriction(DryFriction):
    """τ = −F_c sign(v): a stiff bristle, which slips at F_c and holds at rest; −F_c tanh(v/ε); or a `Brake`."""

    name = "coulomb_friction"
    coulomb: float
    rounding: float = 0.0

    @classmethod
    def make(cls, spot: Spot, amplitude: float, rng: np.random.Generator) -> CoulombFriction | Brake:
        """F_c in units of the joint's force; a `Brake` creeps at no more of the speed than a rounded sign."""
        level = amplitude * spot.force
        rounding, creeps = draw_rounding(spot, level, rng), level / (BRAKING * spot.inertia)
        brake = rng.uniform() < BRAKED and creeps <= ROUND[1] * spot.speed
        return Brake.make(spot, amplitude, rng) if brake else cls(spot, level, rounding)

    def force(self, world: World, q: float, v: float) -> float:
        """The bristles', or that of a rounded sign."""
        return self._grip.pull(v, self.coulomb, self.coulomb)


@dataclass
class Brake(ModelLaw):
    """Dry friction by a constraint of MuJoCo's solver (`frictionloss`), of which a moving joint feels F_c, too."""

    name = "coulomb_friction"
    coulomb: float

    @classmethod
    def make(cls, spot: Spot, amplitude: float, rng: np.random.Generator) -> Brake:
        """F_c in units of the joint's force."""
        return cls(spot, amplitude * spot.force)

    def edit(self, model: mujoco.MjModel) -> None:
        """Added to what the model has."""
        model.dof_frictionloss[self.spot.v] += self.coulomb


@dataclass
class StribeckFriction(DryFriction):
    """A stiff bristle that slips at g(v) = F_c + (F_s − F_c)/(1 + (v/v_s)²), or −g(v) tanh(v/ε)."""

    name = "stribeck_friction"
    coulomb: float
    static: float
    velocity: float
    rounding: float = 0.0

    @classmethod
    def make(cls, spot: Spot, amplitude: float, rng: np.random.Generator) -> StribeckFriction:
        """F_c in units of the joint's force, F_s 1.6 to 2.2 times as much, v_s 8 to 15 % of the joint's speed."""
        coulomb = 0.8 * amplitude * spot.force
        static, velocity = rng.uniform(1.6, 2.2) * coulomb, rng.uniform(0.08, 0.15) * spot.speed
        return cls(spot, coulomb, static, velocity, min(draw_rounding(spot, static, rng), SHARP * velocity))

    def force(self, world: World, q: float, v: float) -> float:
        """The bristles', or that of a rounded sign."""
        level = self.coulomb + (self.static - self.coulomb) / (1.0 + (v / self.velocity) ** 2)
        return self._grip.pull(v, level, level)


@dataclass
class AsymmetricFriction(DryFriction):
    """A stiff bristle that slips at F₊ where v > 0 and at F₋ where v < 0, or −F± tanh(v/ε)."""

    name = "asymmetric_friction"
    positive: float
    negative: float
    rounding: float = 0.0

    @classmethod
    def make(cls, spot: Spot, amplitude: float, rng: np.random.Generator) -> AsymmetricFriction:
        """One level in units of the joint's force, the other 30 to 60 % of it."""
        large = 1.2 * amplitude * spot.force
        small = rng.uniform(0.3, 0.6) * large
        levels = (large, small) if rng.uniform() < 0.5 else (small, large)
        return cls(spot, *levels, draw_rounding(spot, large, rng))

    def force(self, world: World, q: float, v: float) -> float:
        """The bristles', or that of a rounded sign."""
        return self._grip.pull(v, self.negative, self.positive)


@dataclass
class LoadDependentFriction(DryFriction):
    """A stiff bristle that slips at F_c + K √(τ² + ε²), τ what the motors exert: ε 1 % of the joint's force.

    Or that level times −tanh(v/ε_v).
    """

    name = "load_dependent_friction"
    coulomb: float
    gain: float
    rounding: float = 0.0

    @classmethod
    def places(cls, model: mujoco.MjModel) -> list[str]:
        """Every joint that is driven."""
        return driven_joints(model)

    @classmethod
    def make(cls, spot: Spot, amplitude: float, rng: np.random.Generator) -> LoadDependentFriction:
        """K, and F_c 15 to 40 % of K times the joint's force."""
        level = rng.uniform(0.15, 0.4) * amplitude * spot.force
        return cls(spot, level, amplitude, draw_rounding(spot, amplitude * spot.force, rng))

    def force(self, world: World, q: float, v: float) -> float:
        """The bristles', or that of a rounded sign."""
        level = self.coulomb + self.gain * math.hypot(world.motor(self.spot.joint), 0.01 * self.spot.force)
        return self._grip.pull(v, level, level)


@dataclass
class LuGreFriction(ForceLaw):
    """τ = −(σ₀ z + σ₁ ż), ż = v − σ₀|v|z/g(v), g(v) = F_c + (F_s − F_c)/(1 + (v/v_s)²), integrated in closed form.

    Soft enough that the bristles' bending is seen.

    Source: Canudas de Wit, Olsson, Åström and Lischinsky 1995
    """

    name = "lugre_friction"
    stiffness: float
    damping: float
    coulomb: float
    static: float
    velocity: float

    @classmethod
    def make(cls, spot: Spot, amplitude: float, rng: np.random.Generator) -> LuGreFriction:
        """Levels as of Stribeck friction; σ₀ such that the bristles bend by 4 to 10 % of the joint's reach."""
        coulomb = 0.8 * amplitude * spot.force
        static, velocity = rng.uniform(1.3, 1.8) * coulomb, rng.uniform(0.08, 0.15) * spot.speed
        stiffest = spot.inertia * (STIFF / spot.h) ** 2
        stiffness = min(static / (rng.uniform(0.04, 0.1) * spot.reach), stiffest)
        return cls(spot, stiffness, 0.6 * math.sqrt(stiffness * spot.inertia), coulomb, static, velocity)

    def begin(self, world: World, rng: np.random.Generator) -> None:
        """With bristles that are not bent."""
        self._bend = 0.0

    def force(self, world: World, q: float, v: float) -> float:
        """The bristles'."""
        if self.static <= 0.0:
            return 0.0
        level = self.coulomb + (self.static - self.coulomb) / (1.0 + (v / self.velocity) ** 2)
        before, end = self._bend, math.copysign(level / self.stiffness, v)
        decay = math.exp(-self.stiffness * abs(v) * world.h / level)
        self._bend = end + (before - end) * decay
        return -(self.stiffness * self._bend + self.damping * (self._bend - before) / world.h)
