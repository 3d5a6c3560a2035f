"""Laws whose form is not known: what it leaves open becomes a parameter that is fitted with the others."""

from __future__ import annotations

from typing import Any

from bayessim_jax.effects.disturbance_event import DisturbanceEvent
from bayessim_jax.effects.dry_friction import DryFriction

__all__ = ["open_form"]


def open_form(effect: Any) -> Any:
    """The effect with one parameter more for what its form leaves open; others as they are.

    That is the `onset` of dry friction, below which its sign is rounded, and the `taper` of an event, the share of a
    push in which it rises and falls.
    """
    return type(effect)(rounded=True) if isinstance(effect, (DryFriction, DisturbanceEvent)) else effect
