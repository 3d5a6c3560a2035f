"""Seconds to compile: a whole run of Online BayesSim in a fresh process, or whatever a piece of code compiles."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from benchmarks.timing import choose_clock, chosen_clock, now

__all__ = ["Compilation", "fresh_cache", "make_room", "measure_compilation", "watch_compilation"]

MOST_MAPS = 30_000
"""Maps of memory with which a process may go on; systems allow about 65,000."""
MOST_BYTES = 4e9


class Compilation:
    """When JAX was tracing, lowering, compiling, or loading what was compiled before."""

    def __init__(self) -> None:
        self.spans: list[tuple[float, float]] = []

    def listen(self, event: str, seconds: float, **_: str | int) -> None:
        """Note an event of `jax.monitoring`, which tells it when it is over."""
        if event.startswith("/jax/core/compile/"):
            end = time.perf_counter()
            self.spans.append((end - seconds, end))

    @property
    def seconds(self) -> float:
        """Length of the union of the spans: what is traced within what is traced counts once."""
        total, reached = 0.0, -float("inf")
        for begin, end in sorted(self.spans):
            total += max(end - max(begin, reached), 0.0)
            reached = max(reached, end)
        return total


@contextmanager
def watch_compilation() -> Iterator[Compilation]:
    """Collect what JAX compiles within."""
    import jax.monitoring

    watched = Compilation()
    jax.monitoring.register_event_duration_secs_listener(watched.listen)
    try:
        yield watched
    finally:
        jax.monitoring.unregister_event_duration_listener(watched.listen)


def make_room() -> None:
    """Forget compiled programs where a process cannot hold many more of them."""
    import jax

    here = Path("/proc/self")
    with contextlib.suppress(OSError):
        held = int((here / "statm").read_text(encoding="ascii").split()[1]) * os.sysconf("SC_PAGE_SIZE")
        if held > MOST_BYTES or (here / "maps").read_bytes().count(b"\n") > MOST_MAPS:
            jax.clear_caches()


@contextmanager
def fresh_cache() -> Iterator[None]:
    """Compile within against a persistent cache that is empty at first and gone afterwards."""
    import jax
    from jax.experimental.compilation_cache.compilation_cache import reset_cache

    names = ("jax_compilation_cache_dir", "jax_persistent_cache_min_compile_time_secs")
    before = {name: getattr(jax.config, name) for name in names}
    with tempfile.TemporaryDirectory() as folder:
        try:
            for name, value in zip(names, (folder, 0.0), strict=True):
                jax.config.update(name, value)
            reset_cache()
            yield
        finally:
            for name, value in before.items():
                jax.config.update(name, value)
            reset_cache()


def measure_compilation() -> tuple[float, float]:
    """Seconds from the call to the compiled program, tracing included: cold, and from the persistent cache."""
    with tempfile.TemporaryDirectory() as folder:
        environment = os.environ | {
            "JAX_COMPILATION_CACHE_DIR": folder,
            "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
            "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "-1",
        }
        command = [sys.executable, "-W", "ignore", "-m", "benchmarks.compilation", chosen_clock()]
        laps = [
            float(subprocess.run(command, env=environment, check=True, capture_output=True, text=True).stdout)
            for _ in range(2)
        ]
    return laps[0], laps[1]


def _compile_run() -> float:
    import jax

    from bayessim_jax import online
    from bayessim_jax.engines.simulated import SimulatedTarget
    from bayessim_jax.learning import default_learner
    from bayessim_jax.systems import Balance, CartPole

    system, task = CartPole.create(), Balance()
    setup = online.Setup.create(system, default_learner("cartpole", system, task), task)
    target = SimulatedTarget(system, task, jax.numpy.array([0.5, 0.3]))
    run = jax.jit(online.run, static_argnames="rounds", compiler_options=online.COMPILER_OPTIONS)
    start = now()
    run.lower(jax.random.key(0), setup, target, rounds=30).compile()
    return now() - start


if __name__ == "__main__":
    choose_clock(sys.argv[1])
    print(_compile_run())
