"""A joint whose motor turns a spring, and the spring the link."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import mujoco
from jaxtyping import Array, Float

from bayessim_jax.effects.contract import EffectParameter, ForceEffect, Memory, Moment, Number, Past, Scales, Values
from bayessim_jax.effects.places import driven_joints

__all__ = ["JointFlexibility"]

SLOPE = 16
"""Rows from which the acceleration is taken with which a memory begins."""
TINY = 1e-9


class JointFlexibility(ForceEffect):
    """J θ̈ = τ_m − τ_s,  τ_s = k (θ − q) + d (θ̇ − q̇): the link feels τ_s in place of the motor's τ_m.

    The rotor of inertia J is integrated implicitly, so that it is stable down to J = 0, where τ_s = τ_m and the joint
    is the stiff one of the model. k in N m/rad or N/m, d in N m s/rad or N s/m, J in kg m² or kg.

    Source: Spong 1987
    """

    name = "joint_flexibility"
    feels = True
    recalls = True

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
            EffectParameter("stiffness", unit, 0.01 * start, high, start, start, log=True, scan=24),
            EffectParameter(
                "damping",
                f"{scales.force_unit} s/{scales.unit}",
                0.02 * first,
                damping,
                first,
                first,
                log=True,
                form=0.1,
            ),
            EffectParameter("rotor_inertia", scales.inertia_unit, 0.0, 2.0 * inertia, 0.0, 0.3 * inertia),
        )

    def begin(self, values: Values, moment: Moment) -> Memory:
        """θ and θ̇ of a rotor that moves with the link, the spring bent by what it transmits."""
        rotor = values["rotor_inertia"]
        share = rotor / (moment.inertia + rotor)
        bend = (moment.drive - share * moment.inertia * moment.acceleration) / values["stiffness"]
        return moment.position + bend, moment.velocity

    def recall(self, values: Values, memory: Memory, past: Past, move: Number = 0.0) -> Memory:
        """θ and θ̇ of a rotor that rings while the link moves as recorded: J θ̈ + d θ̇ + k θ = τ_m + k q + d q̇.

        Exact for forces that are constant over a step. It begins with the acceleration of the first rows.
        """
        positions, velocities, drives, h = past.positions, past.velocities, past.drives, past.period
        k, d = values["stiffness"], values["damping"]
        rotor = jnp.maximum(values["rotor_inertia"], TINY * k * h**2)
        x = jnp.arange(min(len(velocities), SLOPE)) * h
        slope = jnp.sum((x - x.mean()) * velocities[: len(x)]) / jnp.maximum(jnp.sum((x - x.mean()) ** 2), TINY)
        begun = jnp.stack([positions[0] + (drives[0] - rotor * slope) / k, velocities[0]])
        between = [0.5 * (x[:-1] + x[1:]) for x in (positions, velocities)]
        rest = (drives + d * between[1]) / k + between[0]
        ahead = _ringing(0.5 * d / rotor, k / rotor, h)

        def once(now: Array, rest: Array) -> tuple[Array, None]:
            still = jnp.stack([rest, jnp.zeros_like(rest)])
            return still + ahead @ (now - still), None

        angle, speed = jax.lax.scan(once, begun, rest)[0]
        return angle, speed

    def force(self, values: Values, memory: Memory, moment: Moment) -> tuple[Number, Memory]:
        """τ_s − τ_m = −J θ̈."""
        angle, speed = memory
        k, d, rotor, h = values["stiffness"], values["damping"], values["rotor_inertia"], moment.h
        bend = angle - (moment.position + h * moment.velocity)
        torque = moment.drive - k * (bend + h * speed) - d * (speed - moment.velocity)
        acceleration = torque / (rotor + h * (k * h + d))
        after = speed + h * acceleration
        return -rotor * acceleration, (angle + h * after, after)


def _ringing(decay: Number, square: Number, h: float) -> Float[Array, "2 2"]:
    """exp(h A) of ẍ = −2 α ẋ − ω² x: α = `decay`, ω² = `square`."""
    room = decay**2 - square
    rings = room < 0.0
    r = jnp.sqrt(jnp.where(rings, -room, room) + TINY * square)
    wave = jnp.exp(-decay * h)
    slow, fast = jnp.exp((jnp.where(rings, 0.0, r) - decay) * h), jnp.exp(-(r + decay) * h)
    even = jnp.where(rings, wave * jnp.cos(r * h), 0.5 * (slow + fast))
    odd = jnp.where(rings, wave * jnp.sin(r * h), 0.5 * (slow - fast)) / r
    return jnp.array([[even + decay * odd, odd], [-square * odd, even - decay * odd]])
