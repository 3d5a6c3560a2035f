"""Effects that MJCF itself can say, written into a model."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import mujoco
import numpy as np

from bayessim_jax.effects.contact_friction import ContactFriction
from bayessim_jax.effects.directions import link_axes, tilt_axes, turn_gravity
from bayessim_jax.effects.places import at, detail, find_body

__all__ = ["write_mjcf"]

Values = Mapping[str, float]
TINY = 1e-9


def write_mjcf(spec: mujoco.MjSpec, effect: Any, place: str, values: Values) -> bool:
    """Put an effect with these parameters into a model, or return False where MJCF cannot say it.

    What is written acts as the effect does up to the way in which MuJoCo integrates it; forces are in the units of the
    compiled model.
    """
    write = WRITERS.get(effect.name)
    return write is not None and write(spec, place, values)


def _joint(spec: mujoco.MjSpec, place: str) -> Any:
    return spec.joint(at(place).removeprefix("joint/"))


def _damping(power: int, name: str) -> Callable[..., bool]:
    def write(spec: mujoco.MjSpec, place: str, values: Values) -> bool:
        damping = np.array(_joint(spec, place).damping)
        damping[power] += values[name]
        _joint(spec, place).damping = damping
        return True

    return write


def _friction(spec: mujoco.MjSpec, place: str, values: Values) -> bool:
    _joint(spec, place).frictionloss += values["coulomb"]
    return True


def _armature(spec: mujoco.MjSpec, place: str, values: Values) -> bool:
    _joint(spec, place).armature += values["inertia"]
    return True


def _spring(spec: mujoco.MjSpec, place: str, values: Values) -> bool:
    """Only one spring has room on a joint."""
    joint = _joint(spec, place)
    if np.any(joint.stiffness):
        return False
    turn = joint.type == mujoco.mjtJoint.mjJNT_HINGE and spec.compiler.degree
    joint.stiffness = [values["stiffness"], 0.0, values["cubic"]]
    joint.springref = math.degrees(values["reference"]) if turn else values["reference"]
    return True


def _motor(spec: mujoco.MjSpec, place: str) -> Any:
    """An actuator of the kind that the compiled model has a gain and a bias for, or None."""
    for number, actuator in enumerate(spec.actuators):
        if (actuator.name or f"actuator{number}") == at(place).removeprefix("actuator/"):
            fixed = actuator.gaintype == mujoco.mjtGain.mjGAIN_FIXED
            plain = actuator.biastype in (mujoco.mjtBias.mjBIAS_NONE, mujoco.mjtBias.mjBIAS_AFFINE)
            return actuator if fixed and plain else None
    return None


def _scale(spec: mujoco.MjSpec, place: str, values: Values) -> bool:
    motor = _motor(spec, place)
    if motor is None:
        return False
    gain = np.array(motor.gainprm)
    gain[0] *= values["gain"]
    motor.gainprm = gain
    return True


def _bias(spec: mujoco.MjSpec, place: str, values: Values) -> bool:
    return _affine(spec, place, lambda gain: (gain, gain * values["torque"], 0.0))


def _back_emf(spec: mujoco.MjSpec, place: str, values: Values) -> bool:
    k, resistance = values["constant"], values["resistance"]
    motor = _motor(spec, place)
    gear = float(motor.gear[0]) if motor is not None else 1.0
    return gear != 0.0 and _affine(spec, place, lambda gain: (gain / resistance, 0.0, -gain * k / resistance / gear))


def _affine(spec: mujoco.MjSpec, place: str, change: Callable[[float], tuple[float, float, float]]) -> bool:
    """A new gain, and what is added to the constant and to the velocity's part of the bias."""
    motor = _motor(spec, place)
    if motor is None:
        return False
    gain, bias = np.array(motor.gainprm), np.array(motor.biasprm)
    new, constant, rate = change(float(gain[0]))
    gain[0], bias[0], bias[2] = new, bias[0] + constant, bias[2] + rate
    motor.gainprm, motor.biasprm, motor.biastype = gain, bias, mujoco.mjtBias.mjBIAS_AFFINE
    return True


