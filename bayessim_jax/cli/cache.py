"""The persistent compilation cache: switched on by the command, never by the library."""

from __future__ import annotations

import os
import time
import warnings
import zlib
from pathlib import Path

import jax
import zstandard

from bayessim_jax.programs import keep_traces_in

__all__ = ["use_compilation_cache"]


def use_compilation_cache() -> Path | None:
    """Keep compiled programs in `JAX_COMPILATION_CACHE_DIR`, by default in the user's cache folder.

    Nothing is kept, and `None` returned, where that folder cannot be made. JAX does not write in one step: what a
    killed process left half-written is removed, since JAX would neither read nor replace it; what another process is
    writing is compiled here too, and no word is said of it.
    """
    given = os.environ.get("JAX_COMPILATION_CACHE_DIR")
    home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    folder = Path(given) if given else Path(home) / "bayessim" / "jax"
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return None
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", 0)
    warnings.filterwarnings("ignore", "Error reading persistent compilation cache entry", UserWarning)
    _remove_broken(folder)
    keep_traces_in(folder / "traced")
    return folder


def _remove_broken(folder: Path) -> None:
    """Remove entries that do not unpack; those that were there at the last look are not looked at again."""
    looked, now = folder / ".looked", time.time()
    try:
        before = looked.stat().st_mtime if looked.exists() else 0.0
        for entry in folder.glob("*-cache"):
            if entry.stat().st_mtime >= before - 1.0 and not _is_whole(entry.read_bytes()):
                entry.unlink()
        looked.touch()
        os.utime(looked, (now, now))
    except OSError:
        return  # a folder to read only, or another process that tidies up


def _is_whole(entry: bytes) -> bool:
    """Whether what JAX has packed, by zstandard or zlib, unpacks."""
    try:
        if entry.startswith(zstandard.FRAME_HEADER):
            zstandard.ZstdDecompressor().decompress(entry)
        else:
            zlib.decompress(entry)
    except (zstandard.ZstdError, zlib.error):
        return False
    return True
