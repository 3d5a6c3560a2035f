"""Wheels of a skid-steered vehicle that slip."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from bayessim_jax.effects.contract import ActEffect, EffectParameter, Memory, Moment, Scales, Values

__all__ = ["WheelSlip"]


class WheelSlip(ActEffect):
    """(u_l, u_r) ↦ those of a vehicle whose speed is (1 − s) and whose turning rate is (1 − c) of the commanded ones.

    With the mean u = (u_l + u_r)/2 and half the difference w = (u_r − u_l)/2:

        u_l ↦ u_l − s u + c w,   u_r ↦ u_r − s u − c w

    s is the longitudinal slip, c what is lost in turning to the wheels' lateral slip; neither has a unit.

    Source: Mandow et al. 2007
    """

    name = "wheel_slip"

    def choose(self, names: Sequence[str]) -> list[str]:
        """Pairs of actuators whose names differ by `left` and `right`."""
        pairs = [(n, n.replace("left", "right")) for n in names if "left" in n and n.replace("left", "right") in names]
        return [f"actuator/{left}#actuator/{right}" for left, right in pairs]

    def parameters(self, place: str, scales: Scales) -> tuple[EffectParameter, ...]:
        """The slips s and c."""
        return (
            EffectParameter("longitudinal", "", -0.2, 0.9, 0.0, 0.1),
            EffectParameter("lateral", "", -0.2, 0.95, 0.0, 0.2),
        )

    def command(self, values: Values, memory: Memory, command: Any, moment: Moment) -> tuple[Any, Memory]:
        """What of the commands moves the vehicle."""
        left, right = command
        forwards = values["longitudinal"] * (0.5 * (left + right))
        turning = values["lateral"] * (0.5 * (right - left))
        return (left - forwards + turning, right - forwards - turning), memory
