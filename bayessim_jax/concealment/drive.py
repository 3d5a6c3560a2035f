"""What moves a machine well: commands that swing its joints, and hold those that would fall or drift away."""

from __future__ import annotations

from dataclasses import dataclass, replace

import mujoco
import numpy as np
from jaxtyping import Bool, Float, Int

from bayessim_jax.concealment.motions import UNDRIVEN, Motion, draw_motions
from bayessim_jax.concealment.places import driven_joint, dry_geoms
from bayessim_jax.concealment.world import RunawayError, build, count_substeps, simulate

__all__ = ["Drive", "find_drive"]

SWING = {mujoco.mjtJoint.mjJNT_HINGE: 0.7, mujoco.mjtJoint.mjJNT_SLIDE: 0.2}
"""rad or m to each side."""
WIDE = 1.2
"""rad from which a hinge without a motor is let go."""
HOLD = 5.0
"""rad/s with which a joint that nothing holds is brought back by its motor's command."""
CALM = 0.6
"""Twice the share of critical damping in commands, so that it is not the resonance alone that moves a joint."""
TRIALS = 5


@dataclass(frozen=True)
class Drive:
    """Commands u = u₀ + w g(q) + A s(t) − kₚ (q − q₀) − k_d q̇ within the actuators' ranges, and where it all begins.

    g(q) is what gravity exerts on the actuator's joint, w is not zero where the motor carries that.
    """

    model: mujoco.MjModel
    scratch: mujoco.MjData
    home: Float[np.ndarray, " nq"]
    scatter: Float[np.ndarray, " nq"]
    """Of initial positions, to each side."""
    swing: Float[np.ndarray, " nv"]
    """How far joints are to go to each side."""
    q: Int[np.ndarray, " nu"]
    v: Int[np.ndarray, " nu"]
    """Places of the actuators' joints in `qpos` and `qvel`."""
    offset: Float[np.ndarray, " nu"]
    carries: Float[np.ndarray, " nu"]
    amplitude: Float[np.ndarray, " nu"]
    kp: Float[np.ndarray, " nu"]
    kd: Float[np.ndarray, " nu"]
    low: Float[np.ndarray, " nu"]
    high: Float[np.ndarray, " nu"]
    frees: Bool[np.ndarray, " nu"]
    """Motors that may be switched off without their joint falling."""

    @property
    def count(self) -> int:
        """Number of actuators."""
        return len(self.q)

    def command(
        self,
        signal: Float[np.ndarray, " nu"],
        off: Bool[np.ndarray, " nu"],
        qpos: Float[np.ndarray, " nq"],
        qvel: Float[np.ndarray, " nv"],
    ) -> Float[np.ndarray, " nu"]:
        """The command in a state."""
        error = qpos[self.q] - self.home[self.q]
        u = self.offset + self.amplitude * signal - self.kp * error - self.kd * qvel[self.v]
        if self.carries.any():
            u = u + self.carries * _weight(self.model, self.scratch, qpos)[self.v]
        return np.where(off, 0.0, np.minimum(np.maximum(u, self.low), self.high))


def find_drive(model: mujoco.MjModel, kind: str, stride: int) -> Drive:
    """Commands for the motions of a kind, as large as swings the joints by 0.6 rad or 0.2 m, or their range allows.

    Commands have some damping of the joint in them; a joint that does not hang they carry against gravity, and bring it
    back to its home by a weak spring. What comes of it is recorded as the command. Position servos are given positions.
    """
    drive = _guess(model)
    if not drive.count or kind in UNDRIVEN:
        return drive
    rows = round(3.0 / (stride * model.opt.timestep))
    for _ in range(TRIALS):
        motions = draw_motions(np.random.default_rng(0), drive, kind, 3, rows, stride, float(model.opt.timestep), 0.0)
        try:
            reached = _reached(model, drive, motions)
        except RunawayError:
            reached = 10 * drive.swing[drive.v]
        ratio = np.clip((drive.swing[drive.v] / np.maximum(reached, 1e-9)) ** 0.8, 0.1, 4.0)
        limit = np.minimum(drive.high - drive.offset, drive.offset - drive.low)
        drive = replace(drive, amplitude=np.minimum(drive.amplitude * ratio, limit))
        if np.abs(np.log(ratio)).max() < 0.2:
            break
    return drive


def _reached(model: mujoco.MjModel, drive: Drive, motions: list[Motion]) -> Float[np.ndarray, " nu"]:
    """What 95 % of the distances from home stay below, at every actuator's joint."""
    plain, every = build(model, ()), 2 * count_substeps(model.opt.timestep)
    away = [np.abs(simulate(plain, (), drive, m).qpos[::every, drive.q] - drive.home[drive.q]) for m in motions]
    return np.quantile(np.concatenate(away), 0.95, axis=0)


