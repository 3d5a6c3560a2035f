"""CSV: a header of channel names, then a row of numbers for each time; read in blocks, so that memory stays small."""

from __future__ import annotations

import csv
import re
from typing import TYPE_CHECKING

import numpy as np

from bayessim_jax.recordings.readers.table import Table, pick, reason
from bayessim_jax.recordings.wording import CaseError, quote

if TYPE_CHECKING:
    from collections.abc import Collection
    from pathlib import Path

__all__ = ["read"]

HEADER = 1 << 20
BLOCK = 1 << 24


def read(path: Path, wanted: Collection[str] | None) -> Table:
    """Read a CSV file in UTF-8; empty cells are NaN."""
    import pyarrow as pa
    from pyarrow import csv as reader

    names = _header(path)
    chosen = pick(path, names, wanted)
    parts: dict[str, list[np.ndarray]] = {name: [] for name in chosen}
    if not chosen:
        return Table(names, {})
    try:
        blocks = reader.open_csv(
            path,
            reader.ReadOptions(column_names=list(names), skip_rows=1, block_size=BLOCK, use_threads=False),
            convert_options=reader.ConvertOptions(
                include_columns=chosen, column_types=dict.fromkeys(chosen, pa.float64())
            ),
        )
        for block in blocks:
            for name, column in zip(chosen, block.columns, strict=True):
                parts[name].append(column.to_numpy(zero_copy_only=False))
    except pa.ArrowInvalid as error:
        raise _invalid(path, names, str(error)) from error
    return Table(names, {name: np.concatenate(parts.pop(name) or [np.empty(0)]) for name in chosen})


def _header(path: Path) -> tuple[str, ...]:
    with path.open("rb") as stream:
        start = stream.read(HEADER)
    if b"\0" in start:
        raise CaseError(path.name, "is not UTF-8 text", "save it as CSV in UTF-8")
    line = start.removeprefix(b"\xef\xbb\xbf").split(b"\n", 1)[0]
    try:
        text = line.decode("utf-8").strip("\r")
    except UnicodeDecodeError as error:
        raise CaseError(path.name, "the header is not UTF-8 text", "save the file in UTF-8") from error
    for mark, name in ((";", "semicolons"), ("\t", "tabs")):
        if mark in text and "," not in text:
            raise CaseError(path.name, f"columns are separated by {name}", "save the file with commas")
    names = tuple(name.strip() for name in next(csv.reader([text]), []))
    if not names or all(_is_number(name) for name in names):
        raise CaseError(path.name, "has no header", "add a first line with the channels' names")
    return names


def _is_number(text: str) -> bool:
    try:
        float(text or "0")
    except ValueError:
        return False
    return True


def _invalid(path: Path, names: tuple[str, ...], message: str) -> CaseError:
    at = re.search(r"Row #(\d+)", message)
    row = int(at[1]) - 1 if at else None
    if count := re.search(r"Expected (\d+) columns, got (\d+)", message):
        what = f"has {count[2]} of {count[1]} columns, as if it were cut off"
        return CaseError(path.name, what, "remove the row or copy the file again", row)
    column = re.search(r"In CSV column #(\d+)", message)
    if value := re.search(r"invalid value '(.*)'", message, re.DOTALL):
        name = f"column {quote(names[int(column[1])])}" if column else "a column"
        what = f"{name} holds {quote(value[1])}, which is no number"
        return CaseError(path.name, what, "correct it or leave it empty", row)
    return CaseError(path.name, f"cannot be read as CSV ({reason(ValueError(message))})", "correct it", row)
