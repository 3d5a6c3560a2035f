"""The compilation cache of the command heals what a killed process left."""

import warnings

import jax
import jax.numpy as jnp
import pytest
from jax.experimental.compilation_cache import compilation_cache

from bayessim_jax.cli.cache import use_compilation_cache
from tests.cli.test_online_command import own_settings as own_settings


@pytest.fixture
def folder(own_settings, tmp_path, monkeypatch):
    """A cache of one's own, and JAX's settings put back after it."""
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", str(tmp_path))
    compilation_cache.reset_cache()
    yield tmp_path
    compilation_cache.reset_cache()


def compiled_by(folder, power):
    """The cache entry of a program that no other test compiles."""
    use_compilation_cache()
    before = set(folder.glob("*-cache"))
    jax.jit(lambda x: x**power + 0.123456)(jnp.arange(3.0)).block_until_ready()
    (entry,) = (e for e in set(folder.glob("*-cache")) - before if "lambda" in e.name)
    return entry


@pytest.mark.parametrize("share", [0.0, 0.5, 0.99])
def test_what_a_killed_process_left_half_written_is_written_again(folder, share):
    entry = compiled_by(folder, power=7)
    whole = entry.read_bytes()
    entry.write_bytes(whole[: int(share * len(whole))])
    jax.clear_caches()
    compilation_cache.reset_cache()
    use_compilation_cache()
    assert not entry.exists()
    assert compiled_by(folder, power=7) == entry
    use_compilation_cache()
    assert entry.exists(), "a whole entry stays"


def test_a_program_that_another_process_is_writing_is_compiled_without_a_word(folder):
    entry = compiled_by(folder, power=9)
    jax.clear_caches()
    compilation_cache.reset_cache()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        use_compilation_cache()
        entry.write_bytes(b"")  # after the look at the start
        made = jax.jit(lambda x: x**9 + 0.123456)(jnp.arange(3.0))
    assert not caught
    assert made[1] == pytest.approx(1.123456)
