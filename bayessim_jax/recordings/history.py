"""Everything drawn and observed so far, as arrays over rounds and seeds."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float

if TYPE_CHECKING:
    from bayessim_jax.contracts import Recording

__all__ = ["History"]


@dataclass(frozen=True)
class History:
    """Posterior draws and the target's recordings of each round; NumPy arrays, grown a round at a time."""

    draws: Float[np.ndarray, "round seed draw d"]
    times: Float[np.ndarray, "round seed set rows"]
    observations: Float[np.ndarray, "round seed set rows obs"]
    actions: Float[np.ndarray, "round seed set steps act"]
    rewards: Float[np.ndarray, "round seed set steps"]
    valid: Bool[np.ndarray, "round seed set steps"]

    @property
    def rounds(self) -> int:
        """Number of rounds held."""
        return self.draws.shape[0]

    @classmethod
    def of_round(cls, draws: Float[np.ndarray, "seed draw d"], recordings: Recording) -> History:
        """A history of one round; every leaf of `recordings` has leading axes seed and set."""
        return cls(
            draws=np.asarray(draws)[None],
            **{f.name: np.asarray(getattr(recordings, f.name))[None] for f in fields(cls) if f.name != "draws"},
        )

    def extend(self, later: History) -> History:
        """The rounds of this history, then those of a later one."""
        pairs = {f.name: (getattr(self, f.name), getattr(later, f.name)) for f in fields(self)}
        return History(**{name: np.concatenate(pair) for name, pair in pairs.items()})

    def first(self, rounds: int) -> History:
        """The first rounds alone."""
        return History(**{f.name: getattr(self, f.name)[:rounds] for f in fields(self)})
