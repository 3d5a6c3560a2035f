"""Priors as maps from a standard normal variable, against those that case files are read with."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayessim_jax.beliefs.margins import Margins, log_normal, log_uniform, normal, uniform
from bayessim_jax.recordings import priors
from bayessim_jax.recordings.shots import margin_of

PRIORS = [
    priors.Uniform(0.15, 0.6),
    priors.Normal(1.0, 0.2),
    priors.Normal(0.3, 0.2, low=0.1),
    priors.Normal(0.0, 1.0, low=-0.5, high=2.0),
    priors.LogNormal(0.5, 0.3),
]


@pytest.mark.parametrize("prior", PRIORS, ids=str)
def test_a_margin_is_the_prior_that_it_was_made_of(prior):
    with jax.enable_x64(True):
        margins = Margins.create(["a"], [margin_of(prior)])
        shares = np.linspace(0.01, 0.99, 21)
        values = np.asarray(prior.quantile(shares))
        z = jax.vmap(margins.standard)(jnp.asarray(values)[:, None])
        np.testing.assert_allclose(jax.scipy.special.ndtr(z[:, 0]), shares, rtol=1e-6)
        np.testing.assert_allclose(jax.vmap(margins.theta)(z)[:, 0], values, rtol=1e-8)
        found = jax.vmap(margins.log_prob)(jnp.asarray(values)[:, None])
        np.testing.assert_allclose(found, prior.log_prob(values), rtol=1e-6)


def test_margins_join_and_sample():
    both = Margins.create(["a"], [uniform(0, 2)], ["m"]) + Margins.create(["b"], [log_uniform(0.1, 10)], ["s"])
    assert both.names == ("a", "b") and both.units == ("m", "s")
    draws = jax.vmap(both.sample)(jax.random.split(jax.random.key(0), 4000))
    assert abs(float(draws[:, 0].mean()) - 1.0) < 0.05
    assert abs(float(jnp.log10(draws[:, 1]).mean())) < 0.05
    assert float(jnp.isfinite(jax.vmap(both.log_prob)(draws)).mean()) == 1.0


def test_values_outside_of_the_support_go_to_its_edge():
    margins = Margins.create(["a", "b"], [uniform(0, 1), normal(0, 1, low=0)])
    z = margins.standard(jnp.array([2.0, -1.0]))
    assert bool(jnp.isfinite(z).all())
    np.testing.assert_allclose(margins.theta(z), [1.0, 0.0], atol=1e-5)
    assert log_normal(0.0, 1.0).value(jnp.array(0.0)) == 1.0


def test_values_of_many_margins_are_those_of_each():
    each = [uniform(-1.0, 2.0), log_uniform(0.1, 9.0), normal(1.0, 0.2), uniform(0.0, 0.5), log_normal(0.3, 0.4)]
    z = np.array([0.3, -1.2, 0.7, 2.0, -0.4])
    with jax.enable_x64(True):
        for some in (each, each[:1], [each[0], each[3]], [*each[:4], normal(1.0, 0.2, low=0.9)]):
            margins = Margins.create([str(k) for k in range(len(some))], some)
            asked = np.array([m.value(x) for m, x in zip(some, z, strict=False)])
            np.testing.assert_allclose(margins.theta(jnp.asarray(z[: len(some)])), asked, rtol=1e-12)
            found = margins.theta(z[: len(some)])
            assert isinstance(found, np.ndarray)
            np.testing.assert_allclose(found, asked, rtol=1e-12)
