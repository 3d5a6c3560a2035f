"""The truncated belief: normalized, moments and draws of one law, no atoms on the bounds."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import truncnorm

from bayessim_jax.beliefs import GaussianMixture, Truncated
from bayessim_jax.contracts import Box

PLANE = Box.create(length=(0.1, 1.0, "m"), mass=(-2.0, 3.0, "kg"))
LINE = Box.create(length=(0.1, 1.0, "m"))
SHARE = 0.2


def mixture(box, means, scales, correlation=0.8):
    """Components at the given places and scales in units of the box's width."""
    d, width = box.size, np.asarray(box.width)
    pattern = np.eye(d) if d == 1 else np.array([[1.0, 0.0], [correlation, (1 - correlation**2) ** 0.5]])
    leaves = (
        np.linspace(0.0, 1.0, len(scales)),
        np.asarray(box.low) + np.reshape(means, (-1, d)) * width,
        np.asarray(scales)[:, None, None] * pattern * width[:, None],
    )
    return GaussianMixture(*(jnp.asarray(x, jnp.float32) for x in leaves))


CASES = {
    "inside": (PLANE, [(0.4, 0.5), (0.6, 0.3), (0.5, 0.5)], [0.05, 0.1, 0.2]),
    "cut": (PLANE, [(0.0, 0.9), (1.1, 0.3), (0.5, 0.5)], [0.1, 0.3, 2.0]),
    "outside": (PLANE, [(-0.5, 0.5), (1.4, 1.6), (0.5, -3.0)], [0.2, 0.3, 0.5]),
    "far outside": (PLANE, [(-2.0, 0.5), (-2.2, 0.7), (-1.9, 0.2)], [0.2, 0.2, 0.2]),
    "line": (LINE, [0.3, 1.2, -0.5], [0.1, 0.2, 0.2]),
}
FINE = 600
many_log_probs = jax.jit(jax.vmap(lambda b, t: b.log_prob(t), (None, 0)))
sample = jax.jit(jax.vmap(lambda b, k: b.sample(k), (None, 0)))
moments = jax.jit(lambda b: (b.mean(), b.covariance()))
many_marginals = jax.jit(lambda b, grid, axis: b.marginal_log_prob((axis,), grid[:, None]), static_argnames="axis")
create = jax.jit(Truncated.create)


def log_prob(belief, theta):
    """Log density at any number of points, always in batches of one shape."""
    return many_log_probs(belief, np.resize(theta, (FINE**belief.box.size, belief.box.size)))[: len(theta)]


def marginal(belief, grid, axis):
    """Marginal log density on any grid, always in batches of one shape."""
    return many_marginals(belief, np.resize(grid, FINE), axis=axis)[: len(grid)]


def cells(box, n):
    """Midpoints of an even grid over the box, and the volume of a cell."""
    axes = [np.linspace(lo, hi, 2 * n + 1)[1::2] for lo, hi in zip(box.low, box.high, strict=True)]
    points = np.stack([a.ravel() for a in np.meshgrid(*axes, indexing="ij")], -1)
    return points.astype(np.float32), float(np.prod(box.width)) / len(points)


@pytest.fixture(params=CASES, scope="module")
def belief(request):
    box, means, scales = CASES[request.param]
    return create(mixture(box, means, scales), box, SHARE if request.param != "far outside" else 0.0)


@pytest.fixture(scope="module")
def quadrature(belief):
    points, volume = cells(belief.box, FINE)
    weights = np.exp(np.asarray(log_prob(belief, points), float)) * volume
    return np.asarray(points, float), weights


def test_density_integrates_to_one(quadrature):
    assert abs(quadrature[1].sum() - 1) < 2e-3


def test_moments_agree_with_quadrature(belief, quadrature):
    points, weights = quadrature
    mean, covariance = moments(belief)
    expected = weights @ points / weights.sum()
    gap = points - expected
    spread = np.einsum("n,ni,nj->ij", weights, gap, gap) / weights.sum()
    deviation = np.sqrt(np.diag(spread))
    np.testing.assert_allclose((mean - expected) / deviation, 0.0, atol=0.01)
    # weights of the points differ most where all mass hangs on one corner of the box
    np.testing.assert_allclose((covariance - spread) / np.outer(deviation, deviation), 0.0, atol=0.05)
    np.testing.assert_allclose(np.diag(covariance)[0], spread[0, 0], rtol=0.02)


