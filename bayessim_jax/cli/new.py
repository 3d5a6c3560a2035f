"""`bayessim new CASE --model robot.xml`: a case to start from."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from bayessim_jax.cli.parsing import UsageError, parse

if TYPE_CHECKING:
    from collections.abc import Sequence

__all__ = ["New", "new"]


@dataclass(frozen=True)
class New:
    """Make a case folder from a MuJoCo model: the model, and a case.toml with its joints, actuators and candidates.

    Nothing that is there already is overwritten.
    """

    case: tyro.conf.Positional[Annotated[Path, tyro.conf.arg(metavar="CASE")]]
    """Folder to make."""
    model: Annotated[Path, tyro.conf.arg(metavar="FILE")]
    """The robot's MJCF; it is copied into the folder with the files that it refers to."""


def new(words: Sequence[str]) -> int:
    """Make a case; returns the exit code."""
    command = parse(New, words, "bayessim new")
    from bayessim_jax.recordings.starter import start_case

    try:
        path, remarks = start_case(command.case, command.model)
    except ValueError as error:
        raise UsageError(str(error)) from error
    for remark in remarks:
        print(f"warning     {remark}")
    print(f"{path}: put recordings into {path.parent / 'recordings'}, keep the parameters that are unknown, then")
    print(f"bayessim check {path.parent}")
    return 0
