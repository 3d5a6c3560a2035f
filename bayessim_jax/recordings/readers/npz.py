"""NPZ: an array for each channel, all of one length; never unpickled."""

from __future__ import annotations

import zipfile
import zlib
from typing import TYPE_CHECKING

import numpy as np

from bayessim_jax.recordings.readers.table import Table, pick, reason
from bayessim_jax.recordings.wording import CaseError, quote

if TYPE_CHECKING:
    from collections.abc import Collection
    from pathlib import Path

__all__ = ["read"]


def read(path: Path, wanted: Collection[str] | None) -> Table:
    """Read an NPZ file as `numpy.savez` writes it; arrays of Python objects are refused."""
    columns = {}
    name = ""
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as file:
            if not isinstance(file, np.lib.npyio.NpzFile):
                raise CaseError(path.name, "is a single array, not an NPZ file", "write it with numpy.savez")
            names = tuple(file.files)
            for name in pick(path, names, wanted):
                columns[name] = _numbers(path, name, file[name])
    except (ValueError, EOFError, KeyError, zipfile.BadZipFile, zlib.error, NotImplementedError) as error:
        if isinstance(error, CaseError):
            raise
        if "allow_pickle" in str(error) or "pickle" in str(error):
            what = f"array {quote(name)} holds Python objects" if name else "is a pickle"
            raise CaseError(path.name, f"{what}, which are not read", "write plain arrays of numbers") from error
        raise CaseError(path.name, f"is damaged or not NPZ ({reason(error)})", "write it again") from error
    lengths = {name: len(column) for name, column in columns.items()}
    if len(set(lengths.values())) > 1:
        (a, n), (b, m) = min(lengths.items(), key=lambda x: x[1]), max(lengths.items(), key=lambda x: x[1])
        raise CaseError(path.name, f"{quote(a)} has {n} rows, {quote(b)} has {m}", "give all arrays one length")
    return Table(names, columns)


def _numbers(path: Path, name: str, array: np.ndarray) -> np.ndarray:
    if array.dtype.kind not in "fiub":
        raise CaseError(path.name, f"array {quote(name)} holds {array.dtype}, not numbers", "convert it")
    if array.ndim == 2 and array.shape[1] == 1:
        array = array[:, 0]
    if array.ndim != 1:
        shape = " x ".join(map(str, array.shape)) or "a single number"
        raise CaseError(path.name, f"array {quote(name)} is {shape}", "give each channel an array of one axis")
    return array.astype(float)
