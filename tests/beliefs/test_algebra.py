"""Products, quotients and reductions obey their laws."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayessim_jax.beliefs import GaussianMixture, moment_match, product, quotient, reduce

THETAS = jnp.asarray(np.random.default_rng(9).normal(size=(40, 3)), jnp.float32)
multiply, divide = jax.jit(product), jax.jit(quotient)
FAR = 1e3, 1e3  # nothing is held back
merge = jax.jit(reduce, static_argnames="count")
density = jax.jit(jax.vmap(lambda m, t: m.log_prob(t), (None, 0)))


def random_mixture(seed, components=4, d=3, scale=1.0):
    rng = np.random.default_rng(seed)
    trils = np.tril(rng.normal(0, 0.3, (components, d, d)), -1)
    trils += np.einsum("ki,ij->kij", rng.uniform(0.5, 1.0, (components, d)), np.eye(d))
    leaves = (rng.normal(size=components), rng.normal(size=(components, d)), scale * trils)
    return GaussianMixture(*(jnp.asarray(x, jnp.float32) for x in leaves))


def single(mean, tril):
    return GaussianMixture(jnp.zeros(1), mean[None], tril[None])


def test_product_is_the_pointwise_product_and_knows_its_mass():
    a, b = random_mixture(0), random_mixture(1, components=3)
    ab = multiply(a, b)
    assert ab.means.shape == (12, 3)
    mass = jax.nn.logsumexp(ab.log_weights)
    np.testing.assert_allclose(density(ab, THETAS) + mass, density(a, THETAS) + density(b, THETAS), atol=2e-3)


def test_mass_of_a_product_is_its_integral():
    a, b = random_mixture(2, d=1), random_mixture(3, d=1)
    grid = jnp.linspace(-12, 12, 4001)[:, None]
    integral = jnp.exp(density(a, grid) + density(b, grid)).sum() * (grid[1] - grid[0])[0]
    np.testing.assert_allclose(jax.nn.logsumexp(multiply(a, b).log_weights), jnp.log(integral), atol=1e-4)


def test_product_commutes():
    a, b = random_mixture(4), random_mixture(5)
    np.testing.assert_allclose(density(multiply(a, b), THETAS), density(multiply(b, a), THETAS), atol=2e-3)


def test_product_narrows_by_the_square_root_of_the_count():
    g = single(jnp.array([1.0, 2.0]), jnp.array([[0.1, 0.0], [0.05, 0.02]]))
    many = g
    for _ in range(15):
        many = multiply(many, g)
    np.testing.assert_allclose(many.scale_trils[0], g.scale_trils[0] / 4, rtol=1e-4, atol=1e-7)
    np.testing.assert_allclose(many.means[0], g.means[0], rtol=1e-5)


def test_product_bears_very_different_scales():
    wide, narrow = random_mixture(6, scale=100.0), random_mixture(7, scale=1e-3)
    got = multiply(wide, narrow)
    np.testing.assert_allclose(got.mean(), narrow.marginal((0, 1, 2)).mean(), atol=0.5)
    assert all(jnp.isfinite(x).all() for x in jax.tree.leaves(got))
    np.testing.assert_allclose(got.scale_trils[:4], narrow.scale_trils, rtol=1e-3, atol=1e-6)


def test_quotient_undoes_a_product():
    a, (mean, tril) = random_mixture(8), moment_match(random_mixture(9))
    ag = multiply(a, single(mean, tril))
    back = divide(ag, mean, tril, *FAR)
    np.testing.assert_allclose(back.means, a.means, atol=2e-3)
    np.testing.assert_allclose(back.scale_trils, a.scale_trils, atol=2e-3)
    np.testing.assert_allclose(back.weights, a.weights, atol=2e-3)
    np.testing.assert_allclose(jax.nn.logsumexp(back.log_weights), -jax.nn.logsumexp(ag.log_weights), atol=5e-3)


def test_quotient_is_the_pointwise_quotient():
    a, mean, tril = random_mixture(10), jnp.array([0.3, -0.2, 0.1]), 4 * jnp.eye(3)
    q = divide(a, mean, tril)
    difference = density(q, THETAS) - (density(a, THETAS) - density(single(mean, tril), THETAS))
    np.testing.assert_allclose(difference, -jax.nn.logsumexp(q.log_weights), atol=2e-3)


def test_quotient_by_a_narrower_gaussian_leaves_shape_and_share_alone():
    a = random_mixture(11)
    wide = a.replace(means=jnp.zeros((4, 3)), scale_trils=jnp.stack([k * jnp.eye(3) for k in (3.1, 5.0, 8.0, 3.0)]))
    q = divide(wide, jnp.zeros(3), 3 * jnp.eye(3))
    np.testing.assert_allclose(q.means, wide.means, atol=1e-6)
    np.testing.assert_allclose(q.scale_trils, wide.scale_trils, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(q.weights, wide.weights, rtol=1e-5)


def test_quotient_divides_the_axes_that_are_narrower_whatever_the_others_are():
    turn = jnp.linalg.qr(jnp.asarray(np.random.default_rng(3).normal(size=(2, 2)), jnp.float32))[0]
    slim = single(turn @ jnp.array([0.2, 0.5]), jnp.linalg.cholesky(turn @ jnp.diag(jnp.array([0.09, 4.0])) @ turn.T))
    q = divide(slim, jnp.zeros(2), jnp.eye(2))
    np.testing.assert_allclose(turn.T @ q.means[0], [0.2 / 0.91, 0.5], atol=1e-5)
    inner = turn.T @ q.scale_trils[0] @ q.scale_trils[0].T @ turn
    np.testing.assert_allclose(inner, np.diag([0.09 / 0.91, 4.0]), atol=1e-5)


@pytest.mark.parametrize("share", [0.5, 0.9, 0.99, 0.9999, 1.0])
@pytest.mark.parametrize("off", [0.0, 1.0, 2.9])
def test_quotient_stays_where_the_divisor_has_its_mass(share, off):
    """A component that is almost as wide as the divisor would move by off / (1 − share): out of all that was seen."""
    near = single(jnp.array([off, 0.0]), jnp.sqrt(share) * jnp.eye(2))
    q = divide(near, jnp.zeros(2), jnp.eye(2))
    assert (jnp.abs(q.means) <= 3.0 + 1e-4).all()
    assert (jnp.abs(q.scale_trils) <= 1.0 + 1e-4).all()


def test_mass_of_a_quotient_is_its_integral():
    """Where an axis is not divided whole, too: it is N(θ; μ, σ²) / p̃(θ)^κ, with p̃ scaled to its own at its centre."""
    narrow, wide, grid = 0.4, 0.9, jnp.linspace(-12, 12, 8001)[:, None]
    both = GaussianMixture(jnp.log(jnp.array([0.3, 0.7])), jnp.array([[0.5], [1.0]]), jnp.array([[[narrow]], [[wide]]]))
    q = divide(both, jnp.zeros(1), jnp.eye(1))
    power = (1 - max(wide**2, 1.0 / 3)) / wide**2  # leaves a variance of one
    first = 0.3 * jnp.exp(density(single(jnp.array([0.5]), jnp.array([[narrow]])), grid) + 0.5 * grid[:, 0] ** 2)
    second = 0.7 * jnp.exp(density(single(jnp.array([1.0]), jnp.array([[wide]])), grid) + 0.5 * power * grid[:, 0] ** 2)
    integral = (first + second).sum() * (grid[1] - grid[0])[0] * jnp.sqrt(2 * jnp.pi)
    np.testing.assert_allclose(jax.nn.logsumexp(q.log_weights), jnp.log(integral), atol=1e-3)


@pytest.mark.parametrize("count", [1, 3, 11])
def test_reduce_keeps_mass_mean_and_covariance(count):
    mixture = random_mixture(12, components=12)
    small = merge(mixture, count=count)
    assert small.means.shape == (count, 3)
    np.testing.assert_allclose(jax.nn.logsumexp(small.log_weights), jax.nn.logsumexp(mixture.log_weights), atol=1e-5)
    np.testing.assert_allclose(small.mean(), mixture.mean(), atol=1e-5)
    np.testing.assert_allclose(small.covariance(), mixture.covariance(), atol=2e-5)


def test_reduce_to_as_many_is_the_identity():
    mixture = random_mixture(13)
    for kept, given in zip(jax.tree.leaves(reduce(mixture, 4)), jax.tree.leaves(mixture), strict=True):
        np.testing.assert_array_equal(kept, given)


def test_reduce_merges_twins_and_leaves_the_rest():
    mixture = random_mixture(14, components=3, scale=0.2)
    doubled = GaussianMixture(*(jnp.concatenate([x, x]) for x in jax.tree.leaves(mixture)))
    np.testing.assert_allclose(density(merge(doubled, count=3), THETAS), density(mixture, THETAS), atol=5e-3, rtol=1e-4)


def test_reduce_batches_and_survives_empty_components():
    mixture = random_mixture(15, components=6)
    mixture = mixture.replace(log_weights=mixture.log_weights.at[:3].set(-jnp.inf))
    stacked = jax.tree.map(lambda x: jnp.stack([x, x]), mixture)
    small = jax.jit(jax.vmap(lambda m: reduce(m, 3)))(stacked)
    np.testing.assert_allclose(
        density(jax.tree.map(lambda x: x[1], small), THETAS), density(mixture, THETAS), atol=1e-3
    )


def test_reduce_refuses_to_keep_nothing():
    with pytest.raises(ValueError, match="at least 1"):
        reduce(random_mixture(16), 0)
