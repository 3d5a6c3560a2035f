"""`read_table`: named columns of numbers, whatever the format."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING

import numpy as np

from bayessim_jax.recordings.wording import CaseError, quote

if TYPE_CHECKING:
    from collections.abc import Callable, Collection
    from pathlib import Path

__all__ = ["SUFFIXES", "Table", "read_table"]

SUFFIXES = {".csv": "csv", ".parquet": "parquet", ".npz": "npz", ".mcap": "mcap"}


@dataclass(frozen=True)
class Table:
    """The columns that were asked for, as float64 with NaN where a cell is empty, and the names of all there are."""

    names: tuple[str, ...]
    columns: dict[str, np.ndarray]
    asynchronous: bool = False
    """Columns were recorded at times of their own and merged: what is NaN was not due at that time."""


def read_table(path: Path, wanted: Collection[str] | None = None) -> Table:
    """Read a CSV, Parquet, NPZ or MCAP file; only the columns in `wanted` (all by default) become arrays.

    Raises `CaseError` with one line that names the file, the row where there is one, and the remedy.
    """
    kind = SUFFIXES.get(path.suffix.lower())
    if kind is None:
        raise CaseError(path.name, f"unknown format {quote(path.suffix)}", f"use {', '.join(SUFFIXES)}")
    read: Callable[[Path, Collection[str] | None], Table] = import_module(f"{__package__}.{kind}").read
    try:
        if not path.stat().st_size:
            raise CaseError(path.name, "the file is empty", "record it again or remove it")
        return read(path, wanted)
    except OSError as error:
        raise CaseError(path.name, f"cannot be read ({reason(error)})", "restore it or remove it") from error
    except ImportError as error:
        raise CaseError(path.name, f"reading it needs {error.name}", "install it with pip") from error


def reason(error: Exception) -> str:
    """The first line of a library's message, as it may be shown."""
    said = getattr(error, "strerror", None) or str(error) or type(error).__name__
    return quote(" ".join(str(said).split("\n")[0].split())[:200])[1:-1]


def pick(path: Path, names: tuple[str, ...], wanted: Collection[str] | None) -> list[str]:
    """Which columns to read; raises `CaseError` where a name occurs twice."""
    twice = next((name for i, name in enumerate(names) if name in names[:i]), None)
    if twice is not None:
        raise CaseError(path.name, f"column {quote(twice)} occurs twice", "rename or remove one")
    return [name for name in names if wanted is None or name in wanted]
