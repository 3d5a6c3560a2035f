"""What the actuators exert on a joint, the same for every engine, and what a joint feels of the masses."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float

from bayessim_jax.effects.contract import Number, Numbers
from bayessim_jax.effects.places import driven_joint
from bayessim_jax.engines.fields import Write
from bayessim_jax.mechanics import free_inertia

__all__ = [
    "CAUTION",
    "actuator_torque",
    "actuators_of",
    "drive_of",
    "least_share",
    "read_numbers",
]

CAUTION = 0.7
"""Holding forces oscillate where the inertia is overestimated by more than a third."""
POSES = 64


def read_numbers(model: mujoco.MjModel, writes: Sequence[Write], theta: Float[Array, " d"]) -> Numbers:
    """The model's numbers: those that θ writes traced, all others Python floats."""
    written = {(w.field, w.index): w for w in writes}

    def numbers(field: str, *index: int) -> Any:
        write = written.get((field, index))
        if write is not None:
            return theta[write.parameter] if write.factor == 1.0 else write.factor * theta[write.parameter]
        array = model.opt.gravity if field == "gravity" else getattr(model, field)
        return float(array[index])

    return numbers


def actuator_torque(
    model: mujoco.MjModel, numbers: Numbers, actuator: int, command: Number, position: Number, velocity: Number
) -> Number:
    """Torque gear · clip(gain u + b₀ + b₁ l + b₂ l̇) with l = gear q, on the joint that the actuator drives.

    A state of the actuator itself (MuJoCo's `dyntype`) is taken as settled.
    """
    bit, gear = mujoco.mjtDisableBit, numbers("actuator_gear", actuator, 0)
    if model.actuator_ctrllimited[actuator] and not model.opt.disableflags & bit.mjDSBL_CLAMPCTRL:
        low, high = (numbers("actuator_ctrlrange", actuator, k) for k in (0, 1))
        command = jnp.clip(command, low, high)
    pull = numbers("actuator_gainprm", actuator, 0) * command
    if model.actuator_biastype[actuator] == mujoco.mjtBias.mjBIAS_AFFINE:
        constant, stiffness, rate = (numbers("actuator_biasprm", actuator, k) for k in range(3))
        pull = pull + constant + stiffness * (gear * position) + rate * (gear * velocity)
    if model.actuator_forcelimited[actuator]:
        pull = jnp.clip(pull, *(float(x) for x in model.actuator_forcerange[actuator]))
    return gear * pull


def drive_of(
    model: mujoco.MjModel,
    numbers: Numbers,
    actuators: Sequence[int],
    commands: Any,
    position: Number,
    velocity: Number,
) -> Number:
    """What some actuators exert together on the joint that they drive; `commands[i]` is that of the i-th of all."""
    drive: Number = 0.0
    for i in actuators:
        drive = drive + actuator_torque(model, numbers, i, commands[i], position, velocity)
    return drive


def actuators_of(model: mujoco.MjModel, joint: int) -> list[int]:
    """The actuators that drive a joint."""
    return [i for i in range(model.nu) if driven_joint(model, i) == joint]


def least_share(model: mujoco.MjModel, qpos: np.ndarray, dof: int) -> float:
    """How much less than at a pose a joint can feel at other poses, with some caution: a factor below 1."""
    data, random = mujoco.MjData(model), np.random.default_rng(0)
    here = free_inertia(model, data, qpos)[dof]
    least = here
    for _ in range(POSES):
        pose = np.array(qpos, float)
        for joint in range(model.njnt):
            if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_HINGE:
                low, high = model.jnt_range[joint] if model.jnt_limited[joint] else (-np.pi, np.pi)
                pose[model.jnt_qposadr[joint]] = random.uniform(low, high)
        least = min(least, free_inertia(model, data, pose)[dof])
    return CAUTION * float(least / here)
