"""Pendulum: a rod on a motor too weak to lift it at once, as in Gymnasium's `Pendulum-v1`."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from bayessim_jax.contracts import Box, Discrete, Scalar
from bayessim_jax.trigonometry import sincos

__all__ = ["Pendulum", "PendulumState", "SwingUp", "Upswing"]


@struct.dataclass
class PendulumState:
    """Angle (rad, 0 = upright) and angular velocity (rad/s)."""

    angle: Scalar
    angle_dot: Scalar


@struct.dataclass
class Pendulum:
    """Rod of length l and mass m, torque |u| ≤ 2 N m, speed |ω| ≤ 8 rad/s, semi-implicit Euler steps of 50 ms.

        ω̇ = 3 g sin φ/(2 l) + 3 u/(m l²),   g = 10 m/s²

    θ = (length, mass) in m and kg.

    Source: Towers et al. 2024, Pendulum-v1
    """

    parameters: Box
    observations: Box
    actions: Box | Discrete
    noise: Float[Array, " obs"]
    dt: float = struct.field(pytree_node=False, default=0.05)

    @classmethod
    def create(
        cls,
        length: tuple[float, float] = (0.1, 1.0),
        mass: tuple[float, float] = (0.1, 1.0),
        noise: float = 0.01,
    ) -> Pendulum:
        """The paper's prior ranges, and sensor noise of the given standard deviation on every channel."""
        return cls(
            parameters=Box.create(length=(*length, "m"), mass=(*mass, "kg")),
            observations=Box.create(cos=(-1.0, 1.0, ""), sin=(-1.0, 1.0, ""), angle_dot=(-8.0, 8.0, "rad/s")),
            actions=Box.create(torque=(-2.0, 2.0, "N m")),
            noise=jnp.full(3, noise),
        )

    def reset(self, key: PRNGKeyArray, theta: Float[Array, " d"]) -> PendulumState:
        """Angle uniform in ±π, angular velocity uniform in ±1."""
        angle, angle_dot = jax.random.uniform(key, (2,), minval=-1.0, maxval=1.0)
        return PendulumState(jnp.pi * angle, angle_dot)

    def restart(self, theta: Float[Array, " d"], observation: Float[Array, " obs"]) -> PendulumState:
        """The angle of the measured cosine and sine, which noise takes off the unit circle."""
        cos, sin, angle_dot = observation
        return PendulumState(jnp.arctan2(sin, cos), angle_dot)

    def step(self, theta: Float[Array, " d"], state: PendulumState, action: Float[Array, " act"]) -> PendulumState:
        """One semi-implicit Euler step."""
        length, mass = theta[0], theta[1]
        torque = jnp.clip(action[0], -2.0, 2.0)
        sine, _ = sincos(state.angle)
        acceleration = 3 * 10.0 / (2 * length) * sine + 3.0 / (mass * length**2) * torque
        angle_dot = jnp.clip(state.angle_dot + acceleration * self.dt, -8.0, 8.0)
        return PendulumState(state.angle + angle_dot * self.dt, angle_dot)

    def observe(self, theta: Float[Array, " d"], state: PendulumState) -> Float[Array, " obs"]:
        """Cosine and sine of the angle, and the angular velocity."""
        sine, cosine = sincos(state.angle)
        return jnp.stack([cosine, sine, state.angle_dot])


@struct.dataclass
class SwingUp:
    """Swing up and stay: reward −(φ² + 0.1 ω² + 0.001 u²) with φ wrapped to ±π; no episode ends early."""

    steps: int = struct.field(pytree_node=False, default=200)

    def reward(self, state: PendulumState, action: Float[Array, " act"], next_state: PendulumState) -> Scalar:
        """Minus the cost of the state in which the action was taken."""
        angle = jnp.mod(state.angle + jnp.pi, 2 * jnp.pi) - jnp.pi
        torque = jnp.clip(action[0], -2.0, 2.0)
        return -(angle**2 + 0.1 * state.angle_dot**2 + 0.001 * torque**2)

    def terminated(self, state: PendulumState) -> Bool[Array, ""]:
        """Never."""
        return jnp.zeros((), bool)


@struct.dataclass
class Upswing:
    """Swing up and stay, as DISCO is told: reward −(50 (cos φ − 1)² + ω²) of the state reached; no episode ends early.

    Source: Barcelos et al. 2020
    """

    steps: int = struct.field(pytree_node=False, default=200)

    def reward(self, state: PendulumState, action: Float[Array, " act"], next_state: PendulumState) -> Scalar:
        """Minus the cost of the state that the action led to."""
        _, cosine = sincos(next_state.angle)
        return -(50.0 * (cosine - 1.0) ** 2 + next_state.angle_dot**2)

    def terminated(self, state: PendulumState) -> Bool[Array, ""]:
        """Never."""
        return jnp.zeros((), bool)
