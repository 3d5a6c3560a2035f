"""How θ enters: sigma points against exact means, risks against their definitions, and nothing compiled anew."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayessim_jax.beliefs import GaussianMixture, Particles, Truncated, Uniform
from bayessim_jax.contracts import Box, Learner, Policy
from bayessim_jax.control import USES, ConditionalValueAtRisk, Disco, Mean, Planner, WorstCase, sigma_points
from bayessim_jax.control.unscented import components
from bayessim_jax.systems import from_functions
from bayessim_jax.systems.functional import FunctionalSystem
from bayessim_jax.systems.pendulum import Pendulum, Upswing

LINEAR = jnp.array([[0.9, 0.2], [-0.1, 0.8]])
PUSH = jnp.array([[0.3, 0.0, -0.2], [0.1, 0.4, 0.0]])


class Quadratic:
    """Cost xᵀ x."""

    steps = 10

    def reward(self, state, action, next_state):
        return -(next_state**2).sum()

    def terminated(self, state):
        return jnp.zeros((), bool)


def linear_system(d):
    """x' = A x + B θ + u, x seen."""
    system = from_functions(
        parameters=Box.create(**{f"b{i}": (-9.0, 9.0, "") for i in range(d)}),
        observations=Box.create(x=(-5.0, 5.0, ""), y=(-5.0, 5.0, "")),
        actions=Box.create(u=(-1.0, 1.0, ""), w=(-1.0, 1.0, "")),
        noise=0.0,
        dt=0.1,
        reset=lambda key, theta: jax.random.normal(key, (2,)),
        step=lambda theta, x, u: LINEAR @ x + PUSH[:, :d] @ theta + u,
    )
    return Restarts(**{f: getattr(system, f) for f in system.__dataclass_fields__})


class Restarts(FunctionalSystem):
    """A functional system whose state is seen."""

    def restart(self, theta, observation):
        return observation


def mixture(d, k=2, seed=0):
    keys = jax.random.split(jax.random.key(seed), 3)
    trils = jnp.tril(0.4 * jax.random.normal(keys[0], (k, d, d))) + 0.5 * jnp.eye(d)
    return GaussianMixture(jax.random.normal(keys[1], (k,)), jax.random.normal(keys[2], (k, d)), trils)


@pytest.mark.parametrize("d", [1, 2, 3, 5])
def test_sigma_points_have_the_moments_and_no_negative_weight(d):
    belief = mixture(d, 3)
    points, weights = sigma_points(belief)
    assert points.shape == (3 * (2 * d + (d < 3)), d)
    assert weights.min() >= 0
    np.testing.assert_allclose(weights.sum(), 1.0, rtol=1e-5)
    np.testing.assert_allclose(weights @ points, belief.mean(), atol=1e-5)
    gap = points - belief.mean()
    np.testing.assert_allclose((gap.T * weights) @ gap, belief.covariance(), atol=1e-4)


@pytest.mark.parametrize("d", [1, 2])
def test_sigma_points_are_exact_to_the_fourth_degree_along_an_axis(d):
    belief = GaussianMixture(jnp.zeros(1), jnp.zeros((1, d)), 0.7 * jnp.eye(d)[None])
    points, weights = sigma_points(belief)
    np.testing.assert_allclose(weights @ points**4, 3 * 0.7**4, rtol=1e-5)


@pytest.mark.parametrize("d", [1, 2, 3])
def test_the_mean_cost_of_linear_gaussian_dynamics_is_exact(d):
    """x_t is linear in θ: E xᵀx = |E x|² + tr Cov x, with Cov x from the sums of powers of A."""
    system, belief = linear_system(d), mixture(d)
    disco = Disco.create(system, Quadratic(), "unscented", components=2, horizon=6, samples=7)
    start = jnp.array([0.5, -1.0])
    _, _, info = jax.jit(disco.act)(jax.random.key(1), disco.init(), start, belief)
    total = np.zeros(7)
    mean, gain = jnp.broadcast_to(start[:, None], (2, 7)), jnp.zeros((2, d))
    for u in info.actions:
        gain = LINEAR @ gain + PUSH[:, :d]
        mean = LINEAR @ mean + (PUSH[:, :d] @ belief.mean())[:, None] + u
        total += np.asarray((mean**2).sum(0) + jnp.trace(gain @ belief.covariance() @ gain.T))
    np.testing.assert_allclose(info.costs, total, rtol=1e-4)


def test_components_of_a_cut_belief_are_those_of_its_draws():
    box = Box.create(a=(0.0, 1.0, ""), b=(0.0, 2.0, ""))
    cut = Truncated.create(
        GaussianMixture(jnp.zeros(1), jnp.array([[0.9, 0.2]]), jnp.array([[[0.3, 0.0], [0.1, 0.5]]])), box
    )
    draws = jax.jit(jax.vmap(cut.sample))(jax.random.split(jax.random.key(0), 20_000))
    found = jax.jit(components)(cut)
    np.testing.assert_allclose(found.mean(), draws.mean(0), atol=0.01)
    np.testing.assert_allclose(found.covariance(), np.cov(np.asarray(draws).T), atol=0.01)
    for flat in (Truncated.uniform(box, 3), Uniform(box)):
        found = jax.jit(components)(flat)
        np.testing.assert_allclose(found.mean(), [0.5, 1.0], atol=1e-4)
        np.testing.assert_allclose(found.covariance(), np.diag([1 / 12, 4 / 12]), atol=1e-3)


