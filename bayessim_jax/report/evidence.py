"""What a report is made from: plain arrays and tables, wherever they come from."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from bayessim_jax.report.beside import Beside
from bayessim_jax.report.drives import Drives, Scene

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

__all__ = ["OnlineRun"]


@dataclass(frozen=True)
class OnlineRun:
    """A run of the outer loop: settings, facts, the metrics lines, draws of every round, and θ* where it is known."""

    settings: Mapping[str, Any]
    facts: Mapping[str, Any]
    lines: Sequence[Mapping[str, Any]]
    draws: Float[np.ndarray, "round seed draw d"]
    names: Sequence[str]
    units: Sequence[str]
    low: Float[np.ndarray, " d"]
    high: Float[np.ndarray, " d"]
    truths: Float[np.ndarray, "seed d"] | None = None
    """After the last round."""
    drives: Drives | None = None
    """What the target showed, where a planner acted."""
    scene: Scene | None = None
    beside: Beside | None = None
    """The newest recording of a target with contacts, and the simulator under the same actions."""
    apparent: Float[np.ndarray, "seed round d"] | None = None
    """θ that the target seems to have, where it is a vehicle that slips."""

    @property
    def rounds(self) -> int:
        """Rounds done."""
        return self.draws.shape[0]

    @property
    def seeds(self) -> list[int]:
        """The seeds, in the order of the arrays."""
        return list(dict.fromkeys(line["seed"] for line in self.lines))

    @property
    def inferred(self) -> bool:
        """Whether any round inferred; where none did, the posterior of every round is the prior."""
        return bool(np.isfinite(self.series("log_q_validation")).any())

    @property
    def corrected(self) -> bool:
        """Whether posteriors are corrected by simulated sets: by all proposals but the paper's."""
        return self.settings.get("proposal") != "paper"

    @property
    def change(self) -> tuple[int, str] | None:
        """The round from which the target is another one, and in what."""
        told = dict(self.settings.get("change") or {})
        if not told:
            return None
        index = int(told.pop("round"))
        return index, ", ".join(f"{k} = {v if isinstance(v, str) else f'{v:g}'}" for k, v in told.items())

    def series(self, name: str) -> Float[np.ndarray, "seed round"]:
        """One number of the metrics lines; NaN where it is null or absent."""
        place = {seed: i for i, seed in enumerate(self.seeds)}
        values = np.full((len(place), self.rounds), np.nan)
        for line in self.lines:
            value = line.get(name)
            values[place[line["seed"]], line["round"] - 1] = np.nan if value is None else float(value)
        return values

    def vectors(self, name: str) -> Float[np.ndarray, "seed round d"]:
        """A number for each parameter, such as `mean`, `sd` or `rank_true`."""
        each = [self._replaced(name, parameter).series(name) for parameter in self.names]
        return np.stack(each, axis=-1)

    def truth_over_rounds(self) -> Float[np.ndarray, "seed round d"] | None:
        """θ* in every round, where it is known."""
        if self.truths is None:
            return None
        told = self.vectors("truth")
        return np.where(np.isfinite(told), told, self.truths[:, None])

    def truth_at(self, index: int) -> Float[np.ndarray, " d"] | None:
        """θ* of the first seed in a round, counted from 1."""
        known = self.truth_over_rounds()
        return None if known is None else known[0, index - 1]

    def _replaced(self, name: str, parameter: str) -> OnlineRun:
        lines = [{**line, name: (line.get(name) or {}).get(parameter)} for line in self.lines]
        return replace(self, lines=lines)
