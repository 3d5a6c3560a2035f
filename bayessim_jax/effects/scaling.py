"""How large things are at a place of a model, from what was recorded there."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
from jaxtyping import Float

from bayessim_jax.contracts import System
from bayessim_jax.effects.commanded import find_commands
from bayessim_jax.effects.contract import Scales
from bayessim_jax.effects.directions import link_axes
from bayessim_jax.effects.drive import actuators_of
from bayessim_jax.effects.places import at, find_body, find_site, movable_bodies
from bayessim_jax.engines.contacts import find_partners
from bayessim_jax.mechanics import free_inertia

__all__ = ["commanded_scales", "recorded_scales"]

ROWS = 200
"""Rows of a recording at which gravity's and the motion's part of the force are looked at."""
SMALL = 1e-3
"""The least that positions, speeds, forces and commands are taken to be."""

Rows = Float[np.ndarray, "rows n"]


def recorded_scales(
    model: mujoco.MjModel, place: str, qpos: Rows, qvel: Rows, ctrl: Rows, period: float, duration: float
) -> Scales:
    """The scales of a place; rows of all recordings together, without NaN, `duration` that of the longest, s."""
    joint, body, actuators = _nearest(model, place)
    scales: dict[str, Any] = {
        "period": period,
        "duration": duration,
        "timestep": float(model.opt.timestep),
        "shift": 0.0 if model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4 else float(model.opt.timestep),
        "command": _most(ctrl[:, actuators]) if actuators else 1.0,
        "friction": _contact(model, place),
    }
    if body > 0:
        anchor, along, _ = link_axes(model, body)
        reach = abs(float((np.array(model.body_ipos[body]) - anchor) @ along))
        size = float(np.sqrt(model.body_inertia[body].max() / max(model.body_mass[body], 1e-9)))
        scales |= {"mass": float(model.body_mass[body]), "length": max(reach, size, 1e-3)}
    if joint >= 0:
        scales |= _of_joint(model, joint, qpos, qvel, ctrl)
    other = find_site(model, place).other
    if other >= 0:
        scales |= {f"other_{name}": value for name, value in _of_motion(model, other, qpos, qvel).items()}
    return Scales(**scales)


def commanded_scales(
    system: System[Any], place: str, observations: Rows, commands: Rows, period: float, duration: float
) -> Scales:
    """The scales of an actuator or an observation of a system without a model, from what was recorded of it."""
    scales: dict[str, Any] = {"period": period, "duration": duration, "timestep": period}
    if at(place) not in system.observations.names:
        return Scales(**scales, command=_most(commands[:, list(find_commands(system, place).actuators)]))
    c = system.observations.names.index(at(place))
    seen, unit = observations[:, c], system.observations.units[c]
    return Scales(**scales, position=_most(seen - seen.mean()), centre=float(seen.mean()), unit=unit)


def _of_motion(model: mujoco.MjModel, joint: int, qpos: Rows, qvel: Rows) -> dict[str, Any]:
    q, v = qpos[:, int(model.jnt_qposadr[joint])], qvel[:, int(model.jnt_dofadr[joint])]
    slides = model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE
    return {"position": _most(q - q.mean()), "speed": _most(v), "unit": "m" if slides else "rad"}


def _of_joint(model: mujoco.MjModel, joint: int, qpos: Rows, qvel: Rows, ctrl: Rows) -> dict[str, Any]:
    dof, motion = int(model.jnt_dofadr[joint]), _of_motion(model, joint, qpos, qvel)
    data = mujoco.MjData(model)
    loads, drives, inertias = [], [], []
    for row in np.unique(np.linspace(0, len(qpos) - 1, ROWS).astype(int)):
        data.qpos[:], data.qvel[:] = qpos[row], qvel[row]
        data.ctrl[:] = ctrl[min(row, len(ctrl) - 1)] if len(ctrl) else 0.0
        mujoco.mj_forward(model, data)
        loads.append(data.qfrc_bias[dof])
        drives.append(data.qfrc_actuator[dof])
    for row in (0, len(qpos) // 2, len(qpos) - 1):
        inertias.append(free_inertia(model, data, qpos[row])[dof])
    inertia = float(np.median(inertias))
    swing = inertia * motion["speed"] ** 2 / motion["position"]
    force = max(_most(np.array(loads)), _most(np.array(drives)), swing)
    centre = float(qpos[:, int(model.jnt_qposadr[joint])].mean())
    return motion | {"force": force, "inertia": inertia, "centre": centre}


def _nearest(model: mujoco.MjModel, place: str) -> tuple[int, int, list[int]]:
    """Joint, body and actuators at a place; those of the first joint where it has none of its own."""
    kind, body = place.partition("/")[0], -1
    site = find_site(model, place)
    joint = site.joint
    if kind == "body":
        body = find_body(model, place)
    elif kind == "geom":
        body = int(model.geom_bodyid[model.geom(at(place).removeprefix("geom/")).id])
    elif joint >= 0:
        body = int(model.jnt_bodyid[joint])
    if body < 0 and movable_bodies(model):
        body = find_body(model, movable_bodies(model)[0])
    if joint < 0 and body > 0 and model.body_jntnum[body]:
        first = int(model.body_jntadr[body])
        hinges = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)
        joint = first if model.jnt_type[first] in hinges else -1
    return joint, body, list(site.actuators) or (actuators_of(model, joint) if joint >= 0 else [])


def _contact(model: mujoco.MjModel, place: str) -> float:
    """The larger of the coefficients of a geom and of the world's geoms that it can touch."""
    if not place.startswith("geom/"):
        return 1.0
    geom = model.geom(at(place).removeprefix("geom/")).id
    fixed = [o for o in find_partners(model, geom) if model.body_weldid[model.geom_bodyid[o]] == 0]
    return float(max(model.geom_friction[g, 0] for g in (geom, *fixed)))


def _most(values: np.ndarray) -> float:
    """What 95 % of the magnitudes stay below."""
    return max(float(np.quantile(np.abs(values), 0.95)), SMALL) if values.size else SMALL
