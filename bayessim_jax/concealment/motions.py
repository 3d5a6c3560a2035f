"""How recordings are driven: signals between −1 and 1, stretches without motor, initial states, sample times."""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float, Int

from bayessim_jax.concealment.world import count_substeps

if TYPE_CHECKING:
    from collections.abc import Callable

    from bayessim_jax.concealment.drive import Drive

__all__ = ["KINDS", "UNDRIVEN", "Motion", "draw_motions"]

LEAD = 0.2
"""s that a machine moves before its recording begins, unless it is let go then."""
REST = 0.2
"""The last share of a recording, without motor."""


@dataclass(frozen=True)
class Motion:
    """One recording, before anything has moved."""

    signals: Float[np.ndarray, "rows nu"]
    off: Bool[np.ndarray, "rows nu"]
    """Where a motor exerts nothing."""
    qpos: Float[np.ndarray, " nq"]
    qvel: Float[np.ndarray, " nv"]
    """The state in which the machine begins."""
    marks: Int[np.ndarray, " rows"]
    """Steps of the world, from the beginning of the recording, at which its rows lie and commands change."""
    lead: int
    """Steps of the world before it."""
    steps: int
    """Steps of the world within it."""
    seed: tuple[int, ...]

    def chance(self, name: str) -> np.random.Generator:
        """What is random in this recording for the law of a name: the same however strong that is."""
        return np.random.default_rng([*self.seed, zlib.crc32(name.encode())])


def _sines(rng: np.random.Generator, time: np.ndarray) -> np.ndarray:
    """Three sines between 0.2 and 1.6 Hz."""
    waves = [np.sin(2 * np.pi * (rng.uniform(0.2, 1.6) * time + rng.uniform())) for _ in range(3)]
    return np.clip(sum(waves) / 2, -1, 1)


def _chirp(rng: np.random.Generator, time: np.ndarray) -> np.ndarray:
    """A sine whose frequency grows from about 0.3 to about 4 Hz."""
    first, last, span = rng.uniform(0.2, 0.5), rng.uniform(3.0, 5.0), time[-1] + 1e-9
    rate = np.log(last / first) / span
    return np.sin(2 * np.pi * (first * np.expm1(rate * time) / rate + rng.uniform()))


def _steps(rng: np.random.Generator, time: np.ndarray) -> np.ndarray:
    """Levels that change in sign, each held for 0.2 to 0.6 s."""
    edges = np.cumsum(rng.uniform(0.2, 0.6, 5 * int(np.ceil(time[-1])) + 2))
    levels = rng.uniform(0.3, 1.0, len(edges) + 1) * np.where(np.arange(len(edges) + 1) % 2, 1, -1)
    return levels[np.searchsorted(edges, time)] * rng.choice([-1, 1])


def _free(rng: np.random.Generator, time: np.ndarray) -> np.ndarray:
    """Nothing."""
    return np.zeros(len(time))


SIGNALS: dict[str, Callable[[np.random.Generator, np.ndarray], np.ndarray]] = {
    "sines": _sines,
    "chirp": _chirp,
    "steps": _steps,
    "free": _free,
    "released": _free,
}
KINDS = ("mixed", *SIGNALS)
"""What can be asked for; `mixed` takes sines, a chirp and steps in turn. `released` begins at rest, `free` does not."""
UNDRIVEN = ("free", "released")
"""Those in which motors that may be off exert nothing."""


def draw_motions(
    rng: np.random.Generator, drive: Drive, kind: str, recordings: int, rows: int, stride: int, h: float, jitter: float
) -> list[Motion]:
    """Motions for a drive; `rows` rows of a recording, one every `stride` time steps of h seconds of the model.

    Sample times scatter by `jitter` times the distance of rows, uniformly.
    """
    substeps = count_substeps(h)
    fine = substeps * stride
    motions = []
    for k in range(recordings):
        name = ("sines", "chirp", "steps")[k % 3] if kind == "mixed" else kind
        time = np.arange(rows) * stride * h
        size = rng.uniform(0.6, 1.1)
        columns = [np.clip(size * SIGNALS[name](rng, time), -1, 1) for _ in range(drive.count)]
        signals = np.stack(columns, 1) if columns else np.zeros((rows, 0))
        tail = np.arange(rows) >= (0 if name in UNDRIVEN else (1 - REST) * rows)
        shift = rng.integers(-round(jitter * fine / 2), round(jitter * fine / 2) + 1, rows)
        shift[0] = 0
        motions.append(
            Motion(
                signals=signals,
                off=tail[:, None] & drive.frees,
                qpos=drive.home
                + drive.scatter * rng.uniform(0.3, 1, len(drive.home)) * rng.choice([-1, 1], len(drive.home)),
                qvel=drive.swing * rng.uniform(-1, 1, len(drive.swing)) * (name != "released"),
                marks=np.arange(rows) * fine + shift,
                lead=0 if name == "released" else round(LEAD * substeps / h),
                steps=rows * fine,
                seed=(int(rng.integers(2**31)), k),
            )
        )
    return motions
