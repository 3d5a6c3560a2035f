"""Wall-clock time of compiled and other functions: repeats, median and spread."""

from __future__ import annotations

import statistics
import time
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

import jax

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

__all__ = ["Parts", "Spread", "measure", "stopwatch"]


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
    start = time.perf_counter()
    result = jax.block_until_ready(function(*arguments))
    return time.perf_counter() - start, result


def measure(function: Callable[..., Any], *arguments: Any, repeats: int = 5) -> Spread:
    """Seconds of `repeats` calls after one that is not counted, which compiles."""
    jax.block_until_ready(function(*arguments))
    return Spread.of([stopwatch(function, *arguments)[0] for _ in range(repeats)])
