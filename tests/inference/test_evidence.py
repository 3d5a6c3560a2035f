import jax
import jax.numpy as jnp

from bayessim_jax.beliefs import GaussianMixture
from bayessim_jax.inference.evidence import combine_evidence

combine = jax.jit(combine_evidence)


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
    combined = combine(each, jnp.ones(4, bool))
    precision = 1 + (1 / sd**2).sum()
    assert jnp.allclose(combined.means[0], (measured / sd[:, None] ** 2).sum(0) / precision, atol=1e-5)
    assert jnp.allclose(combined.covariance(), jnp.eye(2) / precision, atol=1e-5)


def test_a_recording_that_is_not_used_changes_nothing():
    sd = jnp.array([0.5, 1.0, 2.0, 0.7])
    _, each = _posteriors(jax.random.key(0), jnp.zeros(2), sd)
    some = combine(each, jnp.array([True, True, True, False]))
    fewer = combine(jax.tree.map(lambda leaf: leaf[:3], each), jnp.ones(3, bool))
    assert jnp.allclose(some.means, fewer.means) and jnp.allclose(some.scale_trils, fewer.scale_trils)
