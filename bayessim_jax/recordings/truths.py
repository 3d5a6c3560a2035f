"""The hidden parameters of a target over the rounds of a run."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

__all__ = ["Truths"]


@dataclass(frozen=True)
class Truths:
    """θ* of every seed, NaN where it is unknown, and what it becomes from a round on."""

    first: Float[np.ndarray, "seed d"]
    later: Float[np.ndarray, "seed d"]
    change: int | None = None
    """The first round, counted from 1, in which θ* is the later one."""

    @classmethod
    def constant(cls, truths: Float[np.ndarray, "seed d"]) -> Truths:
        """θ* that never changes."""
        return cls(truths, truths)

    def leading(self, count: int) -> Truths:
        """The first `count` parameters: those that are inferred of a target that has more."""
        return Truths(self.first[:, :count], self.later[:, :count], self.change)

    def at(self, index: int) -> Float[np.ndarray, "seed d"]:
        """θ* in round `index`, counted from 1."""
        return self.later if self.change is not None and index >= self.change else self.first
