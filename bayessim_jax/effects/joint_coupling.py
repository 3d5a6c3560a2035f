"""One joint acting on another: a belt, a tendon, a cable."""

from __future__ import annotations

import mujoco

from bayessim_jax.effects.contract import EffectParameter, ForceEffect, Memory, Moment, Number, Scales, Values
from bayessim_jax.effects.places import detail, driven_joints, joints

__all__ = ["JointCoupling"]


class JointCoupling(ForceEffect):
    """τⱼ = k x of joint i: its motor's torque, its position or its velocity, as the place says.

    `joint/elbow#torque/shoulder` is what the shoulder's motor exerts on the elbow. k has no unit, or is in N m/rad or
    N m s/rad (N for N m where j slides, m for rad where i does).
    """

    name = "joint_coupling"

    def places(self, model: mujoco.MjModel) -> list[str]:
        """Every pair of hinges and slides, each in three ways, `torque` where an actuator drives joint i."""
        named, driven = joints(model), set(driven_joints(model))
        return [
            f"{j}#{way}/{i.removeprefix('joint/')}"
            for j in named
            for i in named
            for way in ("torque", "position", "velocity")
            if i != j and (way != "torque" or i in driven)
        ]

    def parameters(self, place: str, scales: Scales) -> tuple[EffectParameter, ...]:
        """The gain k."""
        way, force = detail(place).partition("/")[0], scales.force_unit
        high, unit = {
            "torque": (1.0, ""),
            "position": (2.0 * scales.force / scales.other_position, f"{force}/{scales.other_unit}"),
            "velocity": (scales.force / scales.other_speed, f"{force} s/{scales.other_unit}"),
        }[way]
        return (EffectParameter("gain", unit, -high, high, 0.0, 0.1 * high),)

    def force(self, values: Values, memory: Memory, moment: Moment) -> tuple[Number, Memory]:
        """In proportion to what the other joint does."""
        way = moment.detail.partition("/")[0]
        other: Moment = moment.other
        return values["gain"] * {"torque": other.drive, "position": other.position}.get(way, other.velocity), memory
