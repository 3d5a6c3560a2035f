"""The persistent compilation cache: switched on by the command, never by the library."""

from __future__ import annotations

import os
from pathlib import Path

import jax

from bayessim_jax.programs import keep_traces_in

__all__ = ["use_compilation_cache"]


def use_compilation_cache() -> Path | None:
    """Keep compiled programs in `JAX_COMPILATION_CACHE_DIR`, by default in the user's cache folder.

    Nothing is kept, and `None` returned, where that folder cannot be made.
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
    keep_traces_in(folder / "traced")
    return folder
