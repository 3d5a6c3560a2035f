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

__all__ = ["OnVehicle", "SkidSteerVehicle", "VehicleState"]


@struct.dataclass
class VehicleState:
    """The robot, and how fast each side's wheels turn (rad/s)."""

    robot: SkidSteerState
    wheels: Float[Array, "2"]


@struct.dataclass
class SkidSteerVehicle:
    """`SkidSteer` whose wheels follow their commands late and within limits, and slip as the ground under them does.

    Commands are cut by `ActuatorSaturation` and pass `ActuatorLag`; what arrives at the wheels passes `WheelSlip`.
    Beyond the line y = `border`, across which the ground changes within a hand's breadth, the ground is loose. θ and
    the noise of the sensors are the robot's.
    """

    robot: SkidSteer
    limit: float | Scalar = 9.0
    """rad/s."""
    lag: float | Scalar = 0.12
    """Time constant of the powertrain, s."""
    firm: tuple[float, float] = (0.02, 0.05)
    """Longitudinal and lateral slip on firm ground."""
    loose: tuple[float, float] = (0.08, 0.2)
    """The same on loose ground."""
    border: float | Scalar = 0.75
    """Half of the circle of `FollowCircle` lies on each side, m."""

    @property
    def parameters(self) -> Box:
        """The robot's."""
        return self.robot.parameters

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

    def reset(self, key: PRNGKeyArray, theta: Float[Array, " d"]) -> VehicleState:
        """As the robot's, with still wheels."""
        return VehicleState(self.robot.reset(key, theta), jnp.zeros(2))

    def step(self, theta: Float[Array, " d"], state: VehicleState, action: Float[Array, " act"]) -> VehicleState:
        """One control period on the ground where it begins."""
        moment = Moment(jnp.zeros(()), self.dt)
        wanted, _ = ActuatorSaturation().command({"limit": jnp.asarray(self.limit)}, (), action, moment)
        lag = {"time_constant": jnp.asarray(self.lag)}
        arrived, wheels = ActuatorLag().command(lag, state.wheels, wanted, moment)
        share = jax.nn.sigmoid((state.robot.y - self.border) / 0.03)
        slip = [firm + share * (loose - firm) for firm, loose in zip(self.firm, self.loose, strict=True)]
        values = {"longitudinal": slip[0], "lateral": slip[1]}
        moved, _ = WheelSlip().command(values, (), (arrived[0], arrived[1]), moment)
        return VehicleState(self.robot.step(theta, state.robot, jnp.stack(moved)), wheels)

    def observe(self, theta: Float[Array, " d"], state: VehicleState) -> Float[Array, " obs"]:
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
