"""`bayessim systems`: what can be identified and controlled."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rich.console import Console
from rich.table import Table

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
    table = Table(box=None, pad_edge=False, padding=(0, 3, 0, 0))
    for title in ("system", "parameters and prior", "observations", "learner", "task"):
        table.add_column(title)
    for name, entry in SYSTEMS.items():
        system = entry.system()
        box, seen = system.parameters, system.observations
        bounds = zip(box.names, box.low.tolist(), box.high.tolist(), box.units, strict=True)
        parameters = "\n".join(f"{n} {low:.3g} to {high:.3g} {unit}".rstrip() for n, low, high, unit in bounds)
        channels = "\n".join(f"{n} ({u})" if u else n for n, u in zip(seen.names, seen.units, strict=True))
        table.add_row(name, parameters, channels, entry.learner.upper(), entry.summary, end_section=True)
        table.add_row()
    Console(highlight=False).print(table)
    return 0
