"""`bayessim systems`: what can be identified and controlled."""

from __future__ import annotations

from typing import TYPE_CHECKING

from bayessim_jax.cli.parsing import UsageError
from bayessim_jax.systems import SYSTEMS

if TYPE_CHECKING:
    from collections.abc import Sequence

__all__ = ["systems"]


def systems(words: Sequence[str]) -> int:
    """Print every registered system with its parameters, units and prior ranges."""
    if words in (["--help"], ["-h"]):
        print("usage: bayessim systems\n\nLists every system: parameters, units, prior ranges, task and learner.")
        return 0
    if words:
        raise UsageError(f"bayessim systems takes no arguments, but was given {words[0]!r}.")
    for name, entry in SYSTEMS.items():
        try:
            system = entry.system()
        except ValueError as error:  # an optional package is missing
            print(f"{name}: {entry.summary}\n  {error}\n")
            continue
        box, seen = system.parameters, system.observations
        bounds = zip(box.names, box.low.tolist(), box.high.tolist(), box.units, strict=True)
        parameters = ", ".join(f"{n} {low:.3g} to {high:.3g} {unit}".rstrip() for n, low, high, unit in bounds)
        channels = ", ".join(f"{n} ({u})" if u else n for n, u in zip(seen.names, seen.units, strict=True))
        print(f"{name}: {entry.summary}")
        print(f"  parameters    {parameters}")
        print(f"  observations  {channels}")
        print(f"  learner       {entry.learner}\n")
    return 0
