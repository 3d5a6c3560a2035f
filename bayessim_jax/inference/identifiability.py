"""Which parameters recordings inform: posterior against prior, and ridges on which two parameters trade off."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

__all__ = ["Identifiability", "find_unidentified"]

UNINFORMED = 0.8
"""Of a prior's standard deviation: a posterior that is as wide says nothing that the prior did not."""
EDGE = 2.33
"""Of z: the outermost hundredth of a prior."""
TRADE, WIDE = 0.95, 0.1
"""Correlation from which two parameters are a ridge where one of them is still this wide, in prior deviations."""


@dataclass(frozen=True)
class Identifiability:
    """Parameters by what the recordings say of them."""

    not_informed: list[str]
    ridges: list[tuple[str, str, float]]
    """Two parameters and the correlation between them (of z, where every prior is standard normal)."""
    at_edge: list[str]
    """Parameters in the outermost hundredth of their prior, on one side."""
    contraction: dict[str, float]
    """1 − sd / prior sd, in z: 0 where nothing was learned, 1 where everything was."""

    def as_table(self) -> dict[str, object]:
        """The block of `inference.json`."""
        return {
            "not_informed": self.not_informed,
            "ridges": [{"parameters": [a, b], "correlation": round(r, 4)} for a, b, r in self.ridges],
            "at_edge": self.at_edge,
            "contraction": {name: round(c, 4) for name, c in self.contraction.items()},
        }


def find_unidentified(z: Float[np.ndarray, "draws d"], names: tuple[str, ...]) -> Identifiability:
    """Judge by posterior draws in z, whose prior is N(0, I)."""
    sd = z.std(0)
    correlation = np.atleast_2d(np.corrcoef(z, rowvar=False)) if len(names) > 1 else np.eye(len(names))
    ridges = [
        (names[i], names[j], float(correlation[i, j]))
        for i in range(len(names))
        for j in range(i)
        if abs(correlation[i, j]) > TRADE and max(sd[i], sd[j]) > WIDE
    ]
    return Identifiability(
        not_informed=[name for name, s in zip(names, sd, strict=True) if s > UNINFORMED],
        ridges=[(b, a, r) for a, b, r in ridges],
        at_edge=[name for name, m in zip(names, z.mean(0), strict=True) if abs(m) > EDGE],
        contraction={name: float(1 - s) for name, s in zip(names, sd, strict=True)},
    )