def test_draws_follow_the_density(belief, quadrature):
    points, weights = quadrature
    draws = np.asarray(sample(belief, jax.random.split(jax.random.key(1), 50_000)))
    for axis in range(belief.box.size):
        edges = np.linspace(belief.box.low[axis], belief.box.high[axis], 11)
        got = np.histogram(draws[:, axis], edges)[0] / len(draws)
        expected = np.histogram(points[:, axis], edges, weights=weights)[0]
        np.testing.assert_allclose(got, expected, atol=0.01)
    _, covariance = moments(belief)
    if belief.box.size == 2:
        correlation = covariance[0, 1] / np.sqrt(covariance[0, 0] * covariance[1, 1])
        assert abs(np.corrcoef(draws.T)[0, 1] - correlation) < 0.03


def test_draws_stay_inside_and_hold_no_atoms(belief):
    draws = np.asarray(sample(belief, jax.random.split(jax.random.key(2), 50_000)))
    assert (draws > belief.box.low).all() and (draws < belief.box.high).all()
    for axis in range(belief.box.size):
        assert np.unique(draws[:, axis], return_counts=True)[1].max() < 50


def test_marginal_agrees_with_quadrature(belief, quadrature):
    points, weights = quadrature
    for axis in range(belief.box.size):
        grid, index = np.unique(points[:, axis], return_inverse=True)
        cell = float(belief.box.width[axis]) / len(grid)
        expected = np.bincount(index.ravel(), weights) / cell
        got = np.exp(marginal(belief, jnp.asarray(grid, jnp.float32), axis=axis))
        np.testing.assert_allclose(got, expected, rtol=0.02, atol=2e-3 * expected.max())


def test_marginal_of_two_axes_is_the_density_with_the_third_integrated_out():
    box = Box.create(a=(0.0, 1.0, "m"), b=(-1.0, 1.0, "m"), c=(0.0, 2.0, "m"))
    tril = jnp.array([[0.3, 0.0, 0.0], [-0.2, 0.4, 0.0], [0.3, 0.3, 0.5]])
    means = jnp.array([[0.2, 0.1, 1.9], [0.7, -0.9, 0.4]])
    cut = create(GaussianMixture(jnp.array([0.0, 0.7]), means, jnp.stack([tril, 0.5 * tril])), box, SHARE)
    at = jax.random.uniform(jax.random.key(0), (20, 2))  # c first, then b
    c, b = 2 * at[:, 0], 2 * at[:, 1] - 1
    a = (jnp.arange(400) + 0.5) / 400
    whole = jnp.stack([jnp.broadcast_to(x, (20, 400)) for x in (a, b[:, None], c[:, None])], -1)
    expected = jnp.exp(many_log_probs(cut, whole.reshape(-1, 3))).reshape(20, 400).mean(1)
    got = jnp.exp(cut.marginal_log_prob((2, 1), jnp.stack([c, b], -1)))
    np.testing.assert_allclose(got, expected, rtol=0.01)


def test_one_axis_is_scipys_truncated_normal():
    mean, scale = 1.3, 0.2
    belief = create(GaussianMixture(jnp.zeros(3), jnp.full((3, 1), mean), jnp.full((3, 1, 1), scale)), LINE, 0.0)
    law = truncnorm((0.1 - mean) / scale, (1.0 - mean) / scale, mean, scale)
    grid = np.linspace(0.11, 0.99, 20, dtype=np.float32)
    np.testing.assert_allclose(log_prob(belief, grid[:, None]), law.logpdf(grid.astype(float)), atol=1e-4)
    mean_got, variance = moments(belief)
    np.testing.assert_allclose(mean_got[0], law.mean(), atol=1e-3)
    np.testing.assert_allclose(variance[0, 0], law.var(), rtol=1e-2)


def test_no_density_outside():
    belief = create(mixture(*CASES["cut"]), PLANE, SHARE)
    outside = np.array([[0.05, 0.0], [0.5, 3.01], [2.0, -5.0]])
    assert (log_prob(belief, outside) == -jnp.inf).all()
    assert (marginal(belief, np.array([0.0, 1.2]), axis=0) == -jnp.inf).all()


