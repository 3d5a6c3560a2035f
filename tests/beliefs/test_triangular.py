"""Small triangular systems, and that large batches of small systems come to an end."""

import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np

from bayessim_jax.beliefs.triangular import invert, solve_lower

MANY_AT_ONCE = """
import bayessim_jax, jax, jax.numpy as jnp

@jax.jit
def solve(a, b):
    solved = [jax.scipy.linalg.solve_triangular(a + k, b, lower=True) for k in range(8)]
    return sum((x**2).sum() for x in solved)

a = jnp.tril(jax.random.normal(jax.random.key(0), (20000, 2, 2))) + 3 * jnp.eye(2)
for _ in range(20):
    solve(a, jnp.ones((20000, 2, 3))).block_until_ready()
"""


def test_forward_substitution_solves_triangular_systems():
    rng = np.random.default_rng(0)
    lower = np.tril(rng.normal(size=(7, 4, 4))) + 3 * np.eye(4)
    for shape in ((4,), (4, 3)):
        b = rng.normal(size=(7, *shape))
        found = jax.vmap(solve_lower)(jnp.asarray(lower), jnp.asarray(b))
        np.testing.assert_allclose(jnp.einsum("nij,nj...->ni...", lower, found), b, atol=1e-5)
    np.testing.assert_allclose(invert(jnp.asarray(lower[0])) @ lower[0], np.eye(4), atol=1e-5)


def test_batches_of_small_systems_do_not_wait_for_each_other_for_ever():
    subprocess.run([sys.executable, "-c", MANY_AT_ONCE], check=True, timeout=300)
