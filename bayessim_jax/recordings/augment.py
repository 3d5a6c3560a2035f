"""Writing parameter values into a model's specification, so that a freshly compiled model has them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from bayessim_jax.recordings.mjcf import import_mujoco
from bayessim_jax.recordings.paths import Target, nominal

if TYPE_CHECKING:
    from collections.abc import Mapping

__all__ = ["write_values"]


def write_values(spec: Any, values: Mapping[Target, float]) -> Any:
    """Write values in SI units into a `mujoco.MjSpec` and return the compiled `mujoco.MjModel`.

    The specification is changed in place. A mass scales its body's inertia with it and a centre of mass moves the
    inertia along; `ctrlrange` without an index sets the upper end and keeps the ratio of the lower end to it; the
    gain of a position or velocity servo changes its bias with it. Raises `ValueError` where the model that comes out
    does not have the values, or cannot be compiled.
    """
    inertial = {t: v for t, v in values.items() if t.kind == "body"}
    model = spec.compile()
    for target, value in values.items():
        if target.kind != "body":
            _write(spec, model, target, float(value))
    if inertial:
        model = spec.compile()
        _write_inertial(spec, model, inertial)
    model = spec.compile()
    for target, value in values.items():
        found = nominal(target, model)
        if not np.isclose(found, value, rtol=1e-6, atol=1e-9):
            raise ValueError(f"{target} was set to {value:g} but is {found:g} in the compiled model.")
    return model


def _write(spec: Any, model: Any, target: Target, value: float) -> None:
    i, index = target.id(model), target.index
    if target.kind == "option":
        gravity = np.array(spec.option.gravity)
        gravity[index] = value
        spec.option.gravity = gravity
        return
    element = getattr(spec, target.kind)(target.name)
    if target.field in ("damping", "stiffness"):  # the first of a polynomial's coefficients
        _set(element, target.field, 0, value)
    elif target.field == "springref":
        hinge = model.jnt_type[i] == import_mujoco().mjtJoint.mjJNT_HINGE
        element.springref = np.rad2deg(value) if hinge and spec.compiler.degree else value
    elif target.field in ("armature", "frictionloss"):
        setattr(element, target.field, value)
    elif target.field == "friction":
        _set(element, "friction", index, value)
    elif target.field == "size":
        if index and np.isfinite(element.fromto[0]):  # the ends say how long it is
            _stretch(element, value / model.geom_size[i][index])
        else:
            _set(element, "size", index, value)
    elif target.field == "gear":
        _set(element, "gear", index or 0, value)
    elif target.field == "gain":
        bias, before = np.array(element.biasprm), element.gainprm[0]
        bias[1:3] = np.where((bias[1:3] == -before) & (before != 0), -value, bias[1:3])
        element.biasprm = bias
        _set(element, "gainprm", 0, value)
    elif target.field == "ctrlrange":
        low, high = model.actuator_ctrlrange[i]
        if index is None:
            element.ctrlrange = [low / high * value, value]
        else:
            _set(element, "ctrlrange", index, value)


def _write_inertial(spec: Any, model: Any, values: Mapping[Target, float]) -> None:
    """Pin the compiled inertia of the bodies concerned, then scale and move it."""
    kinds = import_mujoco().mjtInertiaFromGeom
    compiler = spec.compiler
    everywhere = compiler.settotalmass > 0 or compiler.inertiafromgeom == kinds.mjINERTIAFROMGEOM_TRUE
    concerned = {t.id(model) for t in values}
    for body in spec.bodies[1:]:
        i = body.id
        if everywhere or i in concerned:
            body.explicitinertial = True
            body.mass, body.ipos, body.iquat = model.body_mass[i], model.body_ipos[i], model.body_iquat[i]
            body.inertia, body.fullinertia = model.body_inertia[i], np.full(6, np.nan)
    compiler.settotalmass, compiler.inertiafromgeom = -1, kinds.mjINERTIAFROMGEOM_AUTO
    for target, value in values.items():
        body = spec.body(target.name)
        if target.field == "mass":
            body.inertia = np.array(body.inertia) * value / body.mass
            body.mass = value
        else:
            _set(body, "ipos", target.index, value)


def _stretch(geom: Any, ratio: float) -> None:
    """Move both ends of a geom that is given by them away from its middle."""
    start, end = np.array(geom.fromto).reshape(2, 3)
    middle, half = (start + end) / 2, (end - start) / 2
    geom.fromto = [*(middle - half * ratio), *(middle + half * ratio)]


def _set(element: Any, name: str, index: int | None, value: float) -> None:
    array = np.array(getattr(element, name), float)
    array[index or 0] = value
    setattr(element, name, array)
