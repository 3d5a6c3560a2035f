"""What a MuJoCo model says of itself, by MuJoCo and NumPy alone."""

from __future__ import annotations

import mujoco
import numpy as np
from jaxtyping import Float

__all__ = ["free_inertia"]


def free_inertia(
    model: mujoco.MjModel, data: mujoco.MjData, qpos: Float[np.ndarray, " nq"]
) -> Float[np.ndarray, " nv"]:
    """1/(M⁻¹)ⱼⱼ at a pose (kg or kg m²): what each degree of freedom shows of inertia while the others are free."""
    data.qpos[:] = qpos
    mujoco.mj_fwdPosition(model, data)
    mass = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, mass)
    return 1.0 / np.diagonal(np.linalg.inv(mass))
