from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayessim_jax.contracts import Box
from bayessim_jax.recordings.summaries import Summary, metrics_line, summarize
from bayessim_jax.systems import CartPole
from tests.recordings.synthetic import belief_around, one_info

RUNS = 400


@jax.jit
def look(key, belief, truths):
    return jax.vmap(lambda k, t: summarize(k, belief, t, 200))(jax.random.split(key, RUNS), truths)


def around(mean, sd, half):
    box = Box.create(a=(-half, half, "m"), b=(-half, half, "kg"))
    return belief_around(jnp.array(mean), jnp.array(sd), box)


def test_a_gaussian_in_closed_form():
    truth = jnp.array([1.5, -2.0])  # one standard deviation off along a, none along b
    s = look(jax.random.key(0), around([1.0, -2.0], [0.5, 2.0], 50.0), jnp.tile(truth, (RUNS, 1)))
    # log N(θ*; μ, Σ) = −½ · 1 − log(2π · 0.5 · 2); the set that is denser than θ* is the ellipse r² < 1
    np.testing.assert_allclose(s.log_prob_true, -0.5 - np.log(2 * np.pi), atol=1e-4)
    np.testing.assert_allclose(s.level_true.mean(), 1 - np.exp(-0.5), atol=0.01)
    np.testing.assert_allclose(s.rank_true.mean(0), [0.8413, 0.5], atol=0.01)
    np.testing.assert_allclose(s.mean.mean(0), [1.0, -2.0], atol=0.04)
    np.testing.assert_allclose(s.sd.mean(0), [0.5, 2.0], rtol=0.01)


def test_without_a_truth_only_the_draws_are_numbers():
    s = look(jax.random.key(0), around([0.0, 0.0], [1.0, 1.0], 50.0), jnp.zeros((RUNS, 2)).at[:].set(jnp.nan))
    assert jnp.isnan(s.log_prob_true).all()
    assert jnp.isnan(s.level_true).all()
    assert jnp.isnan(s.rank_true).all()
    assert jnp.isfinite(s.draws).all()


def test_level_and_ranks_are_uniform_over_truths_drawn_from_the_belief():
    belief = around([0.3, 0.2], [0.4, 0.2], 0.5)
    truths = look(jax.random.key(1), belief, jnp.zeros((RUNS, 2))).draws[:, 0]
    each = look(jax.random.key(2), belief, truths)
    for values in (each.level_true, each.rank_true[:, 0], each.rank_true[:, 1]):
        gap = np.abs(np.sort(values) - (np.arange(RUNS) + 0.5) / RUNS).max()
        assert gap < 1.63 / np.sqrt(RUNS)  # Kolmogorov-Smirnov, 1 %


def test_the_line_of_a_round():
    system = CartPole.create()
    info = one_info(system, 2, [0.5, 0.4], overfit=True, log_q_validation=jnp.nan)
    two = jnp.array([0.5, 0.4])
    summary = Summary(two[None], two, two / 10, jnp.array(2.5), jnp.array(0.3), two)
    line = metrics_line(2, 7, system.parameters, 600, 3.0, summary, info, np.array([0.4, 0.3]))
    assert (line["round"], line["seed"], line["overfit"], line["overconfident"]) == (2, 7, True, False)
    assert line["simulations_per_second"] == pytest.approx(200)
    # the prior is uniform on [0.1, 1]²: log p = −2 log 0.9
    assert line["log_prob_true"] == 2.5
    assert line["log_prob_true_scaled"] == pytest.approx(2.5 + 2 * np.log(0.9), abs=1e-5)
    assert line["gain_over_prior"] == pytest.approx(2.5 + 2 * np.log(0.9), abs=1e-5)
    assert line["sd"] == pytest.approx({"length": 0.05, "mass": 0.04})
    assert (line["return_target"], line["return_simulated"]) == (40.0, 20.0)
    assert (line["cost_target"], line["truth"]) == (pytest.approx(0.2), {"length": 0.4, "mass": 0.3})
    page = (Path(__file__).parents[2] / "docs" / "runs.md").read_text(encoding="utf-8")
    assert not [key for key in line if f"`{key}`" not in page]
