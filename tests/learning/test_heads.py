"""Action distributions against closed forms, quadrature and SciPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import special, stats

from bayessim_jax.chance import draw, normal
from bayessim_jax.contracts import Box, Discrete
from bayessim_jax.learning.heads import Categorical, Gaussian, SquashedGaussian, choose_head
from bayessim_jax.learning.normalisation import Scaling

BOX = Box.create(a=(-2.0, 6.0, "N"), b=(0.0, 1.0, "m"))
P = jnp.array([0.3, -0.4, -0.2, 0.1])


def samples(head, p, count=40_000):
    noise = head.noise(draw(jax.random.key(0), (count, head.chances)))
    return jax.vmap(head.sample, (None, 0))(p, noise)


def test_uniform_numbers_exclude_both_ends_and_become_standard_normal():
    uniform = draw(jax.random.key(0), (1000, 7, 30))
    assert uniform.shape == (1000, 7, 30)
    assert 0 < uniform.min() < uniform.max() < 1
    z = normal(uniform)
    assert jnp.isfinite(z).all()
    np.testing.assert_allclose([z.mean(), z.std(), (z**3).mean()], [0, 1, 0], atol=0.01)


def test_categorical_agrees_with_scipy():
    head, p = Categorical(4), P
    chances = special.softmax(np.asarray(P, float))
    for index in range(4):
        np.testing.assert_allclose(head.log_prob(p, jnp.array([float(index)])), np.log(chances[index]), rtol=1e-5)
    np.testing.assert_allclose(head.entropy(p), stats.entropy(chances), rtol=1e-5)
    frequency = np.bincount(np.asarray(samples(head, p)[:, 0], int), minlength=4) / 40_000
    np.testing.assert_allclose(frequency, chances, atol=0.01)
    assert head.mode(p) == 0


def gaussian():
    """The Gaussian that the outputs P stand for."""
    return stats.multivariate_normal(np.asarray(P[:2], float), np.diag(np.exp(2 * np.asarray(P[2:], float))))


def test_gaussian_agrees_with_scipy():
    head, raw = Gaussian(BOX), samples(Gaussian(BOX), P)
    log_prob = jax.vmap(head.log_prob, (None, 0))(P, raw)
    np.testing.assert_allclose(log_prob, gaussian().logpdf(np.asarray(raw, float)), rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(head.entropy(P), gaussian().entropy(), rtol=1e-6)
    np.testing.assert_allclose(raw.mean(0), P[:2], atol=0.02)
    np.testing.assert_allclose(raw.std(0), jnp.exp(P[2:]), rtol=0.02)


def test_squashed_density_is_the_gaussians_over_the_slope_of_tanh():
    head, raw = SquashedGaussian(BOX), samples(SquashedGaussian(BOX), P)[:500]
    exact = np.asarray(raw, float)
    expected = gaussian().logpdf(exact) - np.log(1 - np.tanh(exact) ** 2).sum(-1)
    np.testing.assert_allclose(jax.vmap(head.log_prob, (None, 0))(P, raw), expected, rtol=1e-4, atol=1e-4)


def test_squashed_density_integrates_to_one():
    head = SquashedGaussian(Box.create(a=(-1.0, 1.0, "")))
    action = jnp.linspace(-1, 1, 20_003)[1:-1]
    density = jnp.exp(jax.vmap(lambda a: head.log_prob(jnp.array([0.5, -0.7]), a[None]))(jnp.arctanh(action)))
    np.testing.assert_allclose(density.sum() * (action[1] - action[0]), 1.0, rtol=1e-3)


def test_squashed_log_prob_stays_finite_far_out():
    head = SquashedGaussian(Box.create(a=(-1.0, 1.0, "")))
    value, slope = jax.value_and_grad(head.log_prob)(jnp.array([30.0, -12.0]), jnp.array([31.0]))
    assert jnp.isfinite(value)
    assert jnp.isfinite(slope).all()


@pytest.mark.parametrize("head", [Gaussian(BOX), SquashedGaussian(BOX)])
def test_actions_fill_the_box_and_never_leave_it(head):
    low, middle, high = (jax.vmap(head.action)(jnp.full((1, 2), x))[0] for x in (-50.0, 0.0, 50.0))
    np.testing.assert_allclose(low, BOX.low)
    np.testing.assert_allclose(middle, (BOX.low + BOX.high) / 2)
    np.testing.assert_allclose(high, BOX.high)


def test_the_head_follows_the_actions():
    assert choose_head(Discrete(3)) == Categorical(3)
    assert isinstance(choose_head(BOX), Gaussian)
    assert choose_head(BOX).outputs == 4


def test_scaling_maps_the_box_to_the_unit_cube_and_leaves_open_axes_alone():
    scaling = Scaling.from_box(Box.create(x=(-2.0, 6.0, "m"), open=(-float("inf"), float("inf"), "m")))
    np.testing.assert_allclose(scaling.normalise(jnp.array([6.0, 3.0])), [1.0, 3.0])
    np.testing.assert_allclose(scaling.normalise(jnp.array([-2.0, -3.0])), [-1.0, -3.0])
    np.testing.assert_allclose(scaling.normalise(jnp.array([1e9, -1e9])), [10.0, -10.0])
