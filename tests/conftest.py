"""Compiled code is kept between runs of the tests: most of their time is compilation."""

import os
from pathlib import Path

import jax
import pytest

from benchmarks.compilation import make_room

jax.config.update(
    "jax_compilation_cache_dir",
    os.environ.get("BAYESSIM_TEST_CACHE", str(Path(__file__).parent.parent / ".bayessim_cache")),
)
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)

QUICKLY_COMPILED = "--xla_backend_optimization_level=0 --xla_cpu_use_fusion_emitters=false"
"""Flags of XLA with which a program compiles several times faster and runs slower."""


def pytest_configure(config):
    """Quick tests run a program once or twice: what they cost is its compilation, here and in processes they start.

    The loop's own level of optimization gives way to that of the flags.
    """
    if config.option.markexpr == "not slow":
        os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {QUICKLY_COMPILED}".strip()
        from bayessim_jax import online

        online.COMPILER_OPTIONS = {}


def pytest_collection_modifyitems(items):
    """Whole runs take longest and go first, so that no worker is left alone with them."""
    here = Path(__file__).parent
    items.sort(key=lambda item: item.path.parent != here)


@pytest.fixture(autouse=True)
def forget_programs(request):
    """A process can hold only so many compiled programs, and slow tests compile hundreds."""
    yield
    if request.node.get_closest_marker("slow"):
        jax.clear_caches()
    else:
        make_room()
