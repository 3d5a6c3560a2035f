"""`bayessim conceal MODEL --effect NAME --out CASE`: a case in which an effect is hidden."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from bayessim_jax.cli.parsing import UsageError, parse

if TYPE_CHECKING:
    from collections.abc import Sequence

__all__ = ["Conceal", "conceal"]


@dataclass(frozen=True)
class Conceal:
    """Make a case from a MuJoCo model: recordings of a simulated machine in which an effect is hidden.

    What it is, how strong, and the true parameters are sealed in the folder's sealed.json. Without an effect the
    machine is as its model says.
    """

    model: tyro.conf.Positional[Annotated[Path, tyro.conf.arg(metavar="MODEL")]]
    """MJCF of the machine, with hinges or slides."""
    out: Annotated[Path, tyro.conf.arg(metavar="CASE")]
    """Folder to make."""
    effect: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME...")] = ()
    """What to hide, such as stribeck_friction; unknown:NAME for what is in no library."""
    at: Annotated[tuple[str, ...], tyro.conf.arg(metavar="PLACE...")] = ()
    """Where, such as joint/elbow; drawn by the seed if left out."""
    strength: Annotated[tuple[float, ...], tyro.conf.arg(metavar="S...")] = (0.3,)
    """Root mean square of the effect's force over that of motors and gravity."""
    parameters: Annotated[tuple[str, ...], tyro.conf.arg(metavar="PATH...")] = ()
    """What is unknown in the model, such as body/arm/mass; the masses of what moves if left out."""
    motions: Literal["mixed", "sines", "chirp", "steps", "free", "released"] = "mixed"
    """What the motors do."""
    recordings: int = 6
    """How many."""
    seconds: float = 4.0
    """Length of each."""
    rate: float | None = None
    """Rows per second; one for two time steps of the model if left out."""
    noise: float = 1.0
    """Sensor noise, in units of 1e-3 rad or 2e-4 m."""
    no_velocities: bool = False
    """Leave measured velocities out."""
    quantize: Annotated[float | None, tyro.conf.arg(metavar="COUNTS")] = None
    """Counts of the encoders for a turn or a metre."""
    jitter: float = 0.0
    """Scatter of sample times, in units of their distance."""
    seed: int = 0
    """Seed of everything random."""


def conceal(words: Sequence[str]) -> int:
    """Make a case; returns the exit code."""
    command = parse(Conceal, words, "bayessim conceal")
    if command.seed < 0:
        raise UsageError(f"seed is {command.seed}; give 0 or more.")
    from bayessim_jax.recordings.concealing import NOTHING, SEALED
    from bayessim_jax.recordings.concealing import conceal as write

    one = len(command.strength) == 1
    try:
        sealed = write(
            command.out,
            command.model,
            command.effect,
            at=command.at or None,
            strength=command.strength[0] if one else command.strength,
            parameters=command.parameters or None,
            motions=command.motions,
            recordings=command.recordings,
            seconds=command.seconds,
            rate=command.rate,
            noise=command.noise,
            velocities=not command.no_velocities,
            quantize=command.quantize,
            jitter=command.jitter,
            seed=command.seed,
            say=lambda text: print(f"{text}."),
        )
    except ValueError as error:
        raise UsageError(str(error)) from error
    print(f"{command.out}: {command.recordings} recordings; what is concealed is in {command.out / SEALED}.")
    if sealed["effects"] and sealed["lacks"]["with_best"] < NOTHING:
        print("Note: other values of what is unknown make up for it; no diagnosis can find it in these motions.")
    print(f"bayessim diagnose {command.out}")
    return 0
