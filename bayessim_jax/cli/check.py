"""`bayessim check CASE`: what a case holds and what is wrong with it, before anything is computed."""

from __future__ import annotations

import io
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from bayessim_jax.cli.parsing import UsageError, parse

if TYPE_CHECKING:
    from collections.abc import Sequence

__all__ = ["Check", "check"]


@dataclass(frozen=True)
class Check:
    """Read a case, print what was found in it, and one line for everything that is wrong, doubtful or not used.

    Exit status 0 where the case can be used, 2 where it cannot.
    """

    case: tyro.conf.Positional[Annotated[Path, tyro.conf.arg(metavar="CASE")]]
    """The case: a folder with a case.toml."""
    mask: bool = False
    """Use recordings in which numbers are missing or gaps are longer than a window: nothing is compared there."""


def check(words: Sequence[str]) -> int:
    """Check a case; returns the exit code."""
    command = parse(Check, words, "bayessim check")
    from bayessim_jax.recordings.loading import load_case
    from bayessim_jax.recordings.overview import describe

    if isinstance(sys.stdout, io.TextIOWrapper):  # names and units as they are, wherever they can be shown
        sys.stdout.reconfigure(errors="backslashreplace")
    try:
        loaded = load_case(command.case, mask=command.mask)
    except ValueError as error:
        raise UsageError(str(error)) from error
    for line in describe(loaded):
        print(line)
    doubts = [finding for finding in loaded.findings if finding.severity != "error"]
    for finding in doubts:
        print(f"{finding.severity:<12}{finding}")
    for finding in loaded.errors:
        print(f"bayessim: {finding}", file=sys.stderr)
    if loaded.errors:
        return 2
    print("ok          the case can be used" + (", as the lines above say" if doubts else ""))
    return 0
