"""Compiled code is kept between runs of the tests: most of their time is compilation."""

import os
from pathlib import Path

import jax
import pytest

jax.config.update(
    "jax_compilation_cache_dir",
    os.environ.get("BAYESSIM_TEST_CACHE", str(Path(__file__).parent.parent / ".bayessim_cache")),
)
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)


@pytest.fixture(autouse=True)
def forget_programs_of_slow_tests(request):
    """Slow tests compile hundreds of programs, and a process can hold only so many."""
    yield
    if request.node.get_closest_marker("slow"):
        jax.clear_caches()
