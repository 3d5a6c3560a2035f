"""The effects that every diagnosis tries, and how to put effects into a simulator."""

from __future__ import annotations

import difflib
from typing import Any

from bayessim_jax.effects.actuator_bias import ActuatorBias
from bayessim_jax.effects.actuator_deadband import ActuatorDeadband
from bayessim_jax.effects.actuator_delay import ActuatorDelay
from bayessim_jax.effects.actuator_gain import ActuatorGain
from bayessim_jax.effects.actuator_lag import ActuatorLag
from bayessim_jax.effects.actuator_rate_limit import ActuatorRateLimit
from bayessim_jax.effects.actuator_saturation import ActuatorSaturation
from bayessim_jax.effects.armature import Armature
from bayessim_jax.effects.asymmetric_friction import AsymmetricFriction
from bayessim_jax.effects.back_emf import BackEmf
from bayessim_jax.effects.backlash import Backlash
from bayessim_jax.effects.base_tilt import BaseTilt
from bayessim_jax.effects.contact_friction import ContactFriction
from bayessim_jax.effects.contract import Effect
from bayessim_jax.effects.coulomb_friction import CoulombFriction
from bayessim_jax.effects.disturbance_event import DisturbanceEvent
from bayessim_jax.effects.gain_drift import GainDrift
from bayessim_jax.effects.gain_drop import GainDrop
from bayessim_jax.effects.ground_slope import GroundSlope
from bayessim_jax.effects.hysteresis import Hysteresis
from bayessim_jax.effects.joint_coupling import JointCoupling
from bayessim_jax.effects.joint_flexibility import JointFlexibility
from bayessim_jax.effects.joint_spring import JointSpring
from bayessim_jax.effects.link_offset import LinkOffset
from bayessim_jax.effects.load_dependent_friction import LoadDependentFriction
from bayessim_jax.effects.lugre_friction import LuGreFriction
from bayessim_jax.effects.payload import Payload
from bayessim_jax.effects.quadratic_drag import QuadraticDrag
from bayessim_jax.effects.sensor_delay import SensorDelay
from bayessim_jax.effects.sensor_offset import SensorOffset
from bayessim_jax.effects.sensor_scale import SensorScale
from bayessim_jax.effects.soft_stop import SoftStop
from bayessim_jax.effects.stribeck_friction import StribeckFriction
from bayessim_jax.effects.torque_ripple import TorqueRipple
from bayessim_jax.effects.viscous_friction import ViscousFriction
from bayessim_jax.effects.wheel_slip import WheelSlip

__all__ = ["EFFECTS", "lookup_effect", "register_effect"]

PORTS = ("act", "model", "force", "sense")

EFFECTS: dict[str, Any] = {
    effect.name: effect
    for effect in (
        ViscousFriction(),
        CoulombFriction(),
        StribeckFriction(),
        AsymmetricFriction(),
        LoadDependentFriction(),
        LuGreFriction(),
        Hysteresis(),
        QuadraticDrag(),
        JointSpring(),
        SoftStop(),
        TorqueRipple(),
        JointFlexibility(),
        Backlash(),
        Armature(),
        Payload(),
        BaseTilt(),
        LinkOffset(),
        ActuatorGain(),
        ActuatorBias(),
        ActuatorDelay(),
        ActuatorLag(),
        ActuatorSaturation(),
        ActuatorRateLimit(),
        ActuatorDeadband(),
        BackEmf(),
        GainDrop(),
        GainDrift(),
        DisturbanceEvent(),
        SensorOffset(),
        SensorScale(),
        SensorDelay(),
        ContactFriction(),
        GroundSlope(),
        WheelSlip(),
        JointCoupling(),
    )
}


def register_effect(effect: Any) -> Any:
    """Add an effect to those that every diagnosis tries, or raise `ValueError`; returns the effect."""
    if not isinstance(effect, Effect):
        raise ValueError("an effect has a name, a port, places and parameters; derive it from one of the contracts.")
    if effect.port not in PORTS:
        raise ValueError(f"effect {effect.name!r}: port {effect.port!r} is not one of {', '.join(PORTS)}.")
    if effect.name in EFFECTS:
        raise ValueError(f"effect {effect.name!r} is registered already; choose another name.")
    EFFECTS[effect.name] = effect
    return effect


def lookup_effect(name: str) -> Any:
    """Find a registered effect, or raise `ValueError` with the near miss."""
    if name in EFFECTS:
        return EFFECTS[name]
    near = difflib.get_close_matches(name, EFFECTS, n=1, cutoff=0.4)
    hint = f"did you mean {near[0]!r}?" if near else f"choose one of {', '.join(EFFECTS)}."
    raise ValueError(f"unknown effect {name!r}: {hint}")
