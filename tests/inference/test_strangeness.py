"""What a simulator makes is usual; what it lacks is not, whatever its parameters are."""

import jax
import jax.numpy as jnp
import numpy as np

from bayessim_jax.contracts import Box
from bayessim_jax.inference.strangeness import FEWEST, STRANGE, strangeness
from bayessim_jax.learning import RandomPolicy
from bayessim_jax.rollout import rollout
from bayessim_jax.systems import from_functions

STEPS, SET = 40, 4


def carriage(spring=0.0):
    """A mass that is pushed, with viscous friction θ, and a spring that is not in θ."""

    def step(theta, state, action):
        x, v = state
        v = v + 0.05 * (5.0 * action[0] - theta[0] * v - spring * x)
        return jnp.stack([x + 0.05 * v, v])

    return from_functions(
        parameters=Box.create(friction=(0.2, 2.0, "N s/m")),
        actions=Box.create(push=(-1.0, 1.0, "N")),
        observations=Box.create(x=(-5.0, 5.0, "m"), v=(-5.0, 5.0, "m/s")),
        reset=lambda key, theta: 2.0 * jax.random.normal(key, (2,)),
        step=step,
        observe=lambda theta, state: state,
        noise=0.01,
        dt=0.05,
    )


def sets(system, key, thetas):
    """`SET` recordings of every θ under random actions."""
    policy = RandomPolicy(system.actions)
    one = lambda key, theta: rollout(key, system, theta, policy, STEPS)  # noqa: E731
    keys = jax.random.split(key, (len(thetas), SET))
    return jax.jit(jax.vmap(jax.vmap(one, (0, None))))(keys, thetas)


def draw(key, low, high, n):
    return jax.random.uniform(key, (n, 1), minval=low, maxval=high)


judge = jax.jit(jax.vmap(strangeness, (None, 0, None)))
judge_one = jax.jit(strangeness)
ALL = jnp.ones(SET, bool)


def test_what_the_simulator_makes_is_seldom_strange():
    """Of θ anywhere in the range that was simulated, with no more than a word in a hundred wrong."""
    simulated = sets(carriage(), jax.random.key(0), draw(jax.random.key(1), 0.2, 2.0, 64))
    seen = sets(carriage(), jax.random.key(2), draw(jax.random.key(3), 0.2, 2.0, 300))
    found = np.asarray(judge(simulated, seen, ALL))
    assert np.mean(found > STRANGE) <= 0.01
    assert abs(np.median(found)) < 1.0


def test_what_it_lacks_is_strange():
    simulated = sets(carriage(), jax.random.key(0), draw(jax.random.key(1), 0.2, 2.0, 64))
    seen = sets(carriage(spring=0.5), jax.random.key(2), draw(jax.random.key(3), 0.2, 2.0, 50))
    assert np.median(judge(simulated, seen, ALL)) > STRANGE


def test_a_belief_that_has_lost_the_truth_is_strange():
    simulated = sets(carriage(), jax.random.key(0), draw(jax.random.key(1), 0.3, 0.32, 64))
    seen = sets(carriage(), jax.random.key(2), jnp.full((50, 1), 1.5))
    assert np.median(judge(simulated, seen, ALL)) > STRANGE


def test_only_what_counts_is_judged():
    simulated = sets(carriage(), jax.random.key(0), draw(jax.random.key(1), 0.2, 2.0, 64))
    seen = jax.tree.map(lambda leaf: leaf[0], sets(carriage(), jax.random.key(2), jnp.full((1, 1), 1.0)))
    broken = seen.replace(observations=seen.observations.at[0].set(1e3))
    assert judge_one(simulated, broken, ALL) > STRANGE
    without = judge_one(simulated, broken, ALL.at[0].set(False))
    np.testing.assert_allclose(without, judge_one(simulated, seen, ALL.at[0].set(False)), rtol=1e-4)
    assert jnp.isnan(judge_one(simulated, seen, ~ALL))
    few = jax.tree.map(lambda leaf: leaf[: FEWEST - 1], simulated)
    assert jnp.isnan(strangeness(few, seen, ALL))