def test_risks_are_what_their_names_say():
    rng = np.random.default_rng(0)
    costs, weights = jnp.asarray(rng.exponential(size=(5, 4))), jnp.array([0.4, 0.1, 0.2, 0.3, 0.0])
    mean, worst = Mean()(costs, weights), WorstCase()(costs, weights)
    np.testing.assert_allclose(mean, weights @ costs, rtol=1e-6)
    np.testing.assert_allclose(worst, costs[:4].max(0), rtol=1e-6)
    np.testing.assert_allclose(ConditionalValueAtRisk(1.0)(costs, weights), mean, rtol=1e-5)
    np.testing.assert_allclose(ConditionalValueAtRisk(0.05)(costs, weights), worst, rtol=1e-5)
    half = [max(c @ q for q in extreme(np.asarray(weights), 0.5)) for c in np.asarray(costs).T]
    np.testing.assert_allclose(ConditionalValueAtRisk(0.5)(costs, weights), half, rtol=1e-5)


def extreme(p, tail):
    """The vertices of {q ≤ p/tail, Σ q = 1}, over which CVaR is the greatest expectation."""

    for order in itertools.permutations(range(len(p))):
        q, left = np.zeros(len(p)), 1.0
        for i in order:
            q[i] = min(p[i] / tail, left)
            left -= q[i]
        yield q


@pytest.mark.parametrize("risk", ["mean", "cvar", "worst"])
@pytest.mark.parametrize("use", ["particles", "unscented"])
def test_costs_that_are_not_negative_stay_so(use, risk):
    disco = Disco.create(Pendulum.create(), Upswing(), use, risk=risk, samples=50)
    belief = Truncated.uniform(disco.system.parameters, 5)
    _, _, info = jax.jit(disco.act)(jax.random.key(0), disco.init(), jnp.array([-1.0, 0.0, 0.5]), belief)
    assert info.costs.min() >= 0
    assert info.costs.max() < 1e30


@pytest.mark.parametrize("use", USES)
def test_a_new_belief_is_planned_with_and_recompiles_nothing(use):
    system = Pendulum.create()
    planner = Planner.create(system, Upswing(), use=use, samples=64, particles=4)
    assert isinstance(planner, Learner)
    traces = []

    @jax.jit
    def act(state, key):
        traces.append(None)
        policy = planner.policy(state, True)
        assert isinstance(policy, Policy)
        return policy.act(key, policy.init(), jnp.array([-1.0, 0.1, 0.0]))

    start = planner.init(jax.random.key(0))
    belief = Truncated.create(
        GaussianMixture(jnp.zeros(3), jnp.full((3, 2), 0.2), 0.01 * jnp.broadcast_to(jnp.eye(2), (3, 2, 2))),
        system.parameters,
    )
    after, info = planner.step(jax.random.key(1), start, belief)
    shapes = lambda tree: jax.tree.map(lambda x: (x.shape, x.dtype, x.weak_type), tree)  # noqa: E731
    assert shapes(start) == shapes(after)
    assert info.nonfinite == 0
    first, second = act(start, jax.random.key(2)), act(after, jax.random.key(2))
    assert len(traces) == 1
    assert not jnp.array_equal(first[0], second[0])
    assert jnp.isfinite(second[1].actions).all()
    np.testing.assert_allclose(after.weights @ after.positions, belief.mean(), atol=5e-3)


def test_jitter_disturbs_recorded_actions_and_not_judged_ones():
    planner = Planner.create(Pendulum.create(), Upswing(), use="particles", samples=16, jitter=0.3)
    state, look, key = planner.init(jax.random.key(0)), jnp.array([1.0, 0.0, 0.0]), jax.random.key(1)
    judged, recorded = (p.act(key, p.init(), look) for p in (planner.policy(state, True), planner.policy(state)))
    assert not jnp.array_equal(judged[0], recorded[0])
    np.testing.assert_array_equal(judged[1].actions, recorded[1].actions)


def test_slips_are_told_at_once():
    with pytest.raises(ValueError, match="unknown use of θ 'uncented': did you mean 'unscented'"):
        Disco.create(Pendulum.create(), Upswing(), "uncented")
    with pytest.raises(ValueError, match="has no risk over θ"):
        Disco.create(Pendulum.create(), Upswing(), "mean", risk="worst")
    system = linear_system(1)
    plain = FunctionalSystem(**{f: getattr(system, f) for f in system.__dataclass_fields__})
    with pytest.raises(ValueError, match="restart"):
        Disco.create(plain, Quadratic())


def test_particles_as_a_belief_are_planned_with():
    belief = Particles(jnp.array([[0.4, 0.5], [0.6, 0.5], [0.5, 0.7]]), jnp.zeros(3))
    disco = Disco.create(Pendulum.create(), Upswing(), "unscented", samples=8)
    digest = disco.digest(jax.random.key(0), belief)
    np.testing.assert_allclose(digest.weights @ digest.positions, belief.mean(), atol=1e-4)
