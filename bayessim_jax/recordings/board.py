"""The numbers of each round as TensorBoard logs."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from tensorboardX import SummaryWriter

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

__all__ = ["Board", "scalars"]


def scalars(line: Mapping[str, Any]) -> dict[str, float]:
    """The finite numbers of a metrics line; a table `mean = {length: …}` becomes `mean/length`."""
    flat: dict[str, float] = {}
    for name, value in line.items():
        if isinstance(value, dict):
            flat |= {f"{name}/{key}": number for key, number in scalars(value).items()}
        elif isinstance(value, (int, float)) and name not in ("round", "seed") and math.isfinite(value):
            flat[name] = float(value)
    return flat


class Board:
    """TensorBoard writers, one folder for each seed; steps after `done` rounds are purged from earlier logs."""

    def __init__(self, path: Path, seeds: Sequence[int], done: int = 0) -> None:
        purge = done + 1 if done else None
        self.writers = {seed: SummaryWriter(str(path / f"seed{seed}"), purge_step=purge) for seed in seeds}

    def close(self) -> None:
        """Flush and close the logs."""
        for writer in self.writers.values():
            writer.close()

    def write(self, lines: Sequence[Mapping[str, Any]]) -> None:
        """Log metrics lines under their round and seed."""
        for line in lines:
            writer = self.writers[line["seed"]]
            for name, value in scalars(line).items():
                writer.add_scalar(name, value, line["round"])
            writer.flush()
