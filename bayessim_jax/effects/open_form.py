"""Laws whose form is not known: what it leaves open becomes a parameter that is fitted with the others."""

from __future__ import annotations

from typing import Any

from bayessim_jax.effects.backlash import Backlash
from bayessim_jax.effects.disturbance_event import DisturbanceEvent
from bayessim_jax.effects.dry_friction import DryFriction

__all__ = ["open_form"]


def open_form(effect: Any) -> Any:
    """The effect with parameters for what its form leaves open; others as they are.

    These are the `onset` of dry friction, below which its sign is rounded; the `taper` of an event, the share of a push
    in which it rises and falls; `stiffness` and `damping` of the teeth between which there is backlash.
    """
    return type(effect)(rounded=True) if isinstance(effect, (Backlash, DisturbanceEvent, DryFriction)) else effect
