"""Time of compiled and other functions: repeats, median and spread."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import Any

import jax

__all__ = ["CLOCKS", "Parts", "Spread", "choose_clock", "chosen_clock", "measure", "now", "stopwatch"]

CLOCKS: dict[str, Callable[[], float]] = {"wall": time.perf_counter, "cpu": time.process_time}
"""`wall` is what a person waits; `cpu`, summed over threads, is what is left to compare on a machine that is busy."""

_chosen = {"clock": "wall"}


def choose_clock(name: str) -> None:
    """Let everything that is timed from now on, on both sides, be timed by this clock."""
    if name not in CLOCKS:
        raise ValueError(f"clock {name!r}: choose one of {', '.join(CLOCKS)}.")
    _chosen["clock"] = name


def chosen_clock() -> str:
    """Name of the chosen clock."""
    return _chosen["clock"]


def now() -> float:
    """Seconds on the chosen clock."""
    return CLOCKS[_chosen["clock"]]()


@dataclass(frozen=True)
class Parts:
    """Seconds of the three parts of a round."""

    policy: float
    rollouts: float
    estimator: float

    @property
    def total(self) -> float:
        """The whole round, s."""
        return sum(getattr(self, f.name) for f in fields(self))


@dataclass(frozen=True)
class Spread:
    """Median and range of repeated measurements."""

    values: tuple[float, ...]

    @classmethod
    def of(cls, values: Sequence[float]) -> Spread:
        """Collect measurements; there must be one at least."""
        if not values:
            raise ValueError("Spread.of: no values; measure at least once.")
        return cls(tuple(values))

    @property
    def median(self) -> float:
        """The middle value."""
        return statistics.median(self.values)

    def __str__(self) -> str:
        """`median (lowest – highest)`, with three significant digits."""
        return f"{self.median:.3g} ({min(self.values):.3g} – {max(self.values):.3g})"


def stopwatch(function: Callable[..., Any], *arguments: Any) -> tuple[float, Any]:
    """Seconds of one call until every array of its result is there, and the result."""
    start = now()
    result = jax.block_until_ready(function(*arguments))
    return now() - start, result


def measure(function: Callable[..., Any], *arguments: Any, repeats: int = 5, shortest: float = 0.1) -> Spread:
    """Seconds of a call, `repeats` times, after one that is not counted; short calls are timed many in a row."""
    jax.block_until_ready(function(*arguments))
    once, _ = stopwatch(function, *arguments)
    calls = max(1, round(shortest / max(once, 1e-6)))

    def lap() -> float:
        start = now()
        for _ in range(calls):
            jax.block_until_ready(function(*arguments))
        return (now() - start) / calls

    return Spread.of([lap() for _ in range(repeats)])
