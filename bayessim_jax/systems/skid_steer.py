"""Skid-steer robot: two sides of wheels that turn it by sliding it sideways, and a circle to follow."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from bayessim_jax.contracts import Box, Discrete, Recording, Scalar

__all__ = ["FollowCircle", "SkidSteer", "SkidSteerState"]


@struct.dataclass
class SkidSteerState:
    """Position x, y (m) and heading (rad, 0 = along x, not wrapped) of the centre, and its forward speed (m/s)."""

    x: Scalar
    y: Scalar
    yaw: Scalar
    speed: Scalar
    """Of the control period that ended here; nothing that follows depends on it."""


@struct.dataclass
class SkidSteer:
    """Unicycle whose instant centre of rotation lies x_ICR ahead of the robot's centre, driven by wheel speeds.

    With ω_L, ω_R the speeds of the left and right wheels (rad/s), held for a control period of 50 ms:

        v = r (ω_R + ω_L)/2,   ψ̇ = r (ω_R − ω_L)/d,   v_lat = −x_ICR ψ̇
        ẋ = v cos ψ − v_lat sin ψ,   ẏ = v sin ψ + v_lat cos ψ

    The solution over a period is exact, an arc of a circle. The wheels follow at once, whatever is asked of them; the
    box of the actions is where policies act.

    θ = (wheel_radius, axial_distance, icr_offset): r, d and x_ICR in m.

    Source: Kozłowski and Pazderski 2004
    """

    parameters: Box
    observations: Box
    actions: Box | Discrete
    noise: Float[Array, " obs"]
    dt: float = struct.field(pytree_node=False, default=0.05)

    @classmethod
    def create(
        cls,
        wheel_radius: tuple[float, float] = (0.04, 0.1),
        axial_distance: tuple[float, float] = (0.3, 0.7),
        icr_offset: tuple[float, float] = (-0.3, 0.3),
        noise: float = 0.01,
    ) -> SkidSteer:
        """A robot of half a metre, and sensor noise of the given standard deviation on every channel.

        The paper gives no prior. These ranges hold the robot of its authors' public code, 0.0625, 0.475 and 0.2 m;
        wheel speeds up to 10 rad/s take any robot in them around the circle of `FollowCircle` at its speed.
        """
        return cls(
            parameters=Box.create(
                wheel_radius=(*wheel_radius, "m"), axial_distance=(*axial_distance, "m"), icr_offset=(*icr_offset, "m")
            ),
            observations=Box.create(
                **{"base/x": (-2.0, 2.0, "m"), "base/y": (-2.0, 2.0, "m"), "base/yaw": (-6.3, 6.3, "rad")}
            ),
            actions=Box.create(**{"input/left": (-10.0, 10.0, "rad/s"), "input/right": (-10.0, 10.0, "rad/s")}),
            noise=jnp.full(3, noise),
        )

    def reset(self, key: PRNGKeyArray, theta: Float[Array, " d"]) -> SkidSteerState:
        """At rest near the origin, along x: x and y uniform in ±0.2 m, the heading in ±0.5 rad."""
        pose = jax.random.uniform(key, (3,), minval=-1.0, maxval=1.0) * jnp.array([0.2, 0.2, 0.5])
        return self.restart(theta, pose)

    def restart(self, theta: Float[Array, " d"], observation: Float[Array, " obs"]) -> SkidSteerState:
        """At rest in an observed pose, such as a row of a recording."""
        x, y, yaw = observation
        return SkidSteerState(x, y, yaw, jnp.zeros_like(x))

    def step(self, theta: Float[Array, " d"], state: SkidSteerState, action: Float[Array, " act"]) -> SkidSteerState:
        """One arc: the chord is shorter than the path by sin(α)/α, α half the turn, and points along ψ + α."""
        radius, distance, offset = theta[0], theta[1], theta[2]
        left, right = action[0], action[1]
        speed, rate = radius * (right + left) / 2, radius * (right - left) / distance
        sideways = -offset * rate
        half = rate * self.dt / 2
        length = self.dt * jnp.sinc(half / jnp.pi)
        cos, sin = jnp.cos(state.yaw + half), jnp.sin(state.yaw + half)
        return SkidSteerState(
            x=state.x + length * (speed * cos - sideways * sin),
            y=state.y + length * (speed * sin + sideways * cos),
            yaw=state.yaw + 2 * half,
            speed=speed,
        )

    def observe(self, theta: Float[Array, " d"], state: SkidSteerState) -> Float[Array, " obs"]:
        """The pose."""
        return jnp.stack([state.x, state.y, state.yaw])

    @staticmethod
    def features(recording: Recording) -> Float[Array, "steps features"]:
        """What networks read at each step: log r, log d and x_ICR as least squares have them from the rows so far.

        Where the robot was and which way it faced says nothing of θ. Ways are counted from the start of the recording,
        so that wheels that are late do not look smaller or further apart:

            s = r Σ (ω_R + ω_L) dt/2,   ψ = (r/d) Σ (ω_R − ω_L) dt,   l = −x_ICR ψ

        with s and l the ways ahead and to the left, in the robot's own frame. Each ratio is held near zero until
        there is something to tell.
        """
        poses, valid = recording.observations, recording.valid
        x, y, turn = jnp.moveaxis(poses[1:] - poses[:-1], -1, 0)
        yaw = (poses[1:, 2] + poses[:-1, 2]) / 2
        cos, sin = jnp.cos(yaw), jnp.sin(yaw)
        left, right = recording.actions.T * (recording.times[1:] - recording.times[:-1])
        moved = jnp.stack([cos * x + sin * y, cos * y - sin * x, turn, (left + right) / 2, right - left])
        ahead, aside, around, rolled, twisted = jnp.cumsum(jnp.where(valid, moved, 0.0), axis=1)

        def ratio(a: Float[Array, " steps"], b: Float[Array, " steps"], hold: float) -> Float[Array, " steps"]:
            return jnp.cumsum(a * b) / (jnp.cumsum(b * b) + hold)

        radius = 0.5 * jnp.log(ratio(ahead, rolled, 0.1) ** 2 + 1e-4)
        gain = 0.5 * jnp.log(ratio(around, twisted, 0.1) ** 2 + 1e-4)
        rows = jnp.stack([radius, radius - gain, -ratio(aside, around, 0.01)], axis=-1)
        return jnp.where(valid[:, None], rows, 0.0)


@struct.dataclass
class FollowCircle:
    """Follow a circle: reward −√(D² + (v − v₀)²), D the distance to the circle and v the forward speed.

    R = 0.75 m and v₀ = 0.2 m/s are the paper's. Here the circle touches the x axis at the origin, its centre at (0, R),
    and an episode of 25 s is once around and a little more. No episode ends early.

    Source: Possas et al. 2020, Sec. VI
    """

    steps: int = struct.field(pytree_node=False, default=500)
    radius: float = struct.field(pytree_node=False, default=0.75)
    speed: float = struct.field(pytree_node=False, default=0.2)

    def reward(self, state: SkidSteerState, action: Float[Array, " act"], next_state: SkidSteerState) -> Scalar:
        """Minus the cost of the state that the action led to."""
        distance = jnp.hypot(next_state.x, next_state.y - self.radius) - self.radius
        return -jnp.hypot(distance, next_state.speed - self.speed)

    def terminated(self, state: SkidSteerState) -> Bool[Array, ""]:
        """Never."""
        return jnp.zeros((), bool)