def _saturation(spec: mujoco.MjSpec, place: str, values: Values) -> bool:
    motor, limit = _motor(spec, place), values["limit"]
    if motor is None or not math.isfinite(limit):
        return False
    low, high = motor.ctrlrange if np.any(motor.ctrlrange) else (-limit, limit)
    motor.ctrlrange = [max(low, -limit), min(high, limit)]
    motor.ctrllimited = mujoco.mjtLimited.mjLIMITED_TRUE
    return True


def _lag(spec: mujoco.MjSpec, place: str, values: Values) -> bool:
    motor = _motor(spec, place)
    if motor is None or motor.dyntype != mujoco.mjtDyn.mjDYN_NONE or motor.delay:
        return False
    dynamics = np.array(motor.dynprm)
    dynamics[0] = max(values["time_constant"], TINY)
    motor.dyntype, motor.dynprm = mujoco.mjtDyn.mjDYN_FILTEREXACT, dynamics
    return True


def _delay(spec: mujoco.MjSpec, place: str, values: Values) -> bool:
    motor = _motor(spec, place)
    if motor is None or motor.delay or motor.dyntype != mujoco.mjtDyn.mjDYN_NONE:
        return False
    motor.delay, motor.interp = values["seconds"], 1
    motor.nsample = math.ceil(values["seconds"] / spec.option.timestep) + 2
    return True


def _tilt(spec: mujoco.MjSpec, place: str, values: Values) -> bool:
    model = spec.compile()
    axes, gravity = tilt_axes(model, place)[: len(values)], np.array(spec.option.gravity)
    angles: list[Any] = list(values.values())
    spec.option.gravity = [float(x) for x in turn_gravity(lambda _, k: float(gravity[k]), axes, angles)]
    return True


def _payload(spec: mujoco.MjSpec, place: str, values: Values) -> bool:
    """A small body without a joint."""
    model = spec.compile()
    anchor, along, _ = link_axes(model, find_body(model, place))
    body = spec.body(at(place).removeprefix("body/"))
    load = body.add_body(name=f"payload_{body.name}", pos=anchor + values["position"] * along)
    load.explicitinertial, load.mass, load.ipos = True, max(values["mass"], TINY), [0.0, 0.0, 0.0]
    load.inertia = [TINY, TINY, TINY]
    return True


def _shift(spec: mujoco.MjSpec, place: str, values: Values) -> bool:
    model = spec.compile()
    number = find_body(model, place)
    axis = link_axes(model, number)[2 if detail(place) == "across" else 1]
    body = spec.body(at(place).removeprefix("body/"))
    body.explicitinertial, body.mass = True, float(model.body_mass[number])
    body.inertia, body.iquat = model.body_inertia[number], model.body_iquat[number]
    body.fullinertia = np.full(6, np.nan)
    body.ipos = model.body_ipos[number] + values["offset"] * axis
    return True


def _slip(spec: mujoco.MjSpec, place: str, values: Values) -> bool:
    """The geom and what of the world it can touch, as the effect sets them."""
    model = spec.compile()
    targets = ContactFriction().targets(model, place)
    named = [(model.geom(index[0]).name, k == 0) for k, (_, index) in enumerate(targets)]
    if not all(name for name, _ in named):
        return False
    for name, first in named:
        friction = np.array(spec.geom(name).friction)
        friction[0] = values["coefficient"] if first else min(friction[0], values["coefficient"])
        spec.geom(name).friction = friction
    return True


WRITERS: dict[str, Callable[[mujoco.MjSpec, str, Values], bool]] = {
    "viscous_friction": _damping(0, "viscous"),
    "quadratic_drag": _damping(1, "coefficient"),
    "coulomb_friction": _friction,
    "joint_spring": _spring,
    "armature": _armature,
    "actuator_gain": _scale,
    "actuator_bias": _bias,
    "actuator_saturation": _saturation,
    "actuator_lag": _lag,
    "actuator_delay": _delay,
    "back_emf": _back_emf,
    "base_tilt": _tilt,
    "ground_slope": _tilt,
    "contact_friction": _slip,
    "payload": _payload,
    "link_offset": _shift,
}
