"""MPPI against what the theory says of one step, and on the pendulum."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayessim_jax.beliefs import Uniform
from bayessim_jax.contracts import Box, Discrete
from bayessim_jax.control import Mppi, Plan, coloured_noise, default_planner, spline_noise, white_noise
from bayessim_jax.control.noise import NOISES
from bayessim_jax.rollout import rollout
from bayessim_jax.systems import Pendulum, Upswing

WIDE = Box.create(u=(-50.0, 50.0, ""))


def squares(aim):
    """½ Σ (u − aim)² of every plan."""
    return lambda tried: 0.5 * ((tried - aim) ** 2).sum((0, 1))


@pytest.mark.parametrize("temperature", [1.0, 3.0])
@pytest.mark.parametrize("control_cost", [0.0, 1.0])
def test_one_step_is_the_mean_of_the_tilted_gaussian(temperature, control_cost):
    """exp(−½(u+ε−a)²/λ − α u ε/σ²) N(ε; 0, σ²) is a Gaussian in ε whose mean is known."""
    mppi = Mppi.create(WIDE, 2, 200_000, sigma=0.02, temperature=temperature, control_cost=control_cost)
    variance, start, aim = float(mppi.sigma[0]) ** 2, jnp.array([[0.5], [-0.3]]), 1.2
    plan, info = jax.jit(lambda key: mppi.improve(key, Plan(start), squares(aim)))(jax.random.key(0))
    precision = 1 / variance + 1 / temperature
    expected = start + ((aim - start) / temperature - control_cost * start / variance) / precision
    np.testing.assert_allclose(plan.actions, expected, atol=0.02)
    assert float(info.weights.sum()) == pytest.approx(1.0, abs=1e-4)


def test_the_share_of_samples_in_effect_is_the_one_asked_for():
    cost = squares(3.0)
    for share in (0.02, 0.1, 0.3):
        mppi = Mppi.create(WIDE, 5, 2000, sigma=0.1, temperature=1e4, control_cost=0.0, share=share)
        _, info = mppi.improve(jax.random.key(1), mppi.init(), cost)
        assert float(info.effective) == pytest.approx(share * 2000, rel=0.05)
    mppi = Mppi.create(WIDE, 5, 2000, sigma=0.1, temperature=0.5, control_cost=0.0, share=0.9)
    _, info = mppi.improve(jax.random.key(1), mppi.init(), cost)
    assert float(info.temperature) == pytest.approx(0.5, rel=0.01)


def test_plans_stay_within_the_limits_and_ignore_what_is_not_finite():
    mppi = Mppi.create(Box.create(u=(-1.0, 2.0, "")), 4, 400, sigma=3.0, temperature=1.0)

    def cost(tried):
        return jnp.where(tried[0, 0] > 0, jnp.nan, squares(10.0)(tried))

    plan, info = mppi.improve(jax.random.key(2), mppi.init(), cost)
    assert info.actions.min() >= -1.0
    assert info.actions.max() <= 2.0
    assert jnp.isfinite(plan.actions).all()
    assert plan.actions[0, 0] < 0
    assert (info.weights[info.actions[0, 0] > 0] == 0).all()
    hopeless, _ = mppi.improve(jax.random.key(2), mppi.init(), lambda tried: jnp.full(400, jnp.nan))
    assert jnp.isfinite(hopeless.actions).all()


def test_an_index_is_planned_as_a_number_and_rounded():
    mppi = Mppi.create(Discrete(3), 3, 500, sigma=0.6, temperature=0.1)
    plan, info = mppi.improve(jax.random.key(0), mppi.init(), lambda u: ((u - 2.0) ** 2).sum((0, 1)))
    assert set(np.unique(mppi.act(info.actions))) == {0.0, 1.0, 2.0}
    assert float(mppi.act(plan.actions)[0, 0]) == 2.0


def test_the_shifted_plan_holds_its_last_action():
    mppi = Mppi.create(WIDE, 3, 10)
    np.testing.assert_array_equal(mppi.shift(Plan(jnp.array([[1.0], [2.0], [3.0]]))).actions, [[2.0], [3.0], [3.0]])


@pytest.mark.parametrize("name", NOISES)
def test_every_noise_has_unit_variance_and_its_own_inverse_covariance(name):
    noise = NOISES[name](20)
    draws = np.asarray(noise.draw(jax.random.key(0), 2, 40_000))
    np.testing.assert_allclose(draws.std(-1), 1.0, atol=0.02)
    covariance = np.cov(draws[:, 0])
    precision = np.stack([noise.whiten(jnp.eye(20)[:, [i]])[:, 0] for i in range(20)])
    np.testing.assert_allclose(covariance @ precision @ covariance, covariance, atol=0.15)


def test_smoother_noise_changes_less_from_step_to_step():
    def jump(noise):
        return float(jnp.abs(jnp.diff(noise.draw(jax.random.key(0), 1, 2000), axis=0)).mean())

    steps = [jump(n) for n in (white_noise(40), coloured_noise(40, 1.0), coloured_noise(40, 2.0), spline_noise(40, 8))]
    assert steps == sorted(steps, reverse=True)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"horizon": 0}, "both must be positive"),
        ({"temperature": 0.0}, "temperature is 0.0"),
        ({"share": 1.5}, "share is 1.5"),
        ({"noise": "wite"}, "did you mean 'white'"),
        ({"noise": "spline", "horizon": 3}, "knots is 4; it must be from 4 to the horizon, 3"),
    ],
)
def test_slips_are_told_at_once(settings, message):
    with pytest.raises(ValueError, match=message):
        Mppi.create(WIDE, **settings)


@pytest.mark.slow
def test_the_pendulum_swings_up_from_fifty_random_starts():
    system, task = Pendulum.create(), Upswing()
    theta = jnp.array([1.0, 1.0])
    planner = default_planner("mppi", "pendulum", system, task)
    box = system.parameters
    sure = Uniform(Box(theta - 1e-4, theta + 1e-4, box.names, box.units))
    state, _ = planner.step(jax.random.key(0), planner.init(jax.random.key(0)), sure)
    policy = planner.policy(state, deterministic=True)
    swing = jax.jit(jax.vmap(lambda key: rollout(key, system, theta, policy, task.steps, task)))
    cos = swing(jax.random.split(jax.random.key(5), 50)).observations[..., 0]
    assert cos[:, 0].min() < -0.9
    assert cos[:, -20:].mean(-1).min() > 0.95
