import jax
import jax.numpy as jnp

from bayessim_jax.beliefs import GaussianMixture
from bayessim_jax.inference.evidence import combine_evidence, credible_level, inflate, recalibrate, regress

FREE = -jnp.inf, jnp.inf


def _posteriors(key, theta, sd):
    """Exact posteriors N((θ̂/s²)/(1 + 1/s²), 1/(1 + 1/s²)) of single measurements of a standard normal parameter."""
    measured = theta + sd[:, None] * jax.random.normal(key, (sd.size, theta.size))
    precision = 1 + 1 / sd**2
    means = measured / (sd**2 * precision)[:, None]
    trils = jnp.eye(theta.size) / jnp.sqrt(precision)[:, None, None]
    mixtures = GaussianMixture(jnp.zeros((sd.size, 1)), means[:, None], trils[:, None])
    return measured, mixtures


def test_combined_evidence_is_the_conjugate_posterior_of_all_measurements():
    sd = jnp.array([0.5, 1.0, 2.0, 0.7])
    measured, each = _posteriors(jax.random.key(0), jnp.array([0.3, -0.8]), sd)
    combined = combine_evidence(each, jnp.ones(4, bool))
    precision = 1 + (1 / sd**2).sum()
    assert jnp.allclose(combined.means[0], (measured / sd[:, None] ** 2).sum(0) / precision, atol=1e-5)
    assert jnp.allclose(combined.covariance(), jnp.eye(2) / precision, atol=1e-5)


def test_a_recording_that_is_not_used_changes_nothing():
    sd = jnp.array([0.5, 1.0, 2.0, 0.7])
    _, each = _posteriors(jax.random.key(0), jnp.zeros(2), sd)
    some = combine_evidence(each, jnp.array([True, True, True, False]))
    fewer = combine_evidence(jax.tree.map(lambda leaf: leaf[:3], each), jnp.ones(3, bool))
    assert jnp.allclose(some.means, fewer.means) and jnp.allclose(some.scale_trils, fewer.scale_trils)


def test_recalibration_undoes_a_known_bias_and_overconfidence():
    n, d = 4000, 2
    keys = jax.random.split(jax.random.key(1), 2)
    tril = jnp.array([[0.5, 0.0], [0.3, 0.2]])
    means = jax.random.normal(keys[0], (n, d))
    truths = means + jax.random.normal(keys[1], (n, d)) @ tril.T
    stated = GaussianMixture(
        jnp.zeros((n, 1)), (means + tril @ jnp.array([0.4, -0.2]))[:, None], jnp.broadcast_to(tril / 2, (n, 1, d, d))
    )
    found = regress(stated, truths, jnp.ones(n))
    assert jnp.allclose(found.shift(jnp.zeros(d)), -2 * jnp.array([0.4, -0.2]), atol=0.1)
    assert jnp.allclose(jnp.diagonal(found.stretch), 2.0, atol=0.15)
    corrected = jax.vmap(found.apply)(stated)
    level = credible_level(jax.random.key(2), corrected, truths, *FREE)
    assert abs(float((level <= 0.9).mean()) - 0.9) < 0.02 and abs(float((level <= 0.5).mean()) - 0.5) < 0.03


def test_recalibration_leaves_a_calibrated_posterior_alone():
    n = 2000
    means = jax.random.normal(jax.random.key(3), (n, 3))
    truths = means + jax.random.normal(jax.random.key(4), (n, 3))
    stated = GaussianMixture(jnp.zeros((n, 1)), means[:, None], jnp.broadcast_to(jnp.eye(3), (n, 1, 3, 3)))
    found = regress(stated, truths, jnp.ones(n))
    assert jnp.abs(jax.vmap(found.shift)(means)).max() < 0.3 and jnp.allclose(found.stretch, jnp.eye(3), atol=0.1)


def test_recalibration_takes_out_an_error_that_depends_on_where_the_posterior_sits():
    n = 1000
    keys = jax.random.split(jax.random.key(5), 2)
    truths = jax.random.normal(keys[0], (n, 2))
    # a network that shrinks towards zero and knows nothing of it
    means = 0.5 * truths + 0.05 * jax.random.normal(keys[1], (n, 2))
    stated = GaussianMixture(jnp.zeros((n, 1)), means[:, None], jnp.broadcast_to(0.05 * jnp.eye(2), (n, 1, 2, 2)))
    corrected = jax.vmap(regress(stated, truths, jnp.ones(n)).apply)(stated)
    assert jnp.abs(corrected.means[:, 0] - truths).mean() < 0.1
    assert jnp.allclose(jnp.sqrt(jax.tree.map(lambda leaf: leaf[0], corrected).covariance().diagonal()), 0.1, atol=0.01)
    assert abs(float((credible_level(jax.random.key(6), corrected, truths, *FREE) <= 0.9).mean()) - 0.9) < 0.03


def test_a_pair_of_weight_zero_does_not_count():
    means = jax.random.normal(jax.random.key(7), (40, 2))
    truths = means + jax.random.normal(jax.random.key(8), (40, 2))
    stated = GaussianMixture(jnp.zeros((40, 1)), means[:, None], jnp.broadcast_to(jnp.eye(2), (40, 1, 2, 2)))
    first = jax.tree.map(lambda leaf: leaf[:25], stated)
    some = regress(stated, truths.at[25:].set(9.0), (jnp.arange(40) < 25).astype(float))
    fewer = regress(first, truths[:25], jnp.ones(25))
    assert all(
        jnp.allclose(a, b, atol=1e-4) for a, b in zip(jax.tree.leaves(some), jax.tree.leaves(fewer), strict=True)
    )


def test_inflation_scales_the_covariance_of_the_whole():
    tril = jnp.array([[[0.5, 0.0], [0.3, 0.2]], [[0.1, 0.0], [0.0, 0.9]]])
    mixture = GaussianMixture(jnp.log(jnp.array([0.3, 0.7])), jnp.array([[0.0, 1.0], [2.0, -1.0]]), tril)
    assert jnp.allclose(inflate(mixture, 1.5).covariance(), 2.25 * mixture.covariance(), rtol=1e-5)
    assert jnp.allclose(inflate(mixture, 1.0).scale_trils, tril, atol=1e-6)


def test_posteriors_that_leak_out_of_the_box_are_widened_until_their_sets_hold_enough():
    """Each states N(0.9 θ, σ²) on the whole line; cut to the box the stated sets are too small."""
    n = 400
    keys = jax.random.split(jax.random.key(9), 3)
    truths = jax.random.uniform(keys[0], (n, 1), minval=-1.0, maxval=1.0)
    means = truths + 0.8 * jax.random.normal(keys[1], (n, 1))
    stated = GaussianMixture(jnp.zeros((n, 1)), means[:, None], jnp.full((n, 1, 1, 1), 0.5))
    box = -jnp.ones(1), jnp.ones(1)
    before = credible_level(keys[2], stated, truths, *box)
    assert (before <= 0.9).mean() < 0.82
    found, level = recalibrate(keys[2], stated, truths, *box)
    assert 0.5 <= (level <= 0.5).mean() < 0.6 and 0.9 <= (level <= 0.9).mean() < 0.96
    again = credible_level(jax.random.key(10), jax.vmap(found.apply)(stated), truths, *box, draws=512)
    assert abs(float((again <= 0.9).mean()) - 0.92) < 0.03
