"""Contact-free models of hinges and slides, their equations written out while tracing."""

from __future__ import annotations

from bayessim_jax.engines.tree.engine import TreeEngine as TreeEngine
from bayessim_jax.engines.tree.engine import TreeState as TreeState
from bayessim_jax.engines.tree.support import find_refusals as find_refusals

__all__ = ["TreeEngine", "TreeState", "find_refusals"]
