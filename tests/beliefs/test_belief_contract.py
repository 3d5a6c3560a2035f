"""Every belief keeps the contract: normalized, samples in its support, batched, a legal scan carry."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayessim_jax.beliefs import Ellipsoid, GaussianMixture, Particles, Truncated, Uniform
from bayessim_jax.contracts import Belief, Box

BOX = Box.create(length=(0.1, 1.0, "m"), mass=(-1.0, 3.0, "kg"))


def mixture():
    trils = jnp.array([[[0.2, 0.0], [0.1, 0.5]], [[0.3, 0.0], [-0.3, 0.4]]])
    return GaussianMixture(jnp.array([0.3, -0.2]), jnp.array([[0.4, 1.0], [0.9, 0.0]]), trils)


BELIEFS = {
    "uniform": lambda: Uniform(BOX),
    "ellipsoid": lambda: Ellipsoid.create(jnp.array([0.5, 1.0]), jnp.array([[0.3, 0.0], [-0.8, 0.5]]), BOX),
    "ellipsoid in a corner": lambda: Ellipsoid.create(
        jnp.array([0.15, 2.7]), jnp.array([[0.5, 0.0], [-1.5, 0.4]]), BOX
    ),
    "mixture": mixture,
    "truncated": lambda: Truncated.create(mixture(), BOX, 0.1),
    "prior": lambda: Truncated.uniform(BOX, 2),
    "particles": lambda: Particles(jax.vmap(mixture().sample)(jax.random.split(jax.random.key(3), 40)), jnp.zeros(40)),
}
log_prob = jax.jit(jax.vmap(lambda b, t: b.log_prob(t), (None, 0)))
sample = jax.jit(jax.vmap(lambda b, k: b.sample(k), (None, 0)))
batched_sample = jax.jit(jax.vmap(lambda b, k: b.sample(k)))
batched_log_prob = jax.jit(jax.vmap(lambda b, t: b.log_prob(t)))
moments = jax.jit(lambda b: (b.mean(), b.covariance()))
scanned = jax.jit(lambda b, keys: jax.lax.scan(lambda carry, key: (carry, carry.sample(key)), b, keys))
KEYS = jax.random.split(jax.random.key(0), 20_000)
LOW, WIDTH = np.array([-3.0, -8.0], np.float32), np.array([8.0, 18.0], np.float32)
GRID = LOW + WIDTH * (np.stack(np.meshgrid(np.arange(500), np.arange(500)), -1).reshape(-1, 2) + np.float32(0.5)) / 500


@pytest.fixture(params=BELIEFS, scope="module")
def belief(request):
    return BELIEFS[request.param]()


def test_is_a_belief(belief):
    assert isinstance(belief, Belief)


@pytest.fixture(scope="module")
def draws(belief):
    return np.asarray(sample(belief, KEYS))


@pytest.fixture(scope="module")
def density(belief):
    return np.exp(np.asarray(log_prob(belief, GRID), float))


def test_draws_lie_in_the_support(belief, draws):
    assert draws.shape == (len(KEYS), 2) and draws.dtype == np.float32
    assert np.isfinite(log_prob(belief, draws)).all()


def test_same_keys_same_draws(belief, draws):
    np.testing.assert_array_equal(sample(belief, KEYS), draws)


def test_density_is_normalized(density):
    assert abs(density.mean() * WIDTH.prod() - 1) < 0.02


def test_draws_and_density_are_of_one_law(density, draws):
    """The share of draws in each quadrant about their mean is the integral of the density over it."""
    centre = draws.mean(0)
    for signs in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
        expected = density[((GRID - centre) * signs > 0).all(-1)].sum() / density.sum()
        got = ((draws - centre) * signs > 0).all(-1).mean()
        assert abs(got - expected) < 0.02


def test_mean_and_covariance_are_those_of_the_draws(belief, draws):
    mean, covariance = moments(belief)
    # the kernels of particles widen their draws by 1 + h², h² = (4/((d + 2) n))^(2/(d + 4))
    kernel = 1 + (1 / 40) ** (1 / 3) if isinstance(belief, Particles) else 1.0
    spread = np.cov(draws.T) / kernel
    np.testing.assert_allclose(mean, draws.mean(0), atol=0.05)
    np.testing.assert_allclose(covariance, spread, atol=0.05 * spread.max())


def test_stacked_beliefs_batch(belief, draws):
    stacked = jax.tree.map(lambda x: np.stack([x, x, x]), belief)
    np.testing.assert_allclose(batched_sample(stacked, KEYS[:3]), draws[:3], rtol=1e-5, atol=1e-6)
    values = batched_log_prob(stacked, draws[:3])
    np.testing.assert_allclose(values, log_prob(belief, draws)[:3], rtol=1e-4, atol=1e-4)


def test_is_a_scan_carry(belief, draws):
    after, drawn = scanned(belief, KEYS[:4])
    np.testing.assert_allclose(drawn, draws[:4], rtol=1e-5, atol=1e-6)
    assert jax.tree.structure(after) == jax.tree.structure(belief)
