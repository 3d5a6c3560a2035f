"""Models without the contacts that are made in no recording: the engine that is fast and smooth takes those."""

from __future__ import annotations

import copy
from collections.abc import Iterable, Sequence

import mujoco
import numpy as np
from jaxtyping import Float

from bayessim_jax.engines.tree import find_refusals
from bayessim_jax.recordings.recording import CaseRecording

__all__ = ["drop_contacts"]

ROWS = 200
"""Rows of a recording that are looked at, spread evenly."""
NEAR = 0.01
"""Of the model's extent: geoms that come nearer than this count as touching."""


def drop_contacts(spec: mujoco.MjSpec, recordings: Sequence[CaseRecording]) -> bool:
    """Disable contacts where they alone keep the tree engine from a model and none is made; says whether it did."""
    model, flag = spec.compile(), int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    if not find_refusals(model):
        return False
    without = copy.copy(model)
    without.opt.disableflags |= flag
    if find_refusals(without) or _touches(model, recordings):
        return False
    spec.option.disableflags |= flag
    return True


def _touches(model: mujoco.MjModel, recordings: Iterable[CaseRecording]) -> bool:
    """Whether two geoms that may collide come near each other in a recorded pose."""
    wide = copy.copy(model)
    wide.geom_margin[:] = model.geom_margin + NEAR * model.stat.extent
    data = mujoco.MjData(wide)
    return any(_touch(wide, data, pose) for recording in recordings for pose in _poses(recording))


def _poses(recording: CaseRecording) -> Iterable[Float[np.ndarray, " nq"]]:
    rows = np.unique(np.linspace(0, len(recording.qpos) - 1, ROWS).astype(int))
    return (pose for pose in recording.qpos[rows] if np.isfinite(pose).all())


def _touch(model: mujoco.MjModel, data: mujoco.MjData, pose: Float[np.ndarray, " nq"]) -> bool:
    data.qpos[:] = pose
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    mujoco.mj_collision(model, data)
    return data.ncon > 0
