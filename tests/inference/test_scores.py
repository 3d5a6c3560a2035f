"""Scores of predictions, against their closed forms."""

import jax.numpy as jnp
import numpy as np
import pytest

from bayessim_jax.beliefs.margins import Margins, normal, uniform
from bayessim_jax.inference.identifiability import find_unidentified
from bayessim_jax.inference.replay import Replay
from bayessim_jax.inference.scores import CHUNK, compare, error_spread, predict_windows, score
from bayessim_jax.inference.shooting import Shots


def errors(sd, seed=0, windows=40, rows=33):
    rng = np.random.default_rng(seed)
    y = rng.normal(size=(windows, rows, 1))
    return compare(y - sd * rng.normal(size=y.shape), y, np.ones(y.shape, bool))


def test_the_first_row_is_given_and_not_scored():
    found = errors(0.1)
    assert not found.measured[:, 0].any() and found.measured[:, 1:].all()
    assert (found.error[:, 0] == 0).all()


def test_nrmse_and_log_score_of_gaussian_errors():
    scale = np.array([2.0])
    found = score(errors(0.1), error_spread(errors(0.1, 1), scale), scale, ("q",))
    assert found.nrmse == pytest.approx(0.05, rel=0.05)
    assert found.per_channel == {"q": found.nrmse}
    entropy = 0.5 + np.log(0.05 * np.sqrt(2 * np.pi))
    assert found.log_score == pytest.approx(-entropy, abs=0.1)


def test_a_spread_that_is_too_small_costs():
    scale = np.array([1.0])
    right = score(errors(0.1), error_spread(errors(0.1, 1), scale), scale, ("q",))
    bold = score(errors(0.1), error_spread(errors(0.02, 1), scale), scale, ("q",))
    shy = score(errors(0.1), error_spread(errors(0.5, 1), scale), scale, ("q",))
    assert right.log_score > shy.log_score > bold.log_score


def test_a_window_that_diverges_is_counted_and_in_no_average():
    y = np.zeros((3, 5, 1))
    predicted = np.full_like(y, 0.1)
    predicted[1, 3] = np.nan
    found = compare(predicted, y, np.ones(y.shape, bool))
    assert found.diverged == 1
    assert score(found, np.ones((8, 1)), np.ones(1), ("q",)).nrmse == pytest.approx(0.1)


def test_identifiability_names_what_is_not_informed_ridges_and_edges():
    rng = np.random.default_rng(0)
    free = rng.normal(size=4000)
    common = rng.normal(size=4000)
    ridge = [0.3 * common, 0.3 * common + 0.01 * rng.normal(size=4000)]
    z = np.stack([free, *ridge, 0.01 * rng.normal(size=4000), 3.0 + 0.1 * rng.normal(size=4000)], axis=-1)
    found = find_unidentified(z, ("free", "a", "b", "known", "pushed"))
    assert found.not_informed == ["free"]
    assert [r[:2] for r in found.ridges] == [("a", "b")]
    assert found.at_edge == ["pushed"]
    assert found.contraction["known"] == pytest.approx(0.99, abs=0.01)


@pytest.mark.parametrize("windows", [0, 1, CHUNK, CHUNK + 7])
def test_windows_are_predicted_as_by_themselves_however_many_there_are(windows):
    """y_t = z (x + δ) + t, one window after the other, through one program."""
    traced = []

    def predict(z, delta, start):
        traced.append(start.shape)
        return (z[0] * (start + delta[0]) + jnp.arange(5.0))[:, None]

    rng = np.random.default_rng(0)
    starts, moved, y = rng.normal(size=windows), rng.normal(size=(windows, 1)), np.zeros((windows, 5, 1))
    shots = Shots(jnp.asarray(starts), jnp.asarray(y), jnp.ones(y.shape, bool), jnp.ones(1))
    for delta, start in ((None, starts), (moved, starts + moved[:, 0])):
        found = predict_windows(predict, shots, np.array([2.0]), delta)
        np.testing.assert_allclose(found[..., 0], 2.0 * start[:, None] + np.arange(5.0), rtol=1e-6, atol=1e-6)
    assert len(traced) == (1 if windows else 0)


def test_what_was_compiled_for_a_system_and_its_priors_serves_them_again():
    system, other = object(), object()
    margins = Margins.create(["a"], [uniform(0.0, 1.0)])
    assert Replay(system, margins) == Replay(system, Margins.create(["a"], [uniform(0.0, 1.0)]))
    assert hash(Replay(system, margins)) == hash(Replay(system, Margins.create(["a"], [uniform(0.0, 1.0)])))
    assert Replay(system, margins) != Replay(other, margins)
    assert Replay(system, margins) != Replay(system, Margins.create(["a"], [normal(0.0, 1.0)]))
