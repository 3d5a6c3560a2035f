"""Cart-pole: a pole on a cart that is pushed left or right, as in Gymnasium's `CartPole-v1`."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from bayessim_jax.contracts import Box, Discrete, Scalar

__all__ = ["Balance", "CartPole", "CartPoleState", "Centre"]


@struct.dataclass
class CartPoleState:
    """Cart position x (m) and velocity (m/s), pole angle (rad, 0 = upright) and angular velocity (rad/s)."""

    x: Scalar
    x_dot: Scalar
    angle: Scalar
    angle_dot: Scalar


@struct.dataclass
class CartPole:
    """Pole of half-length l and mass m on a cart of mass M, force u = ±10 N, Euler steps of 20 ms.

    With w = (u + m l ω² sin φ)/(M + m):

        ω̇ = (g sin φ − w cos φ) / (l (4/3 − m cos² φ/(M + m))),   v̇ = w − m l ω̇ cos φ/(M + m)

    θ = (length, mass): half the pole's length (the `length` of Gymnasium's environment), m, and its mass, kg.

    Source: Barto, Sutton and Anderson 1983
    """

    parameters: Box
    observations: Box
    noise: Float[Array, " obs"]
    actions: Box | Discrete = struct.field(pytree_node=False, default=Discrete(2, ("push",), ("index",)))
    dt: float = struct.field(pytree_node=False, default=0.02)

    @classmethod
    def create(
        cls,
        length: tuple[float, float] = (0.1, 1.0),
        mass: tuple[float, float] = (0.1, 1.0),
        noise: float = 0.01,
    ) -> CartPole:
        """The paper's prior ranges, and sensor noise of the given standard deviation on every channel."""
        return cls(
            parameters=Box.create(length=(*length, "m"), mass=(*mass, "kg")),
            observations=Box.create(
                x=(-2.4, 2.4, "m"),
                x_dot=(-3.0, 3.0, "m/s"),
                angle=(-0.21, 0.21, "rad"),
                angle_dot=(-3.0, 3.0, "rad/s"),
            ),
            noise=jnp.full(4, noise),
        )

    def reset(self, key: PRNGKeyArray, theta: Float[Array, " d"]) -> CartPoleState:
        """Every coordinate uniform in ±0.05."""
        return CartPoleState(*jax.random.uniform(key, (4,), minval=-0.05, maxval=0.05))

    def restart(self, theta: Float[Array, " d"], observation: Float[Array, " obs"]) -> CartPoleState:
        """All four coordinates are seen."""
        return CartPoleState(*observation)

    def step(self, theta: Float[Array, " d"], state: CartPoleState, action: Float[Array, " act"]) -> CartPoleState:
        """One explicit Euler step."""
        length, mass = theta[0], theta[1]
        total = mass + 1.0
        force = jnp.where(action[0] > 0.5, 10.0, -10.0)
        cos, sin = jnp.cos(state.angle), jnp.sin(state.angle)
        push = (force + mass * length * state.angle_dot**2 * sin) / total
        angle_acc = (9.8 * sin - cos * push) / (length * (4.0 / 3.0 - mass * cos**2 / total))
        x_acc = push - mass * length * angle_acc * cos / total
        return CartPoleState(
            x=state.x + self.dt * state.x_dot,
            x_dot=state.x_dot + self.dt * x_acc,
            angle=state.angle + self.dt * state.angle_dot,
            angle_dot=state.angle_dot + self.dt * angle_acc,
        )

    def observe(self, theta: Float[Array, " d"], state: CartPoleState) -> Float[Array, " obs"]:
        """All four coordinates."""
        return jnp.stack([state.x, state.x_dot, state.angle, state.angle_dot])


@struct.dataclass
class Balance:
    """Keep the pole up: +1 for every step, until |x| > 2.4 m or |φ| > 12°."""

    steps: int = struct.field(pytree_node=False, default=500)

    def reward(self, state: CartPoleState, action: Float[Array, " act"], next_state: CartPoleState) -> Scalar:
        """One for every step taken."""
        return jnp.ones_like(state.x)

    def terminated(self, state: CartPoleState) -> Bool[Array, ""]:
        """Out of the track or fallen."""
        return (jnp.abs(state.x) > 2.4) | (jnp.abs(state.angle) > 12 * 2 * jnp.pi / 360)


@struct.dataclass
class Centre:
    """Keep the pole up and the cart at the centre, as DISCO is told: reward −(x² + 500 sin² φ + v² + ω²).

    An episode ends as that of `Balance` does.

    Source: Barcelos et al. 2020
    """

    steps: int = struct.field(pytree_node=False, default=500)

    def reward(self, state: CartPoleState, action: Float[Array, " act"], next_state: CartPoleState) -> Scalar:
        """Minus the cost of the state that the action led to."""
        upright = 500.0 * jnp.sin(next_state.angle) ** 2
        return -(next_state.x**2 + upright + next_state.x_dot**2 + next_state.angle_dot**2)

    def terminated(self, state: CartPoleState) -> Bool[Array, ""]:
        """Out of the track or fallen."""
        return Balance(self.steps).terminated(state)
