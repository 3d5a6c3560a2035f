"""A skid-steer vehicle with what its model leaves out: a target to control, not a model to infer with."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float, PRNGKeyArray

from bayessim_jax.contracts import Box, Scalar
from bayessim_jax.effects.actuator_lag import ActuatorLag
from bayessim_jax.effects.actuator_saturation import ActuatorSaturation
from bayessim_jax.effects.contract import Moment
from bayessim_jax.effects.wheel_slip import WheelSlip
from bayessim_jax.systems.skid_steer import SkidSteer, SkidSteerState

__all__ = ["TERRAINS", "OnVehicle", "SkidSteerVehicle", "VehicleState"]


@struct.dataclass
class VehicleState:
    """The robot, and how fast each side's wheels turn (rad/s)."""

    robot: SkidSteerState
    wheels: Float[Array, "2"]


TERRAINS: dict[str, dict[str, float]] = {
    "yard": {"slip": 0.02, "turning_slip": 0.05, "looseness": 4.0},
    "asphalt": {"slip": 0.02, "turning_slip": 0.05, "looseness": 1.0},
    "gravel": {"slip": 0.08, "turning_slip": 0.2, "looseness": 1.0},
    "ice": {"slip": 0.3, "turning_slip": 0.45, "looseness": 1.0},
}
"""What the ground does to the vehicle; a yard is asphalt on one half and gravel on the other."""

_OWN = {"slip": (0.0, 0.9, ""), "turning_slip": (0.0, 0.9, ""), "looseness": (0.0, 10.0, ""), "lag": (0.0, 0.5, "s")}
_USUAL = {**TERRAINS["yard"], "lag": 0.12}
_MOST_SLIP = 0.95


@struct.dataclass
class SkidSteerVehicle:
    """`SkidSteer` whose wheels follow their commands late and within limits, and slip as the ground under them does.

    Commands are cut by `ActuatorSaturation` and pass `ActuatorLag`; what arrives at the wheels passes `WheelSlip`.
    Beyond the line y = `border`, across which the ground changes within a hand's breadth, it slips `looseness` times as
    much. The noise of the sensors is the robot's.

    θ is the robot's, then (slip, turning_slip, looseness, lag): what is lost of speed and of the turning rate, and the
    time constant of the powertrain in s. No one infers the latter, but they may change as θ does.
    """

    robot: SkidSteer
    limit: float | Scalar = 9.0
    """rad/s."""
    border: float | Scalar = 0.75
    """Half of the circle of `FollowCircle` lies on each side, m."""

    @property
    def parameters(self) -> Box:
        """The robot's, and its own."""
        robot, own = self.robot.parameters, Box.create(**_OWN)
        return Box(
            low=jnp.concatenate([robot.low, own.low]),
            high=jnp.concatenate([robot.high, own.high]),
            names=robot.names + own.names,
            units=robot.units + own.units,
        )

    def theta(self, robot: Float[Array, " d"], **own: float | Scalar) -> Float[Array, " all"]:
        """θ of the vehicle from that of the robot; what is not given of its own is as in the yard."""
        return jnp.concatenate([jnp.asarray(robot), jnp.stack([jnp.asarray(v) for v in ({**_USUAL, **own}).values()])])

    def apparent(self, theta: Float[Array, " all"]) -> Float[Array, " d"]:
        """θ of the robot that would move like the vehicle once its wheels turn as asked, on the average ground:

            r (1 − s),   d (1 − s)/(1 − c),   x_ICR

        with s and c the slips, averaged over both sides of the border.
        """
        radius, distance, offset, slip, turning, looseness, _ = theta
        s, c = (jnp.minimum(0.5 * (1.0 + looseness) * lost, _MOST_SLIP) for lost in (slip, turning))
        return jnp.stack([radius * (1.0 - s), distance * (1.0 - s) / (1.0 - c), offset])

    @property
    def actions(self) -> Any:
        """The robot's."""
        return self.robot.actions

    @property
    def observations(self) -> Box:
        """The robot's."""
        return self.robot.observations

    @property
    def noise(self) -> Float[Array, " obs"]:
        """The robot's."""
        return self.robot.noise

    @property
    def dt(self) -> float:
        """One control period, s."""
        return self.robot.dt

    def reset(self, key: PRNGKeyArray, theta: Float[Array, " all"]) -> VehicleState:
        """As the robot's, with still wheels."""
        return VehicleState(self.robot.reset(key, theta), jnp.zeros(2))

    def step(self, theta: Float[Array, " all"], state: VehicleState, action: Float[Array, " act"]) -> VehicleState:
        """One control period on the ground where it begins."""
        slip, turning, looseness, lag = theta[3:]
        moment = Moment(jnp.zeros(()), self.dt)
        wanted, _ = ActuatorSaturation().command({"limit": jnp.asarray(self.limit)}, (), action, moment)
        arrived, wheels = ActuatorLag().command({"time_constant": lag}, state.wheels, wanted, moment)
        share = jax.nn.sigmoid((state.robot.y - self.border) / 0.03)
        more = 1.0 + share * (looseness - 1.0)
        values = {
            name: jnp.minimum(more * lost, _MOST_SLIP) for name, lost in (("longitudinal", slip), ("lateral", turning))
        }
        moved, _ = WheelSlip().command(values, (), (arrived[0], arrived[1]), moment)
        return VehicleState(self.robot.step(theta, state.robot, jnp.stack(moved)), wheels)

    def observe(self, theta: Float[Array, " all"], state: VehicleState) -> Float[Array, " obs"]:
        """The pose."""
        return self.robot.observe(theta, state.robot)


@struct.dataclass
class OnVehicle:
    """A task of the robot as one of the vehicle."""

    task: Any

    @property
    def steps(self) -> int:
        """The robot's."""
        return self.task.steps

    def reward(self, state: VehicleState, action: Float[Array, " act"], next_state: VehicleState) -> Scalar:
        """The robot's."""
        return self.task.reward(state.robot, action, next_state.robot)

    def terminated(self, state: VehicleState) -> Array:
        """The robot's."""
        return self.task.terminated(state.robot)