def _guess(model: mujoco.MjModel) -> Drive:
    """Home, gains, and amplitudes to begin with."""
    home, swing, scatter = np.array(model.qpos0), np.zeros(model.nv), np.zeros(model.nq)
    driven = {driven_joint(model, i) for i in range(model.nu)}
    touches = bool(dry_geoms(model))
    for j in range(model.njnt):
        q, v, kind = model.jnt_qposadr[j], model.jnt_dofadr[j], mujoco.mjtJoint(model.jnt_type[j])
        if kind not in SWING or (touches and j not in driven):  # what stands on the ground stays there
            continue
        swing[v] = SWING[kind]
        scatter[q] = WIDE if j not in driven and kind == mujoco.mjtJoint.mjJNT_HINGE else swing[v]
        if model.jnt_limited[j]:
            low, high = model.jnt_range[j]
            swing[v] = min(swing[v], 0.35 * (high - low))
            scatter[q] = min(scatter[q], 0.35 * (high - low))
            if not low + swing[v] <= home[q] <= high - swing[v]:
                home[q] = (low + high) / 2
    gravity, stiffness, inertia = _rest(model, home)
    n = model.nu
    q, v = np.zeros(n, int), np.zeros(n, int)
    offset, carries, amplitude, kp, kd = (np.zeros(n) for _ in range(5))
    frees = np.zeros(n, bool)
    for i in range(n):
        j = driven_joint(model, i)
        if j < 0:
            continue
        q[i], v[i] = model.jnt_qposadr[j], model.jnt_dofadr[j]
        d, gear = v[i], model.actuator_gear[i, 0]
        gain, bias = model.actuator_gainprm[i, 0], model.actuator_biasprm[i]
        affine = model.actuator_biastype[i] == mujoco.mjtBias.mjBIAS_AFFINE
        if affine and bias[1]:  # a position servo
            unit = -bias[1] / gain * gear
            offset[i], amplitude[i] = unit * home[q[i]], abs(unit) * swing[d]
        elif affine and bias[2]:  # a velocity servo
            unit = -bias[2] / gain * gear
            amplitude[i], kp[i] = abs(unit) * HOLD * swing[d], unit * HOLD / 2
        else:
            unit = 1.0 / (gear * gain) if gear * gain else 0.0
            spring = inertia[d] * HOLD**2
            hangs = stiffness[d] > 0.3 * spring and abs(gravity[d]) < 0.3 * stiffness[d] * swing[d]
            falls = stiffness[d] < -0.3 * spring or abs(gravity[d]) > 0.3 * spring * swing[d]
            if not hangs:
                carries[i], kp[i] = unit, unit * spring
            whole = stiffness[d] if hangs else spring
            kd[i] = unit * CALM * np.sqrt(whole * inertia[d])
            amplitude[i] = abs(unit) * whole * swing[d]
            frees[i] = hangs or not falls
    limited = np.asarray(model.actuator_ctrllimited, bool)
    low = np.where(limited, model.actuator_ctrlrange[:, 0], -np.inf)
    high = np.where(limited, model.actuator_ctrlrange[:, 1], np.inf)
    return Drive(
        model,
        mujoco.MjData(model),
        home,
        scatter,
        swing,
        q,
        v,
        np.clip(offset, low, high),
        carries,
        amplitude,
        kp,
        kd,
        low,
        high,
        frees,
    )


def _rest(model: mujoco.MjModel, home: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """At home: what carries the joints against gravity and springs, its slope, and the inertia that each feels."""
    data = mujoco.MjData(model)
    slope = np.zeros(model.nv)
    for j in range(model.njnt):
        if mujoco.mjtJoint(model.jnt_type[j]) in SWING:
            step = np.zeros(model.nq)
            step[model.jnt_qposadr[j]] = 1e-4
            d = model.jnt_dofadr[j]
            slope[d] = (_weight(model, data, home + step)[d] - _weight(model, data, home - step)[d]) / 2e-4
    held = _weight(model, data, home)
    mass = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, mass)
    return held, slope, np.diagonal(mass).copy()


def _weight(model: mujoco.MjModel, data: mujoco.MjData, qpos: np.ndarray) -> np.ndarray:
    """What carries the joints at rest against gravity and springs."""
    data.qpos[:], data.qvel[:] = qpos, 0.0
    mujoco.mj_fwdPosition(model, data)
    mujoco.mj_fwdVelocity(model, data)
    return data.qfrc_bias - data.qfrc_passive
