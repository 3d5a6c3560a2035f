"""Acrobot: two links, a motor at the elbow only, as in Gymnasium's `Acrobot-v1`."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from bayessim_jax.contracts import Box, Discrete, Scalar

__all__ = ["Acrobot", "AcrobotState", "Raise"]


@struct.dataclass
class AcrobotState:
    """Angle of the first link (rad, 0 = hanging), angle of the second against the first, and their rates (rad/s)."""

    angle1: Scalar
    angle2: Scalar
    rate1: Scalar
    rate2: Scalar


@struct.dataclass
class Acrobot:
    """Two links of masses m₁, m₂ and lengths l₁, l₂, centres of mass half-way, torque −1, 0 or 1 N m at the elbow.

    The equations of Sutton and Barto's book with a moment of inertia of 1 kg m² for each link, integrated by one
    Runge-Kutta step (order 4) of 0.2 s; rates are clipped at 4π and 9π rad/s.

    θ = (mass1, mass2, length1, length2) in kg and m.

    Source: Sutton and Barto 1998, ch. 11
    """

    parameters: Box
    observations: Box
    noise: Float[Array, " obs"]
    actions: Box | Discrete = struct.field(pytree_node=False, default=Discrete(3, ("torque",), ("index",)))
    dt: float = struct.field(pytree_node=False, default=0.2)

    @classmethod
    def create(
        cls,
        mass1: tuple[float, float] = (0.5, 2.0),
        mass2: tuple[float, float] = (0.5, 2.0),
        length1: tuple[float, float] = (0.1, 1.5),
        length2: tuple[float, float] = (0.1, 1.5),
        noise: float = 0.01,
    ) -> Acrobot:
        """The paper's prior ranges, and sensor noise of the given standard deviation on every channel."""
        one, rate = (-1.0, 1.0, ""), "rad/s"
        return cls(
            parameters=Box.create(
                mass1=(*mass1, "kg"), mass2=(*mass2, "kg"), length1=(*length1, "m"), length2=(*length2, "m")
            ),
            observations=Box.create(
                cos1=one, sin1=one, cos2=one, sin2=one, rate1=(-4.0, 4.0, rate), rate2=(-9.0, 9.0, rate)
            ),
            noise=jnp.full(6, noise),
        )

    def reset(self, key: PRNGKeyArray, theta: Float[Array, " d"]) -> AcrobotState:
        """Every coordinate uniform in ±0.1."""
        return AcrobotState(*jax.random.uniform(key, (4,), minval=-0.1, maxval=0.1))

    def restart(self, theta: Float[Array, " d"], observation: Float[Array, " obs"]) -> AcrobotState:
        """The angles of the measured cosines and sines, and both rates."""
        cos1, sin1, cos2, sin2, rate1, rate2 = observation
        return AcrobotState(jnp.arctan2(sin1, cos1), jnp.arctan2(sin2, cos2), rate1, rate2)

    def step(self, theta: Float[Array, " d"], state: AcrobotState, action: Float[Array, " act"]) -> AcrobotState:
        """One Runge-Kutta step; angles are wrapped to ±π."""
        torque = action[0] - 1.0
        x = (state.angle1, state.angle2, state.rate1, state.rate2)

        def shifted(slope: tuple[Scalar, ...], h: float) -> tuple[Scalar, ...]:
            return tuple(a + h * b for a, b in zip(x, slope, strict=True))

        k1 = _derivative(theta, x, torque)
        k2 = _derivative(theta, shifted(k1, self.dt / 2), torque)
        k3 = _derivative(theta, shifted(k2, self.dt / 2), torque)
        k4 = _derivative(theta, shifted(k3, self.dt), torque)
        angle1, angle2, rate1, rate2 = (
            a + self.dt / 6.0 * (s1 + 2 * s2 + 2 * s3 + s4) for a, s1, s2, s3, s4 in zip(x, k1, k2, k3, k4, strict=True)
        )
        return AcrobotState(
            angle1=_wrap(angle1),
            angle2=_wrap(angle2),
            rate1=jnp.clip(rate1, -4 * jnp.pi, 4 * jnp.pi),
            rate2=jnp.clip(rate2, -9 * jnp.pi, 9 * jnp.pi),
        )

    def observe(self, theta: Float[Array, " d"], state: AcrobotState) -> Float[Array, " obs"]:
        """Cosine and sine of both angles, and both rates."""
        a, b = state.angle1, state.angle2
        return jnp.stack([jnp.cos(a), jnp.sin(a), jnp.cos(b), jnp.sin(b), state.rate1, state.rate2])


@struct.dataclass
class Raise:
    """Bring the tip above the line: −1 for every step, until −cos φ₁ − cos(φ₁ + φ₂) > 1."""

    steps: int = struct.field(pytree_node=False, default=500)

    def reward(self, state: AcrobotState, action: Float[Array, " act"], next_state: AcrobotState) -> Scalar:
        """Minus one, and zero for the step that gets there."""
        return jnp.where(self.terminated(next_state), 0.0, -1.0)

    def terminated(self, state: AcrobotState) -> Bool[Array, ""]:
        """The tip is above the line."""
        return -jnp.cos(state.angle1) - jnp.cos(state.angle1 + state.angle2) > 1.0


def _wrap(angle: Scalar) -> Scalar:
    """The same angle in [−π, π]; exact where it is inside already."""
    return angle - 2 * jnp.pi * jnp.round(angle / (2 * jnp.pi))


def _derivative(theta: Float[Array, " d"], x: tuple[Scalar, ...], torque: Scalar) -> tuple[Scalar, ...]:
    m1, m2, l1, l2 = theta[0], theta[1], theta[2], theta[3]
    c1, c2, g, inertia = l1 / 2, l2 / 2, 9.8, 1.0
    angle1, angle2, rate1, rate2 = x
    cos2, sin2 = jnp.cos(angle2), jnp.sin(angle2)
    d1 = m1 * c1**2 + m2 * (l1**2 + c2**2 + 2 * l1 * c2 * cos2) + inertia + inertia
    d2 = m2 * (c2**2 + l1 * c2 * cos2) + inertia
    phi2 = m2 * c2 * g * jnp.sin(angle1 + angle2)
    phi1 = (
        -m2 * l1 * c2 * rate2**2 * sin2
        - 2 * m2 * l1 * c2 * rate2 * rate1 * sin2
        + (m1 * c1 + m2 * l1) * g * jnp.sin(angle1)
        + phi2
    )
    acc2 = (torque + d2 / d1 * phi1 - m2 * l1 * c2 * rate1**2 * sin2 - phi2) / (m2 * c2**2 + inertia - d2**2 / d1)
    acc1 = -(d2 * acc2 + phi1) / d1
    return rate1, rate2, acc1, acc2
