"""Commands from before a simulation begins, which actuators with a memory have not forgotten."""

from __future__ import annotations

import math

from jaxtyping import Array, Float

__all__ = ["RECENT", "split_history"]

RECENT = 0.1
"""s; effects that are `brief` remember no more."""
NEAR, FEW, MOST = 0.2, 64, 128
"""s and periods, at most, that are gone through time step by time step, and steps for what lies further back."""


def split_history(
    past: Float[Array, "*batch periods act"], period: float
) -> tuple[Float[Array, "*batch steps act"], float, Float[Array, "*batch recent act"]]:
    """Commands of long ago as means over steps of some length, that length in s, and the recent ones."""
    recent = past.shape[-2] if past.shape[-2] <= FEW else min(math.ceil(NEAR / period - 1e-9), past.shape[-2])
    older, past = past[..., : past.shape[-2] - recent, :], past[..., past.shape[-2] - recent :, :]
    together = max(math.ceil(older.shape[-2] / MOST), 1)
    older = older[..., older.shape[-2] % together :, :]
    steps = older.shape[-2] // together
    groups = older.reshape(*older.shape[:-2], steps, together, older.shape[-1])
    return groups.mean(-2), together * period, past
