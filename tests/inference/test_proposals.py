import jax
import jax.numpy as jnp
import pytest

from bayessim_jax.beliefs import GaussianMixture, Truncated
from bayessim_jax.contracts import Box
from bayessim_jax.inference.proposals import PROPOSALS, Corrected, Paper, lookup_proposal, pool_weights

WIDE = Box.create(a=(-50.0, 50.0, "m"), b=(-50.0, 50.0, "kg"))


truncated = jax.jit(Truncated.create)
propose = jax.jit(lambda mode, belief: mode.propose(belief))
combine = jax.jit(lambda mode, belief, proposal, q: mode.combine(belief, proposal, q))


def _gaussian(mean, sd):
    return GaussianMixture(jnp.zeros(1), jnp.array([mean]), jnp.diag(jnp.array(sd))[None])


def test_corrected_is_bayes_rule_when_the_network_is_exact():
    belief = truncated(_gaussian([1.0, -2.0], [0.5, 2.0]), WIDE)
    mode = Corrected(widening=3.0)
    proposal = propose(mode, belief)
    p0, mean0 = 1 / (3 * jnp.array([0.5, 2.0])) ** 2, jnp.array([1.0, -2.0])
    precision, measured = jnp.array([4.0, 1.0]), jnp.array([1.4, -1.0])
    q_mean = (p0 * mean0 + precision * measured) / (p0 + precision)
    q = _gaussian(q_mean.tolist(), (1 / jnp.sqrt(p0 + precision)).tolist())
    posterior = combine(mode, belief, proposal, q)
    # the proposal has the moments of the cut belief, which are integrated on points
    assert jnp.allclose(posterior.mixture.mean(), measured, atol=2e-3)
    assert jnp.allclose(posterior.mixture.covariance(), jnp.diag(1 / precision), atol=2e-3)


def test_corrected_keeps_an_axis_that_it_cannot_divide():
    belief = truncated(_gaussian([1.0, -2.0], [0.5, 2.0]), WIDE)
    mode = Corrected(widening=2.0)
    q = _gaussian([1.0, -2.0], [1.5, 1.0])
    posterior = combine(mode, belief, propose(mode, belief), q)
    expected = jnp.diag(jnp.array([1.5**2, 1 / (1 - 1 / 4.0**2)]))
    assert jnp.allclose(posterior.mixture.covariance(), expected, atol=1e-2)


def test_corrected_is_not_led_away_by_a_component_almost_as_wide_as_the_proposal():
    """Its exact quotient lies dozens of standard deviations from all simulations, and there outweighs the rest."""
    belief = truncated(_gaussian([1.0, -2.0], [0.5, 0.5]), WIDE)
    mode = Corrected(widening=2.0)
    q = GaussianMixture(
        jnp.log(jnp.array([0.97, 0.03])),
        jnp.array([[1.1, -2.0], [3.0, -3.0]]),
        jnp.array([0.3, 0.995])[:, None, None] * jnp.eye(2),
    )
    posterior = combine(mode, belief, propose(mode, belief), q)
    assert jnp.abs(posterior.mean() - jnp.array([1.1, -2.0])).max() < 0.3
    assert jnp.abs(posterior.mixture.means - jnp.array([1.0, -2.0])).max() < 3.1


def test_paper_mode_replaces_the_belief():
    belief = truncated(_gaussian([1.0, -2.0], [0.5, 2.0]), WIDE)
    q = _gaussian([0.0, 0.0], [1.0, 1.0])
    assert jnp.allclose(combine(Paper(), belief, propose(Paper(), belief), q).mixture.means, q.means)


@pytest.mark.parametrize("name", sorted(PROPOSALS))
def test_first_proposal_is_the_prior_and_its_type_never_changes(name):
    mode = lookup_proposal(name)
    box = Box.create(a=(0.1, 1.0, "m"), b=(0.1, 1.0, "kg"))
    prior = Truncated.uniform(box, 5)
    first = propose(mode, prior)
    inside = jax.random.uniform(jax.random.key(0), (20, 2), minval=0.1, maxval=1.0)
    assert jnp.allclose(jax.jit(jax.vmap(first.log_prob))(inside), -2 * jnp.log(0.9), atol=1e-4)
    means = 0.5 + 0.01 * jnp.arange(10.0).reshape(5, 2)
    five = GaussianMixture(jnp.zeros(5), means, 0.05 * jnp.eye(2)[None].repeat(5, 0))
    later = propose(mode, truncated(five, box))
    assert jax.tree.structure(first) == jax.tree.structure(later)
    assert [a.shape for a in jax.tree.leaves(first)] == [a.shape for a in jax.tree.leaves(later)]
    posterior = combine(mode, prior, first, five)
    assert jnp.allclose(posterior.mixture.means, five.means, atol=1e-5)


def test_pool_weights_turn_pooled_draws_into_draws_of_the_target():
    box = Box.create(a=(-20.0, 20.0, "m"))
    wide = truncated(GaussianMixture(jnp.zeros(1), jnp.zeros((1, 1)), 2 * jnp.ones((1, 1, 1))), box)
    target = truncated(GaussianMixture(jnp.zeros(1), jnp.ones((1, 1)), 0.7 * jnp.ones((1, 1, 1))), box)
    both = jax.tree.map(lambda a, b: jnp.stack([a, b, b]), wide, target)
    keys = jax.random.split(jax.random.key(0), (2, 4000))
    sample = jax.jit(lambda belief, keys: jax.vmap(belief.sample)(keys))
    thetas = jnp.stack([sample(wide, keys[0]), sample(target, keys[1]), jnp.full((4000, 1), 9.0)])
    w = jax.jit(pool_weights)(thetas, both, jnp.array([True, True, False]), target)
    assert w.max() <= 1.0 and (w[2] == 0).all()
    mean = (w[..., None] * thetas).sum((0, 1)) / w.sum()
    sd = jnp.sqrt((w[..., None] * (thetas - mean) ** 2).sum((0, 1)) / w.sum())
    assert abs(float(mean[0]) - 1.0) < 0.05 and abs(float(sd[0]) - 0.7) < 0.05


def test_unknown_proposal_names_the_near_miss():
    with pytest.raises(ValueError, match="did you mean 'truncated'"):
        lookup_proposal("truncate")
