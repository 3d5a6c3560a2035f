"""Whether residuals are white."""

import jax
import numpy as np
import pytest

from bayessim_jax.diagnosis.whiteness import judge_misfit


def test_white_residuals_have_uniform_p_values():
    rng = np.random.default_rng(0)
    windows, rows = 8, 40
    slopes = np.stack([np.ones(rows), np.linspace(-1, 1, rows)])[None].repeat(windows, 0)
    measured = np.ones((windows, rows, 1), bool)
    p_values = []
    for trial in range(40):
        noise = 0.3 * rng.standard_normal((windows, rows))
        q, _ = np.linalg.qr(slopes[0].T)
        noise = noise - noise @ q @ q.T
        found = judge_misfit(jax.random.key(trial), noise[..., None], jax.numpy.asarray(slopes), measured)
        p_values.append(found.p_value)
    assert 0.3 < np.mean(p_values) < 0.7
    assert np.mean(np.array(p_values) < 0.05) < 0.15
    wave = 0.2 * np.sin(np.linspace(0, 6, rows))
    smooth = judge_misfit(jax.random.key(0), (noise + wave)[..., None], jax.numpy.asarray(slopes), measured)
    assert smooth.p_value < 0.01
    assert smooth.noise[0] == pytest.approx(0.3, rel=0.15)


def test_residuals_of_a_constant_size_are_no_noise():
    """A base that is tilted, or a sensor that is off: nothing moves slowly, and all of it lies beside."""
    rng, (windows, rows) = np.random.default_rng(1), (6, 50)
    slopes = jax.numpy.asarray(np.linspace(-1, 1, rows)[None, None].repeat(windows, 0))
    measured = np.ones((windows, rows, 1), bool)
    noise = 0.1 * rng.standard_normal((windows, rows, 1))
    p_values = [judge_misfit(jax.random.key(0), noise + off, slopes, measured).p_value for off in (0.0, 0.1)]
    assert p_values[0] > 0.05 > 0.01 > p_values[1]
