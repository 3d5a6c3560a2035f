"""Gaussian mass in a box, against SciPy's integrator."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import multivariate_normal, norm

from bayessim_jax.beliefs import box_probability
from bayessim_jax.beliefs.box_probability import lattice

probability = jax.jit(box_probability, static_argnames="points")
total_and_grads = jax.jit(
    jax.value_and_grad(lambda m, s: box_probability(m, s, jnp.zeros(2), jnp.ones(2)).sum(), (0, 1))
)


def gaussians(seed, count, d, spread=0.4):
    rng = np.random.default_rng(seed)
    means = rng.uniform(-0.3, 1.3, (count, d))
    trils = np.tril(rng.normal(0, 0.5, (count, d, d)), -1) + np.einsum(
        "ki,ij->kij", rng.uniform(0.3, 1.5, (count, d)), np.eye(d)
    )
    return means.astype(np.float32), (spread * trils).astype(np.float32)


@pytest.mark.parametrize(("d", "tolerance"), [(1, 1e-5), (2, 1e-3), (4, 1e-2)])
def test_agrees_with_scipy(d, tolerance):
    means, trils = gaussians(d, 6, d)
    low, high = np.zeros(d, np.float32), np.linspace(0.6, 1.0, d, dtype=np.float32)
    for mean, tril, log_p in zip(means, trils, probability(means, trils, low, high), strict=True):
        law = multivariate_normal(
            mean, tril.astype(float) @ tril.T.astype(float), maxpts=2_000_000, abseps=1e-7, releps=1e-6, seed=0
        )
        exact = law.cdf(high, lower_limit=low)
        assert abs(np.exp(log_p) / exact - 1) < tolerance


def test_independent_axes_multiply():
    mean, scale = np.array([0.2, -0.5, 2.0], np.float32), np.array([0.3, 0.4, 0.5], np.float32)
    got = probability(mean[None], np.diag(scale)[None], np.zeros(3, np.float32), np.ones(3, np.float32))[0]
    exact = np.log(norm.cdf((1 - mean) / scale) - norm.cdf(-mean / scale)).sum()
    np.testing.assert_allclose(got, exact, rtol=1e-5)


def test_more_points_come_closer():
    means, trils = gaussians(7, 6, 4)
    low, high = np.zeros(4, np.float32), np.ones(4, np.float32)
    fine = probability(means, trils, low, high, points=8192)
    error = [np.abs(probability(means, trils, low, high, points=n) - fine).max() for n in (16, 256)]
    assert error[1] < error[0] / 4


@pytest.mark.parametrize("distance", [1e1, 1e3, 1e5])
def test_finite_with_finite_derivatives_however_far_the_box(distance):
    tril = jnp.array([[[1.0, 0.0], [0.9, 0.2]]])
    value, grads = total_and_grads(jnp.full((1, 2), distance), tril)
    assert np.isfinite(value) and value < -0.4 * distance**2 / 2
    assert all(jnp.isfinite(g).all() for g in grads)


def test_derivative_agrees_with_differences():
    means, trils = gaussians(3, 1, 2)
    loss = lambda m: total_and_grads(m, trils)[0]  # noqa: E731
    step = 2e-2
    moved = [loss(means + s * step * np.eye(2, dtype=np.float32)[i]) for i in range(2) for s in (1, -1)]
    expected = [(moved[0] - moved[1]) / (2 * step), (moved[2] - moved[3]) / (2 * step)]
    np.testing.assert_allclose(total_and_grads(means, trils)[1][0][0], expected, rtol=5e-3, atol=2e-3)


def test_lattice_fills_the_open_cube_evenly():
    points = np.asarray(lattice(512, 5))
    assert points.shape == (512, 5) and points.min() > 0 and points.max() < 1
    np.testing.assert_allclose(points.mean(0), 0.5, atol=5e-3)
    np.testing.assert_allclose((points**2).mean(0), 1 / 3, atol=5e-3)
