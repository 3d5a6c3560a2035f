"""Models without the contacts and limits that no recording reaches.

Without contacts the engine that is fast and smooth takes them. A limit is solved for at every time step, reached or
not: an arm of seven limited joints takes many times as long as without.
"""

from __future__ import annotations

import copy
from collections.abc import Iterable, Sequence

import mujoco
import numpy as np
from jaxtyping import Float

from bayessim_jax.engines.tree import find_refusals
from bayessim_jax.recordings.layout import HINGE, SLIDE
from bayessim_jax.recordings.recording import CaseRecording

__all__ = ["drop_unreached"]

ROWS = 200
"""Rows of a recording that are looked at, spread evenly."""
NEAR = 0.01
"""Of the model's extent: geoms that come nearer than this may count as touching."""
SHARE = 0.1
"""Of what a distance, between two geoms or to a limit, changes by: what counts as near is smaller than that."""


def drop_unreached(spec: mujoco.MjSpec, recordings: Sequence[CaseRecording]) -> list[str]:
    """Disable contacts, where they alone keep the tree engine from a model and none is made, and limits; says which."""
    model, flag = spec.compile(), int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    remarks: list[str] = []
    if find_refusals(model):
        without = copy.copy(model)
        without.opt.disableflags |= flag
        if find_refusals(without) or _touches(model, recordings):
            return []
        spec.option.disableflags |= flag
        remarks.append("contacts are left out: nothing touches in the recordings")
    if count := _drop_limits(spec, model, recordings):
        what = "limits of one joint" if count == 1 else f"limits of {count} joints"
        remarks.append(f"{what} are left out: the recordings do not come near")
    return remarks


def _drop_limits(spec: mujoco.MjSpec, model: mujoco.MjModel, recordings: Sequence[CaseRecording]) -> int:
    """Disable the limits of hinges and slides that are measured and stay away from them; says of how many joints."""
    count = 0
    for joint in spec.joints:
        single = model.jnt_type[joint.id] in (SLIDE, HINGE)
        if single and model.jnt_limited[joint.id] and _stays_away(model, joint.id, recordings):
            joint.limited = mujoco.mjtLimited.mjLIMITED_FALSE
            count += 1
    return count


def _stays_away(model: mujoco.MjModel, joint: int, recordings: Sequence[CaseRecording]) -> bool:
    """Whether every recording shows a joint's position, and none near a limit."""
    q, (low, high) = model.jnt_qposadr[joint], model.jnt_range[joint]
    seen = [r.qpos[r.qpos_measured[:, q], q] for r in recordings]
    if not all(part.size for part in seen):
        return False
    least, most = min(part.min() for part in seen), max(part.max() for part in seen)
    return bool(min(least - low, high - most) - model.jnt_margin[joint] > SHARE * (most - least))


def _touches(model: mujoco.MjModel, recordings: Iterable[CaseRecording]) -> bool:
    """Whether two geoms that may collide come near each other in a recorded pose.

    Neighbours along a chain are near each other by design, at a distance that hardly changes: what counts as near is
    less than a share of that by which a distance changes in all recordings, too.
    """
    poses = [pose for recording in recordings for pose in _poses(recording)]
    wide = copy.copy(model)
    wide.geom_margin[:] += NEAR * model.stat.extent
    wide.body_margin[:] += NEAR * model.stat.extent
    data, pairs = mujoco.MjData(wide), set[tuple[int, int]]()
    for pose in poses:
        _place(wide, data, pose)
        mujoco.mj_collision(wide, data)
        pairs |= {(int(c.geom1), int(c.geom2)) for c in data.contact}
    distances = np.zeros((len(poses), len(pairs)))
    for row, pose in zip(distances, poses, strict=True):
        _place(model, data, pose)
        row[:] = [mujoco.mj_geomDistance(model, data, *pair, model.stat.extent, None) for pair in pairs]
    limits = np.array([model.geom_margin[list(pair)].sum() for pair in pairs]) + SHARE * np.ptp(distances, axis=0)
    return bool((distances.min(axis=0) <= limits).any()) if pairs else False


def _poses(recording: CaseRecording) -> Iterable[Float[np.ndarray, " nq"]]:
    rows = np.unique(np.linspace(0, len(recording.qpos) - 1, ROWS).astype(int))
    return (pose for pose in recording.qpos[rows] if np.isfinite(pose).all())


def _place(model: mujoco.MjModel, data: mujoco.MjData, pose: Float[np.ndarray, " nq"]) -> None:
    data.qpos[:] = pose
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
