"""Weighted particles: moments, effective number, systematic resampling."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import gaussian_kde

from bayessim_jax.beliefs import Particles


@pytest.fixture
def particles():
    rng = np.random.default_rng(0)
    positions = rng.normal(size=(200, 2)) @ np.array([[1.0, 0.8], [0.0, 0.5]])
    return Particles(jnp.asarray(positions, jnp.float32), jnp.asarray(rng.normal(size=200), jnp.float32))


def test_moments_are_weighted(particles):
    np.testing.assert_allclose(
        particles.mean(), np.average(particles.positions, axis=0, weights=particles.weights), rtol=1e-4, atol=1e-6
    )
    expected = np.cov(particles.positions.T, aweights=particles.weights, ddof=0)
    np.testing.assert_allclose(particles.covariance(), expected, rtol=1e-3)


def test_density_agrees_with_scipys_silverman_kernels(particles):
    level = particles.replace(log_weights=jnp.zeros(200))
    kernels = gaussian_kde(np.asarray(level.positions, float).T, "silverman")
    kernels.set_bandwidth(kernels.factor * np.sqrt(199 / 200))  # SciPy divides by n − 1
    theta = np.random.default_rng(1).normal(size=(20, 2)).astype(np.float32)
    got = jax.jit(jax.vmap(level.log_prob))(theta)
    np.testing.assert_allclose(got, kernels.logpdf(theta.T), rtol=1e-3, atol=1e-3)


def test_effective_sample_size_counts():
    log_weights = jnp.where(jnp.arange(10) < 4, 0.0, -jnp.inf)
    positions = jnp.arange(10.0)[:, None]
    np.testing.assert_allclose(Particles(positions, log_weights).effective_sample_size(), 4.0, rtol=1e-5)
    np.testing.assert_allclose(Particles(positions, jnp.zeros(10)).effective_sample_size(), 10.0, rtol=1e-5)


def test_systematic_resampling_keeps_each_as_often_as_it_weighs(particles):
    indexed = particles.replace(positions=jnp.arange(200.0)[:, None])
    resampled = jax.jit(lambda p, k: p.resample(k))(indexed, jax.random.key(0))
    counts = np.bincount(np.asarray(resampled.positions[:, 0], int), minlength=200)
    assert counts.sum() == 200
    expected = 200 * np.asarray(particles.weights)
    assert (counts >= np.floor(expected - 1e-3)).all() and (counts <= np.ceil(expected + 1e-3)).all()
    np.testing.assert_array_equal(resampled.log_weights, 0.0)


def test_resampling_keeps_the_mean_on_average(particles):
    keys = jax.random.split(jax.random.key(1), 500)
    means = jax.jit(jax.vmap(lambda k: particles.resample(k).mean()))(keys)
    np.testing.assert_allclose(means.mean(0), particles.mean(), atol=0.01)
