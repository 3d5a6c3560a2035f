"""The Gaussian mixture: density, moments, marginals, changes of unit."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import multivariate_normal

from bayessim_jax.beliefs import GaussianMixture, moment_match


def random_mixture(seed, components=4, d=3, scale=1.0):
    rng = np.random.default_rng(seed)
    trils = np.tril(rng.normal(0, 0.5, (components, d, d)), -1)
    trils += np.einsum("ki,ij->kij", rng.uniform(0.3, 1.0, (components, d)), np.eye(d))
    leaves = (rng.normal(size=components), rng.normal(size=(components, d)), scale * trils)
    return GaussianMixture(*(jnp.asarray(x, jnp.float32) for x in leaves))


def exact_log_prob(mixture, theta):
    weights = np.exp(np.asarray(mixture.log_weights, float))
    parts = [
        w * multivariate_normal(m, s @ s.T).pdf(theta)
        for w, m, s in zip(
            weights / weights.sum(),
            np.asarray(mixture.means, float),
            np.asarray(mixture.scale_trils, float),
            strict=True,
        )
    ]
    return np.log(np.sum(parts, 0))


def test_log_prob_agrees_with_scipy():
    mixture, theta = random_mixture(0), np.random.default_rng(1).normal(size=(50, 3)).astype(np.float32)
    got = jax.jit(jax.vmap(mixture.log_prob))(theta)
    np.testing.assert_allclose(got, exact_log_prob(mixture, theta), rtol=1e-4, atol=1e-4)


def test_weights_need_not_be_normalized():
    mixture = random_mixture(0)
    shifted = mixture.replace(log_weights=mixture.log_weights + 7)
    theta = jnp.ones(3)
    np.testing.assert_allclose(mixture.log_prob(theta), shifted.log_prob(theta), rtol=1e-5)
    np.testing.assert_allclose(shifted.weights.sum(), 1.0, rtol=1e-6)


def test_sample_moments_agree_with_mean_and_covariance():
    mixture = random_mixture(2)
    draws = jax.jit(jax.vmap(mixture.sample))(jax.random.split(jax.random.key(0), 100_000))
    deviation = np.sqrt(np.diag(mixture.covariance()))
    np.testing.assert_allclose(draws.mean(0), mixture.mean(), atol=0.02 * deviation.max())
    np.testing.assert_allclose(np.cov(draws.T), mixture.covariance(), atol=0.03 * deviation.max() ** 2)


def test_marginal_integrates_the_other_axes_out():
    mixture = random_mixture(3, d=2)
    grid = jnp.linspace(-8, 8, 2001)
    joint = jax.jit(jax.vmap(lambda x: jnp.exp(mixture.log_prob(jnp.array([x, 0.3])))))(grid)
    np.testing.assert_allclose(
        mixture.marginal((1,)).log_prob(jnp.array([0.3])), jnp.log(joint.sum() * (grid[1] - grid[0])), rtol=1e-4
    )


def test_marginal_takes_axes_in_the_order_given():
    mixture = random_mixture(4)
    swapped = mixture.marginal((2, 0))
    np.testing.assert_allclose(swapped.mean(), mixture.mean()[jnp.array([2, 0])], rtol=1e-5)
    np.testing.assert_allclose(swapped.covariance(), mixture.covariance()[np.ix_([2, 0], [2, 0])], rtol=1e-4)


@pytest.mark.parametrize("scale", [(2.0, 0.5, 1e-3), (-2.0, 0.5, -3.0)])
def test_affine_changes_variables(scale):
    mixture, shift, scale = random_mixture(5), jnp.array([1.0, -2.0, 0.5]), jnp.array(scale)
    z = jnp.array([0.1, 0.2, -0.3])
    moved = mixture.affine(shift, scale)
    expected = mixture.log_prob(z) - jnp.log(jnp.abs(scale)).sum()
    np.testing.assert_allclose(moved.log_prob(shift + scale * z), expected, atol=2e-3)
    assert (jnp.diagonal(moved.scale_trils, axis1=1, axis2=2) > 0).all()


def test_moment_match_keeps_mean_and_covariance():
    mixture = random_mixture(6)
    mean, tril = moment_match(mixture)
    np.testing.assert_allclose(mean, mixture.mean(), rtol=1e-5)
    np.testing.assert_allclose(tril @ tril.T, mixture.covariance(), rtol=1e-4, atol=1e-5)
    np.testing.assert_array_equal(tril, jnp.tril(tril))


def test_log_prob_has_finite_derivatives_far_away_and_with_an_empty_component():
    mixture = random_mixture(7, scale=0.01)
    mixture = mixture.replace(log_weights=mixture.log_weights.at[0].set(-jnp.inf))
    grads = jax.jit(jax.grad(lambda m, t: m.log_prob(t), (0, 1)))(mixture, jnp.full(3, 50.0))
    assert all(jnp.isfinite(g).all() for g in jax.tree.leaves(grads))


def test_widening_keeps_the_mean_and_scales_the_covariance():
    mixture = random_mixture(3)
    wide = mixture.widen(1.7)
    assert jnp.allclose(wide.mean(), mixture.mean(), atol=1e-5)
    assert jnp.allclose(wide.covariance(), 1.7**2 * mixture.covariance(), rtol=1e-4)
