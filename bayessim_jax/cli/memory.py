"""How the command has its memory given back: switched on by the command, never by the library."""

from __future__ import annotations

import ctypes

__all__ = ["return_large_blocks"]

M_MMAP_THRESHOLD = -3
"""The number of this parameter in the C library's `malloc.h`."""
LARGE = 2**20


def return_large_blocks() -> bool:
    """Have freed blocks of 1 MiB or more go back to the system at once; whether the C library can be told.

    The GNU C library raises that limit to the size of what was freed, up to 32 MiB, and what is smaller then stays in
    pieces of the heap: over tens of rounds, each of which makes a new state, these came to gigabytes.
    """
    try:
        return bool(ctypes.CDLL(None).mallopt(M_MMAP_THRESHOLD, LARGE))
    except (AttributeError, OSError, TypeError):
        return False