def test_uniform_is_the_prior():
    prior = Truncated.uniform(PLANE, 3)
    points, _ = cells(PLANE, 5)
    np.testing.assert_allclose(log_prob(prior, points), -np.log(0.9 * 5.0), rtol=1e-6)
    mean, covariance = moments(prior)
    np.testing.assert_allclose(mean, [0.55, 0.5], rtol=1e-5)
    np.testing.assert_allclose(covariance, np.diag([0.9**2 / 12, 25 / 12]), rtol=1e-5)


def test_prior_and_posterior_are_one_carry():
    prior = Truncated.uniform(PLANE, 3)
    posterior = create(mixture(*CASES["cut"]), PLANE, 0.1)
    assert jax.tree.structure(prior) == jax.tree.structure(posterior)
    types = [jax.tree.map(lambda x: (x.shape, x.dtype, x.weak_type), b) for b in (prior, posterior)]
    assert jax.tree.leaves(types[0]) == jax.tree.leaves(types[1])


@pytest.mark.parametrize("fault", ["nan mean", "infinite distance"])
def test_an_unusable_mixture_gives_the_prior_and_says_so(fault):
    bad = mixture(*CASES["inside"])
    bad = bad.replace(means=jnp.full_like(bad.means, jnp.nan if fault == "nan mean" else 1e30))
    belief = create(bad, PLANE, 0.0)
    assert belief.prior_share == 1.0
    np.testing.assert_allclose(log_prob(belief, np.array([[0.5, 0.5]])), -np.log(4.5), rtol=1e-6)


def test_log_prob_has_finite_derivatives():
    belief = create(mixture(*CASES["far outside"]), PLANE, 0.0)
    grads = jax.jit(jax.grad(lambda b, t: b.log_prob(t), (0, 1)))(belief, jnp.array([0.5, 0.5]))
    assert all(jnp.isfinite(g).all() for g in jax.tree.leaves(grads))


@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_a_mixed_belief_is_both_by_their_shares(share):
    box = PLANE
    near = mixture(box, [(0.2, 0.8), (0.21, 0.79)], [0.05, 0.05])
    beyond = mixture(box, [(1.3, 0.2), (1.32, 0.21)], [0.1, 0.1])
    points = box.low + jnp.array([[0.2, 0.8], [0.22, 0.78], [0.98, 0.02], [0.99, 0.05]]) * box.width

    @jax.jit
    def compare(share):
        one, other = Truncated.create(near, box), Truncated.create(beyond, box)
        mixed = one.mix(other, share)
        exact = [jax.vmap(belief.log_prob)(points) for belief in (one, other)]
        again = Truncated.create(mixed.mixture, box)
        return jax.vmap(mixed.log_prob)(points), exact, (one.mean(), other.mean(), mixed.mean()), again, mixed

    mixed, exact, means, again, whole = compare(share)
    expected = (1 - share) * np.exp(exact[0]) + share * np.exp(exact[1])
    np.testing.assert_allclose(np.exp(mixed), expected, rtol=0.1, atol=0.02)
    np.testing.assert_allclose(means[2], (1 - share) * means[0] + share * means[1], atol=1e-5)
    np.testing.assert_allclose(whole.log_mass(), again.log_mass(), atol=1e-3)
    np.testing.assert_allclose(whole.mean(), again.mean(), atol=0.02)
    np.testing.assert_allclose(whole.covariance(), again.covariance(), atol=0.02)


def test_a_belief_mixed_with_the_prior_is_loosened():
    belief = Truncated.create(mixture(PLANE, [(0.4, 0.5), (0.6, 0.3)], [0.05, 0.1]), PLANE)
    mixed, loose = belief.mix(Truncated.uniform(PLANE, 2), 0.25), belief.loosen(0.25)
    points = PLANE.low + jnp.array([[0.4, 0.5], [0.9, 0.9]]) * PLANE.width
    np.testing.assert_allclose(many_log_probs(mixed, points), many_log_probs(loose, points), atol=1e-3)
    np.testing.assert_allclose(mixed.covariance(), loose.covariance(), rtol=1e-5)
