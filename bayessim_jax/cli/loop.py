"""The loop over rounds as the command runs it: a compiled round, then everything on disk, then the next."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

import jax

if TYPE_CHECKING:
    from collections.abc import Callable

    from bayessim_jax.cli.interruption import Interruption
    from bayessim_jax.cli.progress import Reporter
    from bayessim_jax.recordings.journal import Journal

__all__ = ["run_rounds"]


def run_rounds(
    advance: Callable[[Any], tuple[Any, Any]],
    state: Any,
    journal: Journal,
    done: int,
    rounds: int,
    reporter: Reporter,
    interruption: Interruption,
) -> int:
    """Do the rounds after `done` until there are `rounds` of them or an interruption is noted; the number done.

    `advance(state)` is one round of all seeds: the next state, and the Info with a leading axis over the seeds.
    """
    for index in range(done + 1, rounds + 1):
        if interruption.code is not None:
            return index - 1
        started = time.perf_counter()
        state, infos = jax.block_until_ready(advance(state))
        seconds = time.perf_counter() - started
        reporter.round(index, journal.write(index, infos, state, seconds), time.perf_counter() - started)
    return rounds
