"""What the README shows works as it stands there."""

import re
from pathlib import Path

import jax.numpy as jnp
import pytest

README = Path(__file__).parent.parent / "README.md"


@pytest.mark.slow
def test_the_example_of_a_user_s_own_system_finds_its_parameters():
    (code,) = re.findall(r"```python\n(.*?)```", README.read_text(encoding="utf-8"), re.DOTALL)
    assert len(code.splitlines()) < 25
    names = {}
    exec(compile(code, "README.md", "exec"), names)
    belief = names["state"].belief
    sd = jnp.sqrt(jnp.diagonal(belief.covariance()))
    assert (jnp.abs(belief.mean() - jnp.array([1.2, 0.3])) < 4 * sd).all()
    assert (sd < 0.25 * belief.box.width).all()
