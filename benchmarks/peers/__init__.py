"""The same work put together from other projects' parts; they live in the optional extra `peers`."""

from __future__ import annotations

import importlib.util
import os
import time

__all__ = ["CORES", "choose_threads", "require_peers"]

CORES = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
"""Cores this process may use."""


def require_peers(*names: str) -> None:
    """Exit with one line where the modules named, or those of most benchmarks, are not installed."""
    wanted = names or ("torch", "stable_baselines3", "sbi")
    missing = [name for name in wanted if importlib.util.find_spec(name) is None]
    if missing:
        raise SystemExit(
            f"benchmarks: {', '.join(missing)} not found; pip install 'bayessim-jax[peers]' and try again."
        )


def choose_threads(wish: int = 0) -> int:
    """Give PyTorch `wish` threads; for 0 the faster of one and one for each core, on steps of a small LSTM.

    More threads than idle cores make PyTorch's small recurrent networks up to ten times slower, and a comparison on a
    busy machine should not count that against them.
    """
    import torch

    network, rows = torch.nn.LSTM(9, 64, batch_first=True), torch.randn(50, 50, 9)

    def seconds(threads: int) -> float:
        torch.set_num_threads(threads)
        start = time.perf_counter()
        for _ in range(30):
            network(rows)[1][0].sum().backward()
        return time.perf_counter() - start

    threads = wish or min(sorted({1, CORES}), key=seconds)
    torch.set_num_threads(threads)
    return threads
