import jax
import jax.numpy as jnp
import pytest

from bayessim_jax.beliefs import GaussianMixture
from bayessim_jax.inference.readout import Readout, read_sets
from bayessim_jax.inference.recalibration import credible_levels

FAR = jnp.full(2, 9.0)
read = jax.jit(read_sets)
apply = jax.jit(lambda found, mixtures: jax.vmap(found.apply)(mixtures))
log_probs = jax.jit(jax.vmap(GaussianMixture.log_prob))
BOX = -jnp.ones(2), jnp.ones(2)


def gaussians(means, tril):
    d = means.shape[-1]
    return GaussianMixture(
        jnp.zeros((len(means), 1)), means[:, None], jnp.broadcast_to(tril, (len(means), d, d))[:, None]
    )


def halves(mixtures, truths):
    n = len(truths) // 2
    return tuple(
        jax.tree.map(lambda leaf, part=part: leaf[part], (mixtures, truths)) for part in (slice(n), slice(n, None))
    )


@jax.jit
def outer_fifth(key, mixtures, truths, low, high):
    """How often a truth lies among the tenth of a posterior's draws at either end of the first axis, cut to the box."""

    def one(key, mixture, truth):
        samples = jax.vmap(mixture.sample)(jax.random.split(key, 256))
        inside = ((samples >= low) & (samples <= high)).all(-1)
        return ((samples[:, 0] < truth[0]) & inside).sum() / inside.sum()

    rank = jax.vmap(one)(jax.random.split(key, len(truths)), mixtures, truths)
    return (jnp.abs(rank - 0.5) > 0.4).mean()


@jax.jit
def levels_of(key, mixtures, truths, low=-FAR, high=FAR):
    return credible_levels(key, mixtures, truths, low, high, jnp.ones(1), draws=256)[:, 0]


def holds(levels, asked, slack):
    return abs(float((levels <= asked).mean()) - asked) < slack


@pytest.mark.slow
def test_flat_directions_of_a_box_come_out_flat():
    """Nothing is known of the first parameter; its moments say so with a Gaussian, which the box then cuts."""
    keys = jax.random.split(jax.random.key(0), 4)
    truths = jax.random.uniform(keys[0], (2048, 2), minval=-1.0, maxval=1.0)
    means = jnp.stack([jnp.zeros(2048), truths[:, 1] + 0.05 * jax.random.normal(keys[1], (2048,))], axis=-1)
    stated = gaussians(means, jnp.diag(jnp.array([0.577, 0.05])))
    (seen, z), (fresh, told) = halves(stated, truths)
    found, _, _ = read(keys[2], seen, z, *BOX)
    assert outer_fifth(keys[3], fresh, told, *BOX) > 0.26
    assert abs(outer_fifth(keys[3], apply(found, fresh), told, *BOX) - 0.2) < 0.04


@pytest.mark.slow
def test_a_bent_ridge_is_followed():
    """Only θ₁θ₂ is measured: the law given the product is a hyperbola, which no Gaussian is."""
    keys = jax.random.split(jax.random.key(1), 4)
    truths = jax.random.uniform(keys[0], (4096, 2), minval=0.2, maxval=1.0)
    product = truths.prod(-1, keepdims=True) * jnp.exp(0.05 * jax.random.normal(keys[1], (4096, 1)))
    means = jnp.sqrt(product) * jnp.ones(2)
    stated = gaussians(means, jnp.array([[0.3, 0.0], [-0.28, 0.05]]))
    (seen, z), (fresh, told) = halves(stated, truths)
    found, levels, _ = read(keys[2], seen, z, jnp.full(2, 0.2), jnp.ones(2))
    after = apply(found, fresh)
    gain = log_probs(after, told) - log_probs(fresh, told)
    assert gain.mean() > 0.5
    again = levels_of(keys[3], after, told, jnp.full(2, 0.2), jnp.ones(2))
    assert holds(again, 0.5, 0.06) and holds(again, 0.9, 0.04) and holds(levels, 0.9, 0.04)


def test_evidence_counted_too_often_is_taken_back():
    """The sum of many recordings' evidence states a quarter of the error that it has, and is biased as it moves."""
    keys = jax.random.split(jax.random.key(2), 4)
    truths = jax.random.normal(keys[0], (2048, 2))
    means = 0.7 * truths + 0.2 * jnp.sin(3 * truths[:, ::-1]) + 0.1 * jax.random.normal(keys[1], (2048, 2))
    (seen, z), (fresh, told) = halves(gaussians(means, 0.03 * jnp.eye(2)), truths)
    found, levels, _ = read(keys[2], seen, z, -FAR, FAR)
    after = apply(found, fresh)
    again = levels_of(keys[3], after, told)
    for level in (levels, again):
        assert holds(level, 0.5, 0.06) and holds(level, 0.9, 0.04)
    assert jnp.abs(jax.vmap(GaussianMixture.mean)(after) - told).mean() < 0.2


def test_a_calibrated_gaussian_stays_what_it_is():
    keys = jax.random.split(jax.random.key(3), 3)
    means = jax.random.normal(keys[0], (2048, 2))
    truths = means + 0.3 * jax.random.normal(keys[1], (2048, 2))
    (seen, z), (fresh, told) = halves(gaussians(means, 0.3 * jnp.eye(2)), truths)
    found, _, _ = read(keys[2], seen, z, -FAR, FAR)
    loss = log_probs(fresh, told) - log_probs(apply(found, fresh), told)
    assert -0.02 < float(loss.mean()) < 0.03


@pytest.mark.slow
@pytest.mark.parametrize(("n", "slack"), [(64, 0.05), (256, 0.025)])
def test_few_sets_make_neither_too_small_nor_too_large_sets(n, slack):
    def one(key):
        keys = jax.random.split(key, 4)
        means = jax.random.normal(keys[0], (2 * n, 2))
        truths = 1.1 * means + 0.3 * jax.random.normal(keys[1], (2 * n, 2))
        (seen, z), (fresh, told) = halves(gaussians(means, 0.15 * jnp.eye(2)), truths)
        found, _, _ = read(keys[2], seen, z, -FAR, FAR)
        return levels_of(keys[3], apply(found, fresh), told)

    levels = jax.lax.map(one, jax.random.split(jax.random.key(4), 24)).ravel()
    assert holds(levels, 0.5, slack) and holds(levels, 0.9, slack)


def test_without_sets_it_says_the_gaussian_that_it_reads():
    tril = jnp.array([[0.5, 0.0], [0.3, 0.2]])
    said = Readout.none(2).apply(GaussianMixture(jnp.zeros(1), jnp.array([[0.4, -1.0]]), tril[None]))
    assert jnp.allclose(said.mean(), jnp.array([0.4, -1.0]), atol=1e-5)
    assert jnp.allclose(said.covariance(), tril @ tril.T, atol=1e-5)


@pytest.mark.parametrize("n", [1, pytest.param(2, marks=pytest.mark.slow), 8])
def test_a_handful_of_sets_gives_finite_numbers(n):
    means = jax.random.normal(jax.random.key(5), (n, 3))
    found, levels, _ = read(
        jax.random.key(6), gaussians(means, jnp.eye(3)), means + 0.5, -jnp.full(3, 9.0), jnp.full(3, 9.0)
    )
    said = apply(found, gaussians(jnp.zeros((1, 3)), jnp.eye(3)))
    assert all(jnp.isfinite(leaf).all() for leaf in jax.tree.leaves((said, levels)))
