from functools import partial

import jax
import jax.numpy as jnp
import pytest
from jax.scipy.stats import norm

from bayessim_jax.beliefs import GaussianMixture
from bayessim_jax.inference.recalibration import credible_levels, judge, nearness, recalibrate, regress

FREE = -jnp.inf, jnp.inf


regression, recalibration = jax.jit(regress), jax.jit(recalibrate)
apply = jax.jit(lambda found, mixtures: jax.vmap(found.apply)(mixtures))


@partial(jax.jit, static_argnames="draws")
def credible_level(key, mixtures, truths, low, high, draws=64):
    return credible_levels(key, mixtures, truths, low, high, jnp.ones(1), draws)[:, 0]


def test_recalibration_undoes_a_known_bias_and_overconfidence():
    n, d = 4000, 2
    keys = jax.random.split(jax.random.key(1), 2)
    tril = jnp.array([[0.5, 0.0], [0.3, 0.2]])
    means = jax.random.normal(keys[0], (n, d))
    truths = means + jax.random.normal(keys[1], (n, d)) @ tril.T
    stated = GaussianMixture(
        jnp.zeros((n, 1)), (means + tril @ jnp.array([0.4, -0.2]))[:, None], jnp.broadcast_to(tril / 2, (n, 1, d, d))
    )
    found = regression(stated, truths, jnp.ones(n))
    assert jnp.allclose(found.shift(jnp.zeros(d)), -2 * jnp.array([0.4, -0.2]), atol=0.1)
    assert jnp.allclose(jnp.diagonal(found.stretch), 2.0, atol=0.15)
    corrected = apply(found, stated)
    level = credible_level(jax.random.key(2), corrected, truths, *FREE)
    assert abs(float((level <= 0.9).mean()) - 0.9) < 0.02 and abs(float((level <= 0.5).mean()) - 0.5) < 0.03


def test_recalibration_leaves_a_calibrated_posterior_alone():
    n = 2000
    means = jax.random.normal(jax.random.key(3), (n, 3))
    truths = means + jax.random.normal(jax.random.key(4), (n, 3))
    stated = GaussianMixture(jnp.zeros((n, 1)), means[:, None], jnp.broadcast_to(jnp.eye(3), (n, 1, 3, 3)))
    found = regression(stated, truths, jnp.ones(n))
    assert jnp.abs(jax.vmap(found.shift)(means)).max() < 0.3 and jnp.allclose(found.stretch, jnp.eye(3), atol=0.1)


def test_recalibration_takes_out_an_error_that_depends_on_where_the_posterior_sits():
    n = 1000
    keys = jax.random.split(jax.random.key(5), 2)
    truths = jax.random.normal(keys[0], (n, 2))
    # a network that shrinks towards zero and knows nothing of it
    means = 0.5 * truths + 0.05 * jax.random.normal(keys[1], (n, 2))
    stated = GaussianMixture(jnp.zeros((n, 1)), means[:, None], jnp.broadcast_to(0.05 * jnp.eye(2), (n, 1, 2, 2)))
    corrected = apply(regression(stated, truths, jnp.ones(n)), stated)
    assert jnp.abs(corrected.means[:, 0] - truths).mean() < 0.1
    assert jnp.allclose(jnp.sqrt(jax.tree.map(lambda leaf: leaf[0], corrected).covariance().diagonal()), 0.1, atol=0.01)
    assert abs(float((credible_level(jax.random.key(6), corrected, truths, *FREE) <= 0.9).mean()) - 0.9) < 0.03


def test_a_pair_of_weight_zero_does_not_count():
    means = jax.random.normal(jax.random.key(7), (40, 2))
    truths = means + jax.random.normal(jax.random.key(8), (40, 2))
    stated = GaussianMixture(jnp.zeros((40, 1)), means[:, None], jnp.broadcast_to(jnp.eye(2), (40, 1, 2, 2)))
    first = jax.tree.map(lambda leaf: leaf[:25], stated)
    some = regression(stated, truths.at[25:].set(9.0), (jnp.arange(40) < 25).astype(float))
    fewer = regression(first, truths[:25], jnp.ones(25))
    assert all(
        jnp.allclose(a, b, atol=1e-4) for a, b in zip(jax.tree.leaves(some), jax.tree.leaves(fewer), strict=True)
    )


