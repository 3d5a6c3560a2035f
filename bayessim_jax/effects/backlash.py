"""Play between a motor and the joint that it drives."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import mujoco
from jaxtyping import Array

from bayessim_jax.effects.contract import EffectParameter, ForceEffect, Memory, Moment, Number, Past, Scales, Values
from bayessim_jax.effects.open_form import OpenForm
from bayessim_jax.effects.places import driving_actuators

__all__ = ["Backlash"]

PARTS = 8
"""Steps of a motor that is recalled in one of the recording."""
TINY = 1e-12


class Backlash(OpenForm, ForceEffect):
    """J θ̈ = τ_m − λ, |θ − q| ≤ g/2: the motor turns freely within the gap, and meshes without bouncing at its ends.

    The joint feels λ in place of the motor's τ_m. λ is what brings the two to the end of the gap within the time step,
    λ = μ (x' ∓ g/2)/h² with 1/μ = 1/J + 1/m and x' their distance as it would be without λ; it never pulls. It acts on
    the actuator's side and needs the motion of the joint, so its port is `force` and its place the actuator. Without a
    rotor (J = 0) the motor crosses the gap in no time, and λ = τ_m. g in rad or m, J in kg m² or kg, at the joint.

    Teeth that are `rounded` give way before they mesh, and bounce: at a depth p beyond the gap λ = k p + d ṗ with
    d = 2 ζ √(k J), both at the end of the time step, which for k → ∞ is the law above. k in N m/rad or N/m.
    """

    name = "backlash"
    holds = True
    recalls = True

    def places(self, model: mujoco.MjModel) -> list[str]:
        """Every actuator of a hinge or slide."""
        return driving_actuators(model)

    def parameters(self, place: str, scales: Scales) -> tuple[EffectParameter, ...]:
        """The gap g and the rotor's inertia J; k and ζ where they are free."""
        # a gap is small beside a turn, however far a joint goes round
        reach = min(scales.position, 1.0) if scales.unit == "rad" else scales.position
        inertia, k = scales.inertia, scales.force / reach
        unit = f"{scales.force_unit}/{scales.unit}"
        teeth = (
            EffectParameter("stiffness", unit, 10.0 * k, 1e6 * k, 1e6 * k, 1e3 * k, log=True, form=0.3),
            EffectParameter("damping", "", 0.02, 2.0, 1.0, 0.3, log=True, form=0.3),
        )
        return (
            EffectParameter("gap", scales.unit, 1e-3 * reach, reach, 0.0, 0.03 * reach, log=True, scan=5, form=0.02),
            EffectParameter(
                "rotor_inertia", scales.inertia_unit, 1e-3 * inertia, inertia, 0.0, 0.05 * inertia, log=True, scan=5
            ),
            *(teeth if self.rounded else ()),
        )

    def trade(self, values: dict[str, float]) -> list[dict[str, float]]:
        """A heavier rotor that takes as long through a smaller gap, and a lighter one through a larger."""
        gap, rotor = values["gap"], values["rotor_inertia"]
        return [values | {"gap": gap / by, "rotor_inertia": rotor * by} for by in (0.5, 2.0)]

    def begin(self, values: Values, moment: Moment) -> Memory:
        """θ and θ̇ of a motor that moves with the joint, at the end of the gap to which it presses."""
        load = _rigid(values, moment)
        depth = load / values["stiffness"] if self.rounded else 0.0
        return moment.position + 0.5 * values["gap"] * jnp.sign(load) + depth, moment.velocity

    def recall(self, values: Values, memory: Memory, past: Past, move: Number = 0.0) -> Memory:
        """θ and θ̇ of a motor within a gap that moves as recorded, on cubics between the rows.

        It begins at the end to which the drive presses it; from the first time that it meshes this no longer matters.
        """
        positions, velocities, drives, h = past.positions, past.velocities, past.drives, past.period
        rotor, half, step = jnp.maximum(values["rotor_inertia"], TINY), 0.5 * values["gap"], h / PARTS
        late = jnp.arange(1, PARTS + 1) / PARTS

        def once(motor: tuple[Array, Array], now: tuple[Array, ...]) -> tuple[tuple[Array, Array], None]:
            angle, speed = motor
            position, velocity, push = now
            angle = angle + step * (speed + 0.5 * step * push)
            speed = speed + step * push
            if self.rounded:
                k, d = _teeth(values)
                x, rate = angle - position, speed - velocity
                beyond = x - jnp.clip(x, -half, half)
                slowed = (k * beyond + d * rate) / (rotor + step * (d + step * k))
                slowed = jnp.where(beyond > 0.0, jnp.maximum(slowed, 0.0), jnp.minimum(slowed, 0.0))
                slowed = jnp.where(beyond == 0.0, 0.0, slowed)
                return (angle - step**2 * slowed, speed - step * slowed), None
            above, below = angle >= position + half, angle <= position - half
            speed = jnp.where(above, jnp.minimum(speed, velocity), speed)
            speed = jnp.where(below, jnp.maximum(speed, velocity), speed)
            return (jnp.clip(angle, position - half, position + half), speed), None

        begun, rate, last = positions[:-1, None], velocities[:-1, None], velocities[1:, None]
        mean = jnp.diff(positions)[:, None] / h
        bend = late * (1.0 - late) * ((1.0 - late) * (rate - mean) - late * (last - mean))
        path, rates = begun + h * (late * mean + bend), rate + late * (last - rate)
        pushes = jnp.broadcast_to(drives[:, None] / rotor, path.shape)
        first = positions[0] + half * jnp.sign(drives[0]), velocities[0]
        return jax.lax.scan(once, first, (path.ravel(), rates.ravel(), pushes.ravel()))[0]

    def force(self, values: Values, memory: Memory, moment: Moment) -> tuple[Number, Memory]:
        """λ − τ_m."""
        angle, speed = memory
        rotor, m, h = values["rotor_inertia"], moment.inertia, moment.h
        ahead = (angle - moment.position) + h * (speed - moment.velocity)
        stiff, half = rotor * m / (rotor + m) / h**2, 0.5 * values["gap"]
        load = _rigid(values, moment)
        upper, lower = stiff * (ahead - half) + load, stiff * (ahead + half) + load
        if self.rounded:
            k, d = _teeth(values)
            mu, damped = stiff * h**2, d * (stiff * h**2 * (speed - moment.velocity) + h * load)
            yielding = mu + h * (d + h * k)
            upper, lower = (
                jnp.where(sign * end > 0.0, (k * h**2 * end + damped) / yielding, 0.0)
                for sign, end in ((1.0, upper), (-1.0, lower))
            )
        meshing = jnp.maximum(upper, 0.0) + jnp.minimum(lower, 0.0)
        after = speed + h * (moment.drive - meshing) / jnp.maximum(rotor, 1e-6 * m)
        return meshing - moment.drive, (angle + h * after, after)


def _teeth(values: Values) -> tuple[Number, Number]:
    """Stiffness k and damping d."""
    k = values["stiffness"]
    return k, 2.0 * values["damping"] * jnp.sqrt(k * jnp.maximum(values["rotor_inertia"], TINY))


def _rigid(values: Values, moment: Moment) -> Number:
    """What passes from motor to joint while the two accelerate as one."""
    rotor, m = values["rotor_inertia"], moment.inertia
    share = m / (rotor + m)
    return share * moment.drive - rotor * share * (moment.acceleration - moment.drive / m)
