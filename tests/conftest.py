"""Compiled code is kept between runs of the tests: most of their time is compilation."""

import os
from pathlib import Path

import jax
import pytest

jax.config.update(
    "jax_compilation_cache_dir",
    os.environ.get("BAYESSIM_TEST_CACHE", str(Path(__file__).parent.parent / ".bayessim_cache")),
)
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)

QUICKLY_COMPILED = "--xla_backend_optimization_level=0 --xla_cpu_use_fusion_emitters=false"
"""Flags of XLA with which a program compiles several times faster and runs slower."""

MOST_MAPS = 30_000
"""Of the 65,530 that a process may have by default; every compiled program takes some."""


def pytest_configure(config):
    """Quick tests run a program once or twice: what they cost is its compilation, here and in processes they start."""
    if config.option.markexpr == "not slow":
        os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {QUICKLY_COMPILED}".strip()


@pytest.fixture(autouse=True)
def forget_programs(request):
    """A process can hold only so many compiled programs, and slow tests compile hundreds."""
    yield
    if request.node.get_closest_marker("slow") or _maps() > MOST_MAPS:
        jax.clear_caches()


def _maps() -> int:
    """Maps of memory of this process; 0 where the system does not tell."""
    try:
        with Path("/proc/self/maps").open("rb") as file:
            return sum(1 for _ in file)
    except OSError:
        return 0
