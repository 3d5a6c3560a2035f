"""A torque that comes and goes with the angle: cogging, teeth, an eccentric gear."""

from __future__ import annotations

import math

import jax.numpy as jnp
import mujoco

from bayessim_jax.effects.contract import EffectParameter, ForceEffect, Memory, Moment, Number, Scales, Values
from bayessim_jax.effects.places import joints

__all__ = ["TorqueRipple"]

LEAST = 1.8
"""Cycles per turn, or in the range of a slide."""


class TorqueRipple(ForceEffect):
    """τ = A sin(n q + φ), A in N m or N, n in cycles per turn (per 2π m of a slide), φ in rad.

    From nearly two cycles per turn: what comes and goes once in a turn is weight that is elsewhere, and is called so.
    """

    name = "torque_ripple"

    def places(self, model: mujoco.MjModel) -> list[str]:
        """Every hinge and slide."""
        return joints(model)

    def parameters(self, place: str, scales: Scales) -> tuple[EffectParameter, ...]:
        """A, n and φ."""
        turns = 1.0 if scales.unit == "rad" else math.pi / scales.position
        force = scales.force
        return (
            EffectParameter("amplitude", scales.force_unit, 0.0, force, 0.0, 0.1 * force),
            EffectParameter("cycles", "", LEAST * turns, 100.0 * turns, 6.0 * turns, 6.0 * turns, log=True, scan=20),
            EffectParameter("phase", "rad", -1.5 * math.pi, 1.5 * math.pi, 0.0, 0.0, scan=3),
        )

    def force(self, values: Values, memory: Memory, moment: Moment) -> tuple[Number, Memory]:
        """A sine of the angle."""
        return values["amplitude"] * jnp.sin(values["cycles"] * moment.position + values["phase"]), memory
