"""Calibration tools on a model whose posterior is known: the exact one passes, a narrow or wrong one is caught."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import chisquare, norm

from bayessim_jax.inference.calibration import c2st, expected_coverage, sbc_ranks, tarp, uniformity_test

N, DRAWS, LEVELS = 2000, 199, np.array([0.1, 0.5, 0.9])
FINE = np.linspace(0.05, 0.95, 19, dtype=np.float32)
KOLMOGOROV = 1.63 / np.sqrt(N)  # a right coverage curve strays further from the diagonal in 1 % of cases
PRIOR = np.array([[1.0, 0.6], [0.6, 2.0]])
NOISE = np.diag([0.5, 0.8])
EXACT = np.linalg.inv(np.linalg.inv(PRIOR) + np.linalg.inv(NOISE))
ranks_of, coverage, tarp_of = jax.jit(sbc_ranks), jax.jit(expected_coverage), jax.jit(tarp)
uniform = jax.jit(uniformity_test, static_argnums=(1, 2))
classify = jax.jit(c2st, static_argnames=("folds", "steps"))


def conjugate(scale=1.0, shift=0.0):
    """Truths, and draws and log densities of N(m + shift, scale² S) for the exact posterior N(m, S)."""
    rng = np.random.default_rng(0)
    truths = rng.multivariate_normal(np.zeros(2), PRIOR, N)
    seen = truths + rng.normal(size=(N, 2)) * np.sqrt(np.diag(NOISE))
    means = seen @ np.linalg.solve(NOISE, EXACT) + shift
    covariance = scale**2 * EXACT
    samples = means[:, None] + rng.multivariate_normal(np.zeros(2), covariance, (N, DRAWS))

    def log_prob(theta, mean):
        gap = theta - mean
        return -0.5 * np.einsum("...i,ij,...j->...", gap, np.linalg.inv(covariance), gap)

    arrays = (truths, samples, log_prob(truths, means), log_prob(samples, means[:, None]))
    return [np.asarray(x, np.float32) for x in arrays]


WRONG = {"narrow": {"scale": 0.7}, "wide": {"scale": 1.5}, "shifted": {"shift": 0.3}}


def test_ranks_count_the_draws_below():
    samples = jnp.array([[[0.0], [1.0], [2.0]], [[5.0], [6.0], [7.0]]])
    np.testing.assert_array_equal(sbc_ranks(samples, jnp.array([[1.5], [4.0]])), [[2.0], [0.0]])


def test_ranks_of_the_exact_posterior_are_uniform():
    truths, samples, *_ = conjugate()
    _, p = uniform(ranks_of(samples, truths), DRAWS, 20)
    assert p.shape == (2,) and (p > 0.01).all()


@pytest.mark.parametrize("fault", WRONG)
def test_ranks_of_a_wrong_posterior_are_not(fault):
    truths, samples, *_ = conjugate(**WRONG[fault])
    _, p = uniform(ranks_of(samples, truths), DRAWS, 20)
    assert (p < 1e-6).all()


def test_uniformity_agrees_with_scipy_in_uneven_bins():
    ranks = np.random.default_rng(1).integers(0, 11, 400)
    chi2, p = uniform(jnp.asarray(ranks, float), 10, 4)
    index = np.arange(11) * 4 // 11
    counts, expected = np.bincount(ranks * 4 // 11, minlength=4), np.bincount(index) * 400 / 11
    exact = chisquare(counts, expected)
    np.testing.assert_allclose((chi2, p), (exact.statistic, exact.pvalue), rtol=1e-4)


def test_p_values_are_uniform_when_ranks_are():
    ranks = jax.random.randint(jax.random.key(0), (400, 500), 0, 100).astype(float)
    _, p = uniform(ranks, 99, 10)
    assert abs((p < 0.05).mean() - 0.05) < 0.04 and abs(p.mean() - 0.5) < 0.06


def test_coverage_of_the_exact_posterior_is_the_level():
    _, _, at_truth, at_draws = conjugate()
    np.testing.assert_allclose(coverage(at_truth, at_draws, LEVELS), LEVELS, atol=KOLMOGOROV)


@pytest.mark.parametrize(("fault", "sign"), [("narrow", -1), ("wide", 1), ("shifted", -1)])
def test_coverage_tells_the_direction_of_the_fault(fault, sign):
    _, _, at_truth, at_draws = conjugate(**WRONG[fault])
    assert sign * (coverage(at_truth, at_draws, LEVELS)[1] - 0.5) > KOLMOGOROV


def test_coverage_of_a_scaled_gaussian_is_known():
    _, _, at_truth, at_draws = conjugate(scale=0.7)
    expected = 1 - (1 - LEVELS) ** (0.7**2)  # radius² is exponential in two dimensions
    np.testing.assert_allclose(coverage(at_truth, at_draws, LEVELS), expected, atol=KOLMOGOROV)


def test_truth_outside_the_support_is_not_covered():
    at_draws = jnp.zeros((4, 100)) - jnp.arange(100.0)
    share = coverage(jnp.array([-jnp.inf, -jnp.inf, -5.5, -5.5]), at_draws, jnp.array([0.99]))
    np.testing.assert_allclose(share, [0.5])


def test_tarp_of_the_exact_posterior_is_the_level():
    truths, samples, *_ = conjugate()
    assert np.abs(tarp_of(jax.random.key(0), samples, truths, FINE) - FINE).max() < KOLMOGOROV


@pytest.mark.parametrize("wrong", [{"scale": 0.7}, {"scale": 1.5}, {"shift": 1.0}])
def test_tarp_catches_a_wrong_posterior(wrong):
    truths, samples, *_ = conjugate(**wrong)
    assert np.abs(tarp_of(jax.random.key(0), samples, truths, FINE) - FINE).max() > KOLMOGOROV


def test_tarp_sees_the_missing_correlation_that_ranks_cannot():
    rng = np.random.default_rng(3)
    means = rng.normal(size=(N, 2))
    truths = (means + rng.multivariate_normal(np.zeros(2), [[1.0, 0.95], [0.95, 1.0]], N)).astype(np.float32)
    samples = (means[:, None] + rng.normal(size=(N, DRAWS, 2))).astype(np.float32)
    assert (uniform(ranks_of(samples, truths), DRAWS, 20)[1] > 0.01).all()
    assert np.abs(tarp_of(jax.random.key(0), samples, truths, FINE) - FINE).max() > KOLMOGOROV


def test_tarp_does_not_change_with_the_unit():
    truths, samples, *_ = conjugate(scale=0.7)
    unit = np.array([1e3, 1e-2], np.float32)
    one, other = (tarp_of(jax.random.key(0), samples * u, truths * u, FINE) for u in (1.0, unit))
    np.testing.assert_allclose(one, other, atol=2e-3)


@pytest.mark.parametrize("tool", ["ranks", "coverage", "tarp", "c2st"])
def test_a_nan_is_never_silent(tool):
    truths, samples, at_truth, at_draws = conjugate()
    samples[3, 5], at_draws[3, 5] = np.nan, np.nan
    outcome = {
        "ranks": lambda: uniform(ranks_of(samples, truths), DRAWS, 20)[1],
        "coverage": lambda: coverage(at_truth, at_draws, LEVELS),
        "tarp": lambda: tarp_of(jax.random.key(0), samples, truths, FINE),
        "c2st": lambda: classify(jax.random.key(0), samples[:500, 5], truths[:500]),
    }[tool]()
    assert np.isnan(outcome).all()


@pytest.mark.parametrize("shift", [0.0, pytest.param(1.0, marks=pytest.mark.slow), 4.0])
def test_classifier_comes_close_to_the_best_accuracy(shift):
    rng = np.random.default_rng(2)
    x, y = (rng.normal(size=(500, 2)).astype(np.float32) for _ in range(2))
    y[:, 0] += shift
    accuracy = classify(jax.random.key(0), x, y)
    assert norm.cdf(shift / 2) - 0.06 < accuracy < norm.cdf(shift / 2) + 0.035


def test_classifier_catches_a_narrow_posterior():
    truths, _, *_ = conjugate()
    x = truths[:500]
    y = 0.5 * truths[500:1000]
    assert classify(jax.random.key(1), x, y) > 0.58


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: uniformity_test(jnp.zeros(400), 5, 10), "draws \\+ 1 = 6"),
        (lambda: uniformity_test(jnp.zeros(30), 99, 10), "at most 6 bins"),
        (lambda: c2st(jax.random.key(0), jnp.zeros((5, 2)), jnp.zeros((4, 2))), "as many draws of each"),
        (lambda: c2st(jax.random.key(0), jnp.zeros((5, 2)), jnp.zeros((5, 2)), folds=6), "folds is 6"),
    ],
)
def test_refusals_name_the_remedy(call, message):
    with pytest.raises(ValueError, match=message):
        call()
