"""What importing the package sets."""

import os
import subprocess
import sys

FACTORIZE = """
import jax, jax.numpy as jnp, bayessim_jax
x = jax.random.normal(jax.random.key(0), (4096, 8, 8))
def f(a):
    shifted = [a + (1.0 + i) * jnp.eye(8) for i in range(8)]
    return sum(jnp.linalg.cholesky(b).sum() + jnp.linalg.inv(b).sum() for b in shifted)
print(jnp.isfinite(jax.jit(f)(x @ x.mT)))
"""


def test_batched_factorizations_beside_each_other_come_to_an_end():
    # in a pool of two threads they hold both, and wait in it for each other
    env = {name: value for name, value in os.environ.items() if name != "NPROC"}
    command = [sys.executable, "-c", FACTORIZE]
    done = subprocess.run(command, env=env, capture_output=True, text=True, timeout=120, check=True)
    assert done.stdout.strip() == "True"
