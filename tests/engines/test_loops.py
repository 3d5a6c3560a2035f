"""Loops that are compiled whole (`XLA_FLAGS`): with anything in them they give what their steps give one by one."""

import os

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import bayessim_jax  # noqa: F401


def called_back(x):
    return jax.pure_callback(lambda y: 0.5 * np.asarray(y), jax.ShapeDtypeStruct(x.shape, x.dtype), x)


STEPS = {
    "arithmetic": lambda x: jnp.sin(x) + 0.1,
    "product": lambda x: jnp.tanh(x @ x),
    "linear system": lambda x: jnp.linalg.solve(x @ x.T + 16 * jnp.eye(16), x),
    "order": lambda x: jnp.sort(x, 0)[::-1],
    "transform": lambda x: jnp.fft.ifft(jnp.fft.fft(x)).real * 0.9,
    "random numbers": lambda x: x + jax.random.normal(jax.random.key(0), x.shape),
    "callback": called_back,
    "loop": lambda x: jax.lax.while_loop(lambda y: y.sum() > 1.0, lambda y: 0.5 * y, x),
    "branch": lambda x: jax.lax.cond(x.sum() > 0.0, lambda y: 0.5 * y, lambda y: y, x),
    "convolution": lambda x: jax.lax.conv(x[None, None], jnp.full((1, 1, 3, 3), 0.1), (1, 1), "SAME")[0, 0],
}


@pytest.mark.parametrize("step", STEPS.values(), ids=STEPS)
def test_a_loop_gives_what_its_steps_give(step):
    x = jnp.linspace(0.1, 1.0, 256).reshape(16, 16)
    looped = jax.jit(lambda x: jax.lax.scan(lambda y, _: (step(y), None), x, length=3)[0])(x)
    once = jax.jit(step)
    np.testing.assert_allclose(looped, once(once(once(x))), rtol=1e-4, atol=1e-5)


def test_a_loop_of_less_than_8_mb_is_one_piece_of_code():
    assert "xla_cpu_small_while_loop_byte_threshold" in os.environ["XLA_FLAGS"]
    x = jnp.ones(4096)
    text = jax.jit(lambda x: jax.lax.scan(lambda y, _: (jnp.sin(y), None), x, length=9)[0]).lower(x).compile().as_text()
    assert "xla_cpu_small_call" in text
