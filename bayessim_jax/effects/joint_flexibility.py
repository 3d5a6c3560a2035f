"""A joint whose motor turns a spring, and the spring the link."""

from __future__ import annotations

import mujoco

from bayessim_jax.effects.contract import EffectParameter, ForceEffect, Memory, Moment, Number, Scales, Values
from bayessim_jax.effects.places import driven_joints

__all__ = ["JointFlexibility"]


class JointFlexibility(ForceEffect):
    """J θ̈ = τ_m − τ_s,  τ_s = k (θ − q) + d (θ̇ − q̇): the link feels τ_s in place of the motor's τ_m.

    The rotor of inertia J is integrated implicitly, so that it is stable down to J = 0, where τ_s = τ_m and the joint
    is the stiff one of the model. k in N m/rad or N/m, d in N m s/rad or N s/m, J in kg m² or kg.

    Source: Spong 1987
    """

    name = "joint_flexibility"

    def places(self, model: mujoco.MjModel) -> list[str]:
        """Every hinge and slide that an actuator drives."""
        return driven_joints(model)

    def parameters(self, place: str, scales: Scales) -> tuple[EffectParameter, ...]:
        """k, d and J; the stiffness stays below what the time step can follow."""
        high, inertia = 0.5 * scales.stiffest, scales.inertia
        start = min(0.1 * high, 30.0 * inertia * (scales.speed / scales.position) ** 2)
        damping = 0.2 * inertia / scales.timestep
        first = min(0.1 * damping, 0.2 * (start * inertia) ** 0.5)
        unit = f"{scales.force_unit}/{scales.unit}"
        return (
            EffectParameter("stiffness", unit, 0.01 * start, high, start, start, log=True, scan=6),
            EffectParameter("damping", f"{scales.force_unit} s/{scales.unit}", 0.0, damping, 0.0, first),
            EffectParameter("rotor_inertia", scales.inertia_unit, 0.0, 2.0 * inertia, 0.0, 0.1 * inertia),
        )

    def begin(self, values: Values, moment: Moment) -> Memory:
        """θ and θ̇ of a rotor that moves with the link, the spring bent by what it transmits."""
        rotor = values["rotor_inertia"]
        share = rotor / (moment.inertia + rotor)
        bend = (moment.drive - share * moment.inertia * moment.acceleration) / values["stiffness"]
        return moment.position + bend, moment.velocity

    def force(self, values: Values, memory: Memory, moment: Moment) -> tuple[Number, Memory]:
        """τ_s − τ_m = −J θ̈."""
        angle, speed = memory
        k, d, rotor, h = values["stiffness"], values["damping"], values["rotor_inertia"], moment.h
        bend = angle - (moment.position + h * moment.velocity)
        torque = moment.drive - k * (bend + h * speed) - d * (speed - moment.velocity)
        acceleration = torque / (rotor + h * (k * h + d))
        after = speed + h * acceleration
        return -rotor * acceleration, (angle + h * after, after)
