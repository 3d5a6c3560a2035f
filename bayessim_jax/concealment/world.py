"""A machine while it runs: MuJoCo's C engine on a fine grid, with laws between command, force and sensor."""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import mujoco
import numpy as np
from jaxtyping import Float, Int

from bayessim_jax.concealment.law import ActLaw, ForceLaw, ModelLaw, SenseLaw
from bayessim_jax.concealment.places import driven_joint

if TYPE_CHECKING:
    from collections.abc import Sequence

    from bayessim_jax.concealment.drive import Drive
    from bayessim_jax.concealment.law import Law
    from bayessim_jax.concealment.motions import Motion

__all__ = ["RunawayError", "Track", "World", "build", "count_substeps", "simulate"]

FINE, LONGEST = 4, 2e-3
"""Steps of a world in one of the model's, at least, and s, the longest that they may be, for joints that stick."""
WILD = 1e3
"""rad/s or m/s at which a machine has run away."""


class RunawayError(ValueError):
    """A machine whose speeds grew without bound."""


@dataclass(frozen=True)
class Track:
    """What happened, at every step of the world, before any noise."""

    time: Float[np.ndarray, " steps"]
    """s; the recording begins at 0."""
    qpos: Float[np.ndarray, "steps nq"]
    qvel: Float[np.ndarray, "steps nv"]
    shown: Float[np.ndarray, "steps nq"]
    """Positions as the encoders show them."""
    rows: Int[np.ndarray, " rows"]
    """The steps at which the recording has its rows."""
    ctrl: Float[np.ndarray, "rows nu"]
    """Commands, as they were given."""


class World:
    """The state of a machine, as laws see it."""

    def __init__(self, model: mujoco.MjModel, time: float) -> None:
        """At rest in the model's pose, `time` seconds into the recording."""
        self.model = model
        self.data = mujoco.MjData(model)
        self.h = float(model.opt.timestep)
        self.time = time
        self._motors = [[i for i in range(model.nu) if driven_joint(model, i) == joint] for joint in range(model.njnt)]

    def state(self, joint: int) -> tuple[float, float]:
        """Position and velocity of a joint."""
        q, v = self.model.jnt_qposadr[joint], self.model.jnt_dofadr[joint]
        return float(self.data.qpos[q]), float(self.data.qvel[v])

    def motor(self, joint: int) -> float:
        """What its motors exert on a joint under the commands in `data.ctrl`, gear · clip(gain u + b₀ + b₁ l + b₂ l̇).

        The state of an actuator (MuJoCo's `dyntype`) is taken as settled.
        """
        m, total = self.model, 0.0
        q, v = self.state(joint)
        for i in self._motors[joint]:
            gear, u = float(m.actuator_gear[i, 0]), float(self.data.ctrl[i])
            if m.actuator_ctrllimited[i]:
                u = min(max(u, m.actuator_ctrlrange[i, 0]), m.actuator_ctrlrange[i, 1])
            pull = m.actuator_gainprm[i, 0] * u
            if m.actuator_biastype[i] == mujoco.mjtBias.mjBIAS_AFFINE:
                bias = m.actuator_biasprm[i]
                pull += bias[0] + gear * (bias[1] * q + bias[2] * v)
            if m.actuator_forcelimited[i]:
                pull = min(max(pull, m.actuator_forcerange[i, 0]), m.actuator_forcerange[i, 1])
            total += gear * float(pull)
        return total


def count_substeps(h: float) -> int:
    """Steps of a world in one of h seconds of the model."""
    return max(FINE, math.ceil(h / LONGEST * (1 - 1e-9)))


def build(model: mujoco.MjModel, laws: Sequence[Law]) -> mujoco.MjModel:
    """A copy of a model on the fine grid, with what laws make of its numbers."""
    fine = copy.copy(model)
    fine.opt.timestep = model.opt.timestep / count_substeps(model.opt.timestep)
    edits = [law for law in laws if isinstance(law, ModelLaw)]
    for law in edits:
        law.edit(fine)
    if edits:
        mujoco.mj_setConst(fine, mujoco.MjData(fine))
    return fine


def simulate(model: mujoco.MjModel, laws: Sequence[Law], drive: Drive, motion: Motion) -> Track:
    """Let a machine (from `build`) move; raises `RunawayError`.

    It begins some time before the recording does, with the first command held.
    """
    world = World(model, -motion.lead * float(model.opt.timestep))
    data, h = world.data, world.h
    data.qpos[:], data.qvel[:] = motion.qpos, motion.qvel
    marks, steps = motion.marks + motion.lead, motion.lead + motion.steps
    acts = [law for law in laws if isinstance(law, ActLaw)]
    forces = [law for law in laws if isinstance(law, ForceLaw)]
    senses = [law for law in laws if isinstance(law, SenseLaw)]
    qpos, qvel = np.empty((steps, model.nq)), np.empty((steps, model.nv))
    ctrl = np.empty((len(marks), model.nu))
    command = ctrl[0] = data.ctrl[:] = drive.command(motion.signals[0], motion.off[0], data.qpos, data.qvel)
    for law in laws:
        law.begin(world, motion.chance(law.name))
    following = [*marks[1:].tolist(), -1]
    row = 0
    for k in range(steps):
        if k == following[row]:
            row += 1
            command = ctrl[row] = drive.command(motion.signals[row], motion.off[row], data.qpos, data.qvel)
            if np.abs(data.qvel).max() > WILD:
                raise RunawayError("the machine runs away")
        qpos[k], qvel[k] = data.qpos, data.qvel
        data.ctrl[:] = command
        for law in acts:
            data.ctrl[law.spot.actuator] = law.command(world, float(data.ctrl[law.spot.actuator]))
        data.qfrc_applied[:] = 0.0
        for law in forces:
            spot = law.spot
            data.qfrc_applied[spot.v] += law.force(world, float(data.qpos[spot.q]), float(data.qvel[spot.v]))
        mujoco.mj_step(model, data)
        world.time += h
    time = h * (np.arange(steps) - motion.lead)
    shown = qpos.copy()
    for law in senses:
        shown[:, law.spot.q] = law.read(time, shown[:, law.spot.q], motion.chance(law.name))
    return Track(time, qpos, qvel, shown, marks, ctrl)
