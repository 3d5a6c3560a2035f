"""What of a model the tree engine does not simulate, by name."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import mujoco
import numpy as np

from bayessim_jax.engines.contacts import find_contact
from bayessim_jax.engines.fields import Write

__all__ = ["find_refusals"]

INTEGRATORS = {
    mujoco.mjtIntegrator.mjINT_EULER,
    mujoco.mjtIntegrator.mjINT_RK4,
    mujoco.mjtIntegrator.mjINT_IMPLICITFAST,
}


def find_refusals(model: mujoco.MjModel, writes: Sequence[Write] = ()) -> list[str]:
    """One clause for each element that is not simulated; an empty list says that the tree engine can take the model."""
    return [*_options(model), *_elements(model), *_joints(model, writes), *_actuators(model), *_contacts(model)]


def _options(model: mujoco.MjModel) -> Iterator[str]:
    if model.opt.integrator not in INTEGRATORS:
        yield f"option/integrator is {mujoco.mjtIntegrator(model.opt.integrator).name.removeprefix('mjINT_').lower()}"
    for name in ("density", "viscosity"):
        if getattr(model.opt, name) > 0.0:
            yield f"option/{name} is not zero"
    if model.opt.enableflags & (mujoco.mjtEnableBit.mjENBL_SLEEP | mujoco.mjtEnableBit.mjENBL_DIAGEXACT):
        yield "option/flag enables sleep or diagexact"


def _elements(model: mujoco.MjModel) -> Iterator[str]:
    if model.njnt == 0:
        yield "the model has no joints"
    for what, count in (("a tendon", model.ntendon), ("a flex", model.nflex), ("a plugin", model.nplugin)):
        if count:
            yield f"the model has {what}"
    for i in range(model.neq):
        if model.eq_active0[i]:
            yield f"equality/{model.equality(i).name or f'#{i}'} is active"
    for body in range(model.nbody):
        if model.body_gravcomp[body]:
            yield f"body/{model.body(body).name} has gravity compensation"
        if model.body_mocapid[body] >= 0:
            yield f"body/{model.body(body).name} is a mocap body"


def _joints(model: mujoco.MjModel, writes: Sequence[Write]) -> Iterator[str]:
    kinds = mujoco.mjtJoint
    written = {w.index[0] for w in writes if w.field == "dof_frictionloss"}
    for joint in range(model.njnt):
        name, kind = f"joint/{model.joint(joint).name or f'#{joint}'}", model.jnt_type[joint]
        if kind in (kinds.mjJNT_BALL, kinds.mjJNT_FREE):
            yield f"{name} is a {'ball' if kind == kinds.mjJNT_BALL else 'free'} joint"
            continue
        dof = int(model.jnt_dofadr[joint])
        if model.opt.noslip_iterations and (model.dof_frictionloss[dof] > 0.0 or dof in written):
            yield f"{name} has frictionloss, which option/noslip_iterations treats in its own way"
        for what, solref in (("limit", model.jnt_solref[joint]), ("friction", model.dof_solref[dof])):
            if (solref[0] > 0.0) != (solref[1] > 0.0):
                yield f"{name} has a {what} of mixed solref"
        if np.any(model.dof_dampingpoly[dof]) or np.any(model.jnt_stiffnesspoly[joint]):
            yield f"{name} has nonlinear damping or stiffness"


def _actuators(model: mujoco.MjModel) -> Iterator[str]:
    transmissions = (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT)
    biases = (mujoco.mjtBias.mjBIAS_NONE, mujoco.mjtBias.mjBIAS_AFFINE)
    for i in range(model.nactuator):
        name = f"actuator/{model.actuator(i).name or f'#{i}'}"
        if model.actuator_dyntype[i] != mujoco.mjtDyn.mjDYN_NONE:
            yield f"{name} has a state of its own"
        elif model.actuator_trntype[i] not in transmissions:
            yield f"{name} does not act on a joint"
        elif model.actuator_gaintype[i] != mujoco.mjtGain.mjGAIN_FIXED or model.actuator_biastype[i] not in biases:
            yield f"{name} is neither a motor nor a position or velocity servo"
        elif model.actuator_delay[i] or np.any(model.actuator_armature[i]) or np.any(model.actuator_damping[i]):
            yield f"{name} has a delay, armature or damping of its own"
        elif model.opt.disableactuator & (1 << max(0, int(model.actuator_group[i]))):
            yield f"{name} is in a disabled group"


def _contacts(model: mujoco.MjModel) -> Iterator[str]:
    pair = find_contact(model)
    if pair is not None:
        yield f"{pair[0]} and {pair[1]} can touch"
