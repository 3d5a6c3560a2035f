"""How large things are at every place of a model, from recordings: what effects' priors are scaled by."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np
from jaxtyping import Float

from bayessim_jax.effects import Scales

__all__ = ["Motion", "find_scales"]

Motion = tuple[Float[np.ndarray, " rows"], Float[np.ndarray, "rows nq"], Float[np.ndarray, "rows nv"], np.ndarray]
"""Times, positions, velocities and commands of one recording."""
SAMPLES = 400
USUAL = 0.95


def find_scales(model: Any, motions: Sequence[Motion], places: Sequence[str], dt: float) -> dict[str, Scales]:
    """Scales of each place: of a joint its own, of an actuator those of its joint, of anything else the largest."""
    data, vectors = mujoco.MjData(model), _sample(model, motions)
    qpos, qvel, ctrl, acceleration = vectors
    forces, inertias = [], []
    unit = np.eye(model.nv)
    for q, v, u in zip(qpos, qvel, ctrl, strict=True):
        data.qpos[:], data.qvel[:], data.ctrl[:] = q, v, u
        mujoco.mj_forward(model, data)
        inverse = np.zeros((model.nv, model.nv))
        mujoco.mj_solveM(model, data, inverse, unit)
        inertias.append(1 / np.maximum(np.diag(inverse), 1e-12))
        forces.append(np.maximum(np.abs(data.qfrc_actuator), np.abs(data.qfrc_bias)))
    inertia = np.median(inertias, axis=0)
    force = np.maximum(np.quantile(forces, USUAL, axis=0), inertia * np.quantile(np.abs(acceleration), USUAL, axis=0))
    speed = np.quantile(np.abs(qvel), USUAL, axis=0)
    duration = max(float(m[0][-1] - m[0][0]) for m in motions)
    joints = {}
    for j in range(model.njnt):
        v, q, body = int(model.jnt_dofadr[j]), int(model.jnt_qposadr[j]), int(model.jnt_bodyid[j])
        slides = model.jnt_type[j] == mujoco.mjtJoint.mjJNT_SLIDE
        centre = float(qpos[:, q].mean())
        reach = max(float(np.abs(model.body_ipos[body]).max()), 1e-2)
        joints[j] = Scales(
            position=max(float(np.quantile(np.abs(qpos[:, q] - centre), USUAL)), 1e-4),
            speed=max(float(speed[v]), 1e-3),
            force=max(float(force[v]), 1e-6),
            command=max(float(np.quantile(np.abs(ctrl), USUAL)) if ctrl.size else 1.0, 1e-6),
            period=dt,
            inertia=max(float(inertia[v]), 1e-9),
            duration=duration,
            timestep=float(model.opt.timestep),
            centre=centre,
            mass=float(model.body_mass[body]),
            length=reach,
            unit="m" if slides else "rad",
        )
    largest = max(joints.values(), key=lambda s: s.force) if joints else Scales(period=dt, timestep=dt)
    found = {}
    for place in places:
        kind, _, rest = place.partition("/")
        name = rest.split("#")[0]
        if kind == "actuator":
            i = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_ACTUATOR, name)
            joint = int(model.actuator_trnid[i, 0]) if i >= 0 else 0
            command = max(float(np.quantile(np.abs(ctrl[:, i]), USUAL)), 1e-6) if i >= 0 else largest.command
            found[place] = dataclasses.replace(joints.get(joint, largest), command=command)
        elif kind == "joint":
            name = name.removesuffix("/qpos").removesuffix("/qvel")
            found[place] = joints.get(mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, name), largest)
        elif kind == "body":
            i = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, name)
            own = [j for j in joints if i >= 0 and model.jnt_bodyid[j] == i]
            found[place] = joints[own[0]] if own else largest
        else:
            found[place] = largest
    return found


def _sample(model: Any, motions: Sequence[Motion]) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """States and commands spread over the recordings, and the accelerations there."""
    parts: list[list[np.ndarray]] = [[], [], [], []]
    each = max(SAMPLES // max(len(motions), 1), 20)
    for time, qpos, qvel, ctrl in motions:
        wide = max(len(time) // 100, 2)
        slope = np.zeros_like(qvel)
        slope[wide:-wide] = (qvel[2 * wide :] - qvel[: -2 * wide]) / (time[2 * wide :] - time[: -2 * wide])[:, None]
        rows = np.unique(np.linspace(wide, max(len(time) - wide - 1, wide), each).astype(int))
        rows = rows[rows < len(time)]
        for part, values in zip(parts, (qpos, qvel, ctrl, slope), strict=True):
            part.append(values[rows])
    qpos, qvel, ctrl, acceleration = (np.concatenate(part) for part in parts)
    return qpos, qvel, ctrl, acceleration
