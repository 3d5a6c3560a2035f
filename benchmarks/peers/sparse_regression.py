"""The peer's side: sparse regression (PySINDy) of what a fitted simulator leaves of accelerations, by joints."""

from __future__ import annotations

from typing import TYPE_CHECKING

import mujoco
import numpy as np
from pysindy import STLSQ

if TYPE_CHECKING:
    from collections.abc import Mapping

    from bayessim_jax.recordings.shots import CaseModel

__all__ = ["TERMS", "find_terms"]

TERMS = {
    "1": ("actuator_bias", "base_tilt"),
    "q": ("joint_spring", "link_offset", "payload"),
    "v": ("viscous_friction", "back_emf"),
    "sign v": ("coulomb_friction", "stribeck_friction", "asymmetric_friction", "lugre_friction"),
    "v |v|": ("quadratic_drag",),
    "τ": ("actuator_gain", "gain_drop", "gain_drift", "actuator_saturation", "actuator_deadband"),
    "|τ| sign v": ("load_dependent_friction",),
}
"""Terms of the library, and the effects whose name one may stand for."""
ROWS, SPARSITY, SHARE = 4000, 0.1, 0.1
"""Rows that are used at most, the threshold in units of the residual, and its share that terms must explain."""


def find_terms(model: CaseModel, theta: Mapping[str, float]) -> list[str]:
    """`term@joint/name`, the largest first, of a case with a simulator at θ; none where none explains a tenth.

    Residual torques M (a − a_model) along the smoothed motion, scaled to a standard deviation of one like the terms;
    sequentially thresholded least squares keeps few of them. The acceleration itself is no term: its noise is in the
    residual, too.

    Source: Brunton, Proctor and Kutz 2016; de Silva et al. 2020
    """
    machine = model.case.augmented(dict(theta))[1]
    data, rows = mujoco.MjData(machine), []
    for recording in model.smoothed.recordings:
        acceleration = np.gradient(recording.qvel, recording.time, axis=0)
        rows += list(zip(recording.qpos, recording.qvel, acceleration, recording.ctrl, strict=True))
    rows = rows[:: max(len(rows) // ROWS, 1)]
    residual, drive = np.zeros((2, len(rows), machine.nv))
    for i, (data.qpos, data.qvel, acceleration, data.ctrl) in enumerate(rows):
        mujoco.mj_forward(machine, data)
        mujoco.mj_mulM(machine, data, residual[i], acceleration - data.qacc)
        drive[i] = data.qfrc_actuator
    found = []
    for name, place, dof in model.case.layout.single:
        q, v = (np.array([row[k][j] for row in rows]) for k, j in ((0, place), (1, dof)))
        tau = drive[:, dof]
        columns = {"q": q, "v": v, "sign v": np.sign(v), "v |v|": v * np.abs(v), "τ": tau}
        columns |= {"|τ| sign v": np.abs(tau) * np.sign(v), "1": np.ones_like(q)}
        sizes = {term: np.sqrt((x**2).mean()) for term, x in columns.items()}
        terms = [term for term, size in sizes.items() if size > 0.0]
        scale = residual[:, dof].std()
        if not scale > 0.0:
            continue
        design, target = np.stack([columns[t] / sizes[t] for t in terms], -1), residual[:, dof] / scale
        weights = STLSQ(threshold=SPARSITY, alpha=1e-3).fit(design, target).coef_[0]
        if 1.0 - ((target - design @ weights) ** 2).mean() / (target**2).mean() > SHARE:
            found += [(abs(w) * scale, f"{t}@joint/{name}") for w, t in zip(weights, terms, strict=True) if w]
    return [name for _, name in sorted(found, reverse=True)]