def test_a_posterior_that_leaks_out_of_the_box_is_recalibrated_to_the_sets_it_states():
    """Each states N(0.9 θ, σ²) on the whole line; cut to the box the stated sets are too small."""
    n = 800
    keys = jax.random.split(jax.random.key(9), 3)
    truths = jax.random.uniform(keys[0], (n, 1), minval=-1.0, maxval=1.0)
    means = truths + 0.8 * jax.random.normal(keys[1], (n, 1))
    stated = GaussianMixture(jnp.zeros((n, 1)), means[:, None], jnp.full((n, 1, 1, 1), 0.5))
    box = -jnp.ones(1), jnp.ones(1)
    before = credible_level(keys[2], stated, truths, *box)
    assert (before <= 0.9).mean() < 0.82
    found, level = recalibration(keys[2], stated, truths, jnp.ones(n), *box)
    assert _near(level, 0.5, 0.04) and _near(level, 0.9, 0.03)
    again = credible_level(jax.random.key(10), apply(found, stated), truths, *box, draws=512)
    assert _near(again, 0.5, 0.04) and _near(again, 0.9, 0.03)


def _near(levels, asked, slack):
    return abs(float((levels <= asked).mean()) - asked) < slack


@pytest.mark.parametrize("factor", [0.6, 1.0, 1.6])
def test_recalibration_is_as_ready_to_narrow_as_to_widen(factor):
    """Over many small calibrations the sets of fresh posteriors hold their share: neither fewer truths nor more."""

    def one(key):
        keys = jax.random.split(key, 4)
        n = 256
        means = jax.random.normal(keys[0], (2 * n, 2))
        truths = means + 0.3 * jax.random.normal(keys[1], (2 * n, 2))
        trils = jnp.broadcast_to(0.3 * factor * jnp.eye(2), (2 * n, 1, 2, 2))
        stated = GaussianMixture(jnp.zeros((2 * n, 1)), means[:, None], trils)
        seen, fresh = (jax.tree.map(lambda leaf, part=part: leaf[part], stated) for part in (slice(n), slice(n, None)))
        found, _ = recalibration(keys[2], seen, truths[:n], jnp.ones(n), -jnp.full(2, 9.0), jnp.full(2, 9.0))
        return credible_level(keys[3], apply(found, fresh), truths[n:], *FREE)

    levels = jax.lax.map(one, jax.random.split(jax.random.key(11), 24)).ravel()
    assert _near(levels, 0.5, 0.02) and _near(levels, 0.9, 0.015)


def test_recalibration_looks_at_the_simulations_near_what_was_observed():
    """Networks that are right in the middle and overstate what they know elsewhere stay as they are in the middle."""
    n = 2000
    keys = jax.random.split(jax.random.key(12), 3)
    means = 1.5 * jax.random.normal(keys[0], (n, 2))
    sd = 0.2 * jnp.where(jnp.linalg.norm(means, axis=-1) > 1.5, 4.0, 1.0)
    truths = means + sd[:, None] * jax.random.normal(keys[1], (n, 2))
    stated = GaussianMixture(jnp.zeros((n, 1)), means[:, None], jnp.broadcast_to(0.2 * jnp.eye(2), (n, 1, 2, 2)))
    middle = GaussianMixture(jnp.zeros(1), jnp.zeros((1, 2)), 0.2 * jnp.eye(2)[None])
    weights = nearness(stated, middle, share=0.3)
    assert jnp.allclose(weights.sum(), weights.sum() ** 2 / (weights**2).sum(), rtol=1e-4)
    near, _ = recalibration(keys[2], stated, truths, weights, *FREE)
    far, _ = recalibration(keys[2], stated, truths, jnp.ones(n), *FREE)
    assert jnp.allclose(jnp.diagonal(near.stretch), 1.0, atol=0.15)
    assert (jnp.diagonal(far.stretch) > 1.5).all()


@pytest.mark.parametrize(("factor", "collapsed"), [(1.0, False), (1.6, False), (3.0, True)])
def test_networks_that_state_less_than_half_of_their_errors_have_collapsed(factor, collapsed):
    """Recalibrated or not: what is handed on can be calibrated while most of the evidence was not there."""
    n = 300
    error = factor * jax.random.normal(jax.random.key(13), (n,))
    before = 1.0 - 2.0 * norm.sf(jnp.abs(error))
    after = 1.0 - 2.0 * norm.sf(jnp.abs(error) / factor)
    info = judge(before, after, jnp.ones(n), 1, jnp.array(factor))
    assert bool(info.collapsed) == collapsed
    assert not info.overconfident
    assert abs(float(info.coverage90_network) - float(1.0 - 2.0 * norm.sf(1.645 / factor))) < 0.08


def test_coverage_counts_by_weight():
    levels = jnp.array([0.2, 0.2, 0.95, 0.95])
    info = judge(levels, levels, jnp.array([1.0, 1.0, 0.0, 0.0]), 2, jnp.ones(()))
    assert float(info.coverage50) == 1.0 and float(info.coverage90) == 1.0
