"""Laws whose form is not known: what it leaves open becomes parameters that are fitted with the others."""

from __future__ import annotations

from typing import Any

__all__ = ["OpenForm", "open_form"]


class OpenForm:
    """Beside a contract: an effect with more parameters where it is `rounded`."""

    def __init__(self, rounded: bool = False) -> None:
        """With `rounded` what its form leaves open is free; otherwise its law is the sharp one."""
        self.rounded = rounded


def open_form(effect: Any) -> Any:
    """The effect with parameters for what its form leaves open; others as they are.

    These are the `onset` of dry friction, below which its sign is rounded, and the share that it may `hold` there; the
    `taper` of an event, the share of a push in which it rises and falls; `stiffness` and `damping` of the teeth between
    which there is backlash.
    """
    return type(effect)(rounded=True) if isinstance(effect, OpenForm) else effect
