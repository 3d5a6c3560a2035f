"""Commands ask for their own level of optimization: in quick tests they take that of the others."""

import pytest

from bayessim_jax import online


@pytest.fixture(autouse=True, scope="package")
def compile_quickly(request):
    """Where `XLA_FLAGS` ask for quick compilation, too (`tests/conftest.py`)."""
    with pytest.MonkeyPatch.context() as patch:
        if request.config.option.markexpr == "not slow":
            patch.setattr(online, "COMPILER_OPTIONS", {})
        yield
