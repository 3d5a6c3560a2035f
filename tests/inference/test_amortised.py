"""Networks trained on simulated sets of windows, on a simulator whose posterior has a closed form."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayessim_jax.beliefs.margins import Margins, normal
from bayessim_jax.inference import amortised as networks
from bayessim_jax.inference.encoders import Lstm, Windowed
from bayessim_jax.inference.shooting import Shots, solve

WINDOWS, ROWS, SIGMA, SPREAD = 6, 11, 0.1, 0.05
MARGINS = Margins.create(["a", "b"], [normal(0, 1), normal(0, 1)])


@pytest.fixture(autouse=True)
def in_double_precision():
    jax.config.update("jax_enable_x64", True)
    yield
    jax.config.update("jax_enable_x64", False)


def pushed(z, delta, window):
    """y_t = x₀ + δ + z₀ t + z₁ ∫ u: linear in everything, so that the solver's precision is exact."""
    start, ctrl = window
    moved = jnp.concatenate([jnp.zeros(1), jnp.cumsum(ctrl[:, 0])]) / ROWS
    return (start + delta[0] + z[0] * jnp.linspace(0.0, 1.0, ROWS) + z[1] * moved)[:, None]


def made(truth, seed=0):
    rng = np.random.default_rng(seed)
    starts, ctrl = rng.normal(size=WINDOWS), rng.normal(size=(WINDOWS, ROWS - 1, 1))
    inputs = jnp.asarray(starts), jnp.asarray(ctrl)
    delta = jnp.asarray(SPREAD * rng.normal(size=(WINDOWS, 1)))
    y = jax.vmap(pushed, in_axes=(None, 0, 0))(jnp.asarray(truth), delta, inputs)
    y = y + SIGMA * rng.normal(size=y.shape)
    measured = jnp.asarray(rng.uniform(size=y.shape) > 0.1)
    return Shots(inputs, y, measured, jnp.array([SPREAD]))


def solved(shots):
    start, sigma = jnp.zeros((WINDOWS, 1)), jnp.array([SIGMA])
    return solve(pushed, shots, jnp.zeros(2), start, sigma, jnp.ones(2, bool))


def amortised(shots, seed=0, **options):
    return networks.sample_amortised(
        jax.random.key(seed), pushed, shots, MARGINS, solved(shots), shots.inputs[1], **options
    )


@pytest.mark.slow
def test_a_linear_simulator_has_the_posterior_that_algebra_gives():
    """Mean within 0.5 standard deviations, standard deviations from 0.8 to 1.5 times, correlation within 0.2."""
    shots = made([0.7, -1.1])
    fit, found = solved(shots), amortised(shots)
    exact = np.linalg.inv(np.asarray(fit.precision))
    sd, seen = np.sqrt(np.diag(exact)), np.cov(np.asarray(found.z), rowvar=False)
    assert sd.max() < 0.2, "the prior says little"
    assert (np.abs(np.asarray(found.z).mean(0) - np.asarray(fit.z)) < 0.5 * sd).all()
    ratio = np.sqrt(np.diag(seen)) / sd
    assert ratio.min() > 0.8 and ratio.max() < 1.5, ratio
    correlation = lambda c: c[0, 1] / np.sqrt(c[0, 0] * c[1, 1])  # noqa: E731
    assert correlation(seen) == pytest.approx(correlation(exact), abs=0.2)
    assert found.doubts == () and found.coverage is not None
    assert found.coverage.half == pytest.approx(0.5, abs=0.15)
    np.testing.assert_allclose(found.draws, found.z, atol=1e-6)


@pytest.mark.slow
def test_the_same_seed_gives_the_same_draws_and_another_does_not(monkeypatch):
    monkeypatch.setattr(networks, "ROUNDS", 1)
    monkeypatch.setattr(networks, "SCHEDULE", networks.SCHEDULE.replace(epochs=2))
    shots = made([0.2, 0.4], seed=1)
    first, again, other = (np.asarray(amortised(shots, seed, draws=100).draws) for seed in (3, 3, 4))
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other)


@pytest.mark.slow
def test_what_no_simulation_shows_is_doubted(monkeypatch):
    """A wave in the middle of every window that neither parameter nor noise explains."""
    monkeypatch.setattr(networks, "ROUNDS", 1)
    monkeypatch.setattr(networks, "SCHEDULE", networks.SCHEDULE.replace(epochs=2))
    shots = made([0.7, -1.1])
    wave = 10 * SIGMA * jnp.sin(jnp.linspace(0.0, 2 * jnp.pi, ROWS))[:, None]
    odd = amortised(dataclasses.replace(shots, y=shots.y + wave), draws=100)
    assert any("lies where no simulation does" in doubt for doubt in odd.doubts)


def test_simulations_that_diverge_everywhere_are_refused():
    shots = made([0.0, 0.0])
    fit = solved(shots)

    def broken(z, delta, window):
        return pushed(z, delta, window) + jnp.where(z[0] > -5.0, jnp.nan, 0.0)

    with pytest.raises(ValueError, match="not finite; narrow the priors"):
        networks.sample_amortised(jax.random.key(0), broken, shots, MARGINS, fit, shots.inputs[1])


def test_windows_are_read_alike_in_any_order_and_those_without_rows_count_for_nothing():
    encoder = Windowed(Lstm(size=5), windows=3)
    x = jax.random.normal(jax.random.key(0), (2, 3, 4, 6))
    valid = jnp.ones((2, 3, 4), bool).at[:, 2].set(False)
    params = encoder.init(jax.random.key(1), 6)

    def embed(x, valid):
        return encoder.apply(params, x.reshape(2, -1, 6), valid.reshape(2, -1))

    order = jnp.array([2, 0, 1])
    whole = embed(x, valid)
    np.testing.assert_allclose(whole, embed(x[:, order], valid[:, order]), atol=1e-12)
    fewer = Windowed(Lstm(size=5), windows=2)
    alone = fewer.apply(params, x[:, :2].reshape(2, -1, 6), valid[:, :2].reshape(2, -1))
    np.testing.assert_allclose(whole, alone, atol=1e-12)
    np.testing.assert_allclose(whole[:, 5:], x[:, :2].mean((1, 2)), atol=1e-12)
