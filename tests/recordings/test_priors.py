"""Priors against SciPy's distributions, and their tables."""

import numpy as np
import pytest
from scipy import integrate, stats

from bayessim_jax.recordings.priors import LogNormal, Normal, Uniform, read_prior

INF = float("inf")
PRIORS = [
    (Uniform(-1.0, 3.0), stats.uniform(-1, 4)),
    (Normal(2.0, 0.5), stats.norm(2, 0.5)),
    (Normal(0.3, 0.2, low=0.0), stats.truncnorm(-1.5, INF, 0.3, 0.2)),
    (Normal(0.3, 0.2, high=0.1), stats.truncnorm(-INF, -1, 0.3, 0.2)),
    (Normal(1.0, 2.0, low=-1.0, high=2.0), stats.truncnorm(-1, 0.5, 1, 2)),
    (Normal(-1.0, 0.2, low=0.0), stats.truncnorm(5, INF, -1, 0.2)),
    (LogNormal(0.5, 0.2), None),
]


@pytest.mark.parametrize(("prior", "reference"), PRIORS, ids=[str(prior) for prior, _ in PRIORS])
def test_moments_and_densities(prior, reference):
    ends = prior.quantile([1e-9, 1 - 1e-9])
    assert integrate.quad(lambda x: np.exp(prior.log_prob(x)), *ends, limit=200)[0] == pytest.approx(1, abs=1e-6)
    draws = prior.quantile((np.arange(200_000) + 0.5) / 200_000)
    assert draws.mean() == pytest.approx(prior.mean, rel=1e-3, abs=1e-3)
    assert draws.std() == pytest.approx(prior.sd, rel=1e-2)
    assert np.isfinite(prior.log_prob(draws)).all()
    assert (np.diff(draws) > 0).all()
    if reference is not None:
        np.testing.assert_allclose(prior.log_prob(draws[::1000]), reference.logpdf(draws[::1000]), rtol=1e-7, atol=1e-9)
        assert (prior.mean, prior.sd) == pytest.approx((reference.mean(), reference.std()), rel=1e-6)
    for outside in (prior.low - 1e-3, prior.high + 1e-3):
        if np.isfinite(outside):
            assert prior.log_prob(outside) == -INF


@pytest.mark.parametrize(
    ("table", "prior"),
    [
        ({"distribution": "uniform", "low": 0, "high": 1}, Uniform(0.0, 1.0)),
        ({"distribution": "normal", "mean": 1, "sd": 2}, Normal(1.0, 2.0)),
        ({"distribution": "lognormal", "mean": 1, "sd": 2}, LogNormal(1.0, 2.0)),
        ({"distribution": "truncated normal", "mean": 1, "sd": 2, "low": 0}, Normal(1.0, 2.0, low=0.0)),
        ({"distribution": "truncated_normal", "mean": 1, "sd": 2, "high": 4}, Normal(1.0, 2.0, high=4.0)),
    ],
)
def test_tables(table, prior):
    assert read_prior(table) == prior


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({}, "key 'distribution' is missing; choose one of 'uniform'"),
        ({"distribution": 3}, "unknown distribution '3'"),
        ({"distribution": "normal", "mean": 1, "std": 2}, "unknown key 'std' for a normal prior; did you mean 'sd'?"),
        ({"distribution": "normal", "mean": 1, "sd": -2}, "sd is -2; it must be above 0"),
        ({"distribution": "normal", "mean": True, "sd": 2}, "mean is 'True'; it needs a finite number"),
        ({"distribution": "lognormal", "mean": -1, "sd": 2}, "not of its logarithm"),
        ({"distribution": "truncated normal", "mean": 1, "sd": 2}, "needs low or high"),
        ({"distribution": "truncated normal", "mean": 1, "sd": 0.01, "low": 5}, "nothing is left"),
    ],
)
def test_bad_tables(table, message):
    with pytest.raises(ValueError) as error:
        read_prior(table)
    assert message in str(error.value)
