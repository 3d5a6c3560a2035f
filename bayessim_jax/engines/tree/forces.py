"""Forces on the joints of a tree: motors, servos, springs and dampers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import mujoco

from bayessim_jax.engines.tree.folding import Folded, fold
from bayessim_jax.engines.tree.links import Numbers

__all__ = ["Forces", "joint_forces"]


class Forces(NamedTuple):
    """Force or torque τ on every joint, and what of −∂τ/∂q̇ is known: dampers, and the servos' part of it."""

    force: list[Folded]
    damping: list[Folded]
    servo_damping: list[Folded]


def joint_forces(
    model: mujoco.MjModel,
    numbers: Numbers,
    q: Sequence[Folded],
    v: Sequence[Folded],
    ctrl: Sequence[Folded],
) -> Forces:
    """τ = Σ gear · clip(gain u + b₀ + b₁ l + b₂ l̇) − d q̇ − k (q − q_spring), with l = gear q."""
    flags, bit = model.opt.disableflags, mujoco.mjtDisableBit
    force = [fold(0.0) for _ in q]
    servo_damping = [fold(0.0) for _ in q]
    for i in range(model.nu if not flags & bit.mjDSBL_ACTUATION else 0):
        joint = int(model.actuator_trnid[i, 0])
        gear = numbers("actuator_gear", i, 0)
        u = ctrl[i]
        if model.actuator_ctrllimited[i] and not flags & bit.mjDSBL_CLAMPCTRL:
            u = u.clip(numbers("actuator_ctrlrange", i, 0), numbers("actuator_ctrlrange", i, 1))
        pull = numbers("actuator_gainprm", i, 0) * u
        damping = fold(0.0)
        if model.actuator_biastype[i] == mujoco.mjtBias.mjBIAS_AFFINE:
            constant, stiffness, rate = (numbers("actuator_biasprm", i, k) for k in range(3))
            pull = pull + constant + stiffness * (gear * q[joint]) + rate * (gear * v[joint])
            damping = -(gear * gear * rate)
        if model.actuator_forcelimited[i]:
            low, high = (float(x) for x in model.actuator_forcerange[i])
            if not damping.equals(0.0):
                free = (pull.value > low) & (pull.value < high)
                damping = Folded(jnp.where(free, damping.value, 0.0))
            pull = pull.clip(low, high)
        force[joint] = force[joint] + gear * pull
        servo_damping[joint] = servo_damping[joint] + damping
    damped = not flags & bit.mjDSBL_DAMPER
    dampers = [numbers("dof_damping", j) if damped else fold(0.0) for j in range(len(force))]
    for joint in range(len(force)):
        if model.jnt_actfrclimited[joint]:
            force[joint] = force[joint].clip(*(float(x) for x in model.jnt_actfrcrange[joint]))
        force[joint] = force[joint] - dampers[joint] * v[joint]
        if not flags & bit.mjDSBL_SPRING:
            stretch = q[joint] - numbers("qpos_spring", joint)
            force[joint] = force[joint] - numbers("jnt_stiffness", joint) * stretch
    return Forces(force, dampers, servo_damping)
