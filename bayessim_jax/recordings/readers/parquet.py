"""Parquet: a column of numbers for each channel."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from bayessim_jax.recordings.readers.table import Table, pick, reason
from bayessim_jax.recordings.wording import CaseError, quote

if TYPE_CHECKING:
    from collections.abc import Collection
    from pathlib import Path

__all__ = ["read"]


def read(path: Path, wanted: Collection[str] | None) -> Table:
    """Read a Parquet file; empty cells are NaN."""
    import pyarrow as pa
    from pyarrow import parquet

    try:
        with parquet.ParquetFile(path) as file:
            schema = file.schema_arrow
            names = tuple(schema.names)
            chosen = pick(path, names, wanted)
            for name in chosen:
                kind = schema.field(name).type
                if not (pa.types.is_floating(kind) or pa.types.is_integer(kind) or pa.types.is_boolean(kind)):
                    raise CaseError(path.name, f"column {quote(name)} holds {kind}, not numbers", "convert it")
            parts: dict[str, list[np.ndarray]] = {name: [] for name in chosen}
            for batch in file.iter_batches(columns=chosen):
                for name, column in zip(batch.schema.names, batch.columns, strict=True):
                    parts[name].append(column.cast(pa.float64()).to_numpy(zero_copy_only=False))
    except CaseError:
        raise
    except (pa.ArrowException, ValueError) as error:
        raise CaseError(path.name, f"is damaged or not Parquet ({reason(error)})", "write it again") from error
    return Table(names, {name: np.concatenate(parts.pop(name) or [np.empty(0)]) for name in chosen})
