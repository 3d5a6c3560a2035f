"""`bayessim report RUN`: the report of a run folder, from what lies in it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from bayessim_jax.cli.parsing import UsageError
from bayessim_jax.recordings.files import write_text
from bayessim_jax.recordings.posterior import read_draws
from bayessim_jax.recordings.run_folder import RunFolder
from bayessim_jax.report.evidence import OnlineRun
from bayessim_jax.report.online import render

if TYPE_CHECKING:
    from collections.abc import Sequence

__all__ = ["read_run", "report", "write_report"]


def report(words: Sequence[str]) -> int:
    """Write `report.html` of a run again."""
    if words in (["--help"], ["-h"]):
        print("usage: bayessim report RUN\n\nWrites report.html again from what lies in the run folder RUN.")
        return 0
    if len(words) != 1 or words[0].startswith("-"):
        raise UsageError("usage: bayessim report RUN")
    try:
        print(write_report(RunFolder.open(Path(words[0]))))
    except ValueError as error:
        raise UsageError(str(error)) from error
    return 0


def read_run(folder: RunFolder) -> OnlineRun:
    """What a run folder says, as the report wants it; raises `ValueError` where a file is damaged."""
    read = read_draws(folder.path / "posterior.nc")
    return OnlineRun(
        settings=folder.read_config(),
        facts=folder.read_run(),
        lines=folder.read_metrics(len(read.draws)),
        draws=read.draws,
        names=read.names,
        units=read.units,
        low=read.low,
        high=read.high,
        truths=read.truths,
    )


def write_report(folder: RunFolder) -> Path:
    """Write `report.html` into a run folder and return its path."""
    path = folder.path / "report.html"
    write_text(path, render(read_run(folder)))
    return path
