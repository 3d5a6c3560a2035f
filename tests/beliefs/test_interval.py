"""The standard normal on an interval, against float64 formulas that do not share its regimes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import integrate, special

from bayessim_jax.beliefs.interval import log_mass, quantile

INTERVALS = [
    (-1.0, 0.5),
    (-40.0, 40.0),
    (2.0, 9.0),
    (-0.004, 0.003),
    (5.0, 5.01),
    (30.0, 31.0),
    (-31.0, -30.0),
    (10.05, 12.0),
    (-12.0, -9.95),
    (200.0, 200.001),
    (-300.0, -200.0),
    (-3.0, -2.985),
]
masses = jax.jit(jax.vmap(log_mass))
quantiles = jax.jit(jax.vmap(jax.vmap(quantile, (0, None, None)), (None, 0, 0)))


def exact_log_mass(low, high):
    """By quadrature of the density scaled to its largest value on the interval."""
    top = min(abs(low), abs(high)) if low * high > 0 else 0.0
    near, far = (top, min(max(abs(low), abs(high)), top + 40)) if low * high > 0 else (max(low, -40), min(high, 40))
    points = None if low * high > 0 else [0.0]
    value, _ = integrate.quad(lambda z: np.exp(-0.5 * (z - top) * (z + top)), near, far, points=points, epsabs=0)
    return np.log(value) - 0.5 * top**2 - 0.5 * np.log(2 * np.pi)


@pytest.fixture(scope="module")
def single():
    low, high = (np.array(x, np.float32) for x in zip(*INTERVALS, strict=True))
    return low, high, low.astype(float), high.astype(float)


def test_log_mass_keeps_its_digits_in_every_regime(single):
    low, high, low64, high64 = single
    exact = np.array([exact_log_mass(a, b) for a, b in zip(low64, high64, strict=True)])
    np.testing.assert_allclose(masses(low, high), exact, rtol=3e-7, atol=1e-4)


def test_mass_is_symmetric_and_additive():
    low, mid, high = (jnp.array(x) for x in zip((-2.0, -1.0, 3.0), (8.0, 9.5, 11.0), (-0.5, 0.1, 0.3), strict=True))
    np.testing.assert_allclose(masses(low, high), masses(-high, -low), rtol=1e-6)
    np.testing.assert_allclose(jnp.logaddexp(masses(low, mid), masses(mid, high)), masses(low, high), atol=2e-5)


def test_quantile_inverts_the_distribution_function(single):
    low, high, low64, high64 = single
    u = np.array([1e-3, 0.1, 0.5, 0.9, 0.999], np.float32)
    _, fraction = quantiles(u, low, high)
    for k, (a, b) in enumerate(zip(low64, high64, strict=True)):
        nearest = min(abs(a), abs(b)) if a * b > 0 else 0.0
        reach = min(b - a, 1.0, 1 / max(nearest, 1e-9)) / (b - a)  # the share of the interval that holds the mass
        for f, wanted in zip(np.asarray(fraction[k], float), u, strict=True):
            share = np.exp(exact_log_mass(a, a + f * (b - a)) - exact_log_mass(a, b))
            assert abs(share - wanted) < 2e-4 + 1e-7 / reach, (a, b, wanted)


def test_quantile_stays_inside_and_increases(single):
    low, high, *_ = single
    u = jnp.linspace(1e-6, 1 - 1e-6, 200)
    z, fraction = quantiles(u, low, high)
    assert (z >= low[:, None]).all() and (z <= high[:, None]).all()
    assert (fraction >= 0).all() and (fraction <= 1).all()
    assert (jnp.diff(fraction, axis=1) >= -2e-7).all()


def test_derivatives_agree_with_the_density():
    low, high, u = jnp.array(-0.7), jnp.array(1.9), jnp.array(0.3)
    pdf, cdf = lambda z: np.exp(-0.5 * z**2) / np.sqrt(2 * np.pi), special.ndtr
    d_low, d_high = jax.jit(jax.grad(log_mass, (0, 1)))(low, high)
    mass = cdf(1.9) - cdf(-0.7)
    np.testing.assert_allclose((d_low, d_high), (-pdf(-0.7) / mass, pdf(1.9) / mass), rtol=1e-5)
    z = special.ndtri(cdf(-0.7) + 0.3 * mass)
    expected = (mass / pdf(z), 0.7 * pdf(-0.7) / pdf(z), 0.3 * pdf(1.9) / pdf(z))
    got = jax.jit(jax.grad(lambda *x: quantile(*x)[0], (0, 1, 2)))(u, low, high)
    np.testing.assert_allclose(got, expected, rtol=1e-5)


def test_derivatives_are_finite_in_every_regime(single):
    low, high, *_ = single
    grads = jax.jit(jax.vmap(jax.grad(lambda a, b: log_mass(a, b) + quantile(0.3, a, b)[0], (0, 1))))(low, high)
    assert all(jnp.isfinite(g).all() for g in grads)
