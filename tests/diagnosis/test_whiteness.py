"""Whether residuals are white."""

import jax
import numpy as np
import pytest

from bayessim_jax.diagnosis.verdict import share_left
from bayessim_jax.diagnosis.whiteness import judge_misfit


def test_white_residuals_have_uniform_p_values():
    rng = np.random.default_rng(0)
    windows, rows = 8, 40
    slopes = np.stack([np.ones(rows), np.linspace(-1, 1, rows)])[None].repeat(windows, 0)
    measured = np.ones((windows, rows, 1), bool)
    p_values = []
    for trial in range(40):
        noise = 0.3 * rng.standard_normal((windows, rows))
        q, _ = np.linalg.qr(slopes[0].T)
        noise = noise - noise @ q @ q.T
        found = judge_misfit(jax.random.key(trial), noise[..., None], jax.numpy.asarray(slopes), measured)
        p_values.append(found.p_value)
    assert 0.3 < np.mean(p_values) < 0.7
    assert np.mean(np.array(p_values) < 0.05) < 0.15
    wave = 0.2 * np.sin(np.linspace(0, 6, rows))
    smooth = judge_misfit(jax.random.key(0), (noise + wave)[..., None], jax.numpy.asarray(slopes), measured)
    assert smooth.p_value < 0.01
    assert smooth.noise[0] == pytest.approx(0.3, rel=0.15)


def test_residuals_of_a_constant_size_are_no_noise():
    """A base that is tilted, or a sensor that is off: nothing moves slowly, and all of it lies beside."""
    rng, (windows, rows) = np.random.default_rng(1), (6, 50)
    slopes = jax.numpy.asarray(np.linspace(-1, 1, rows)[None, None].repeat(windows, 0))
    measured = np.ones((windows, rows, 1), bool)
    noise = 0.1 * rng.standard_normal((windows, rows, 1))
    p_values = [judge_misfit(jax.random.key(0), noise + off, slopes, measured).p_value for off in (0.0, 0.1)]
    assert p_values[0] > 0.05 > 0.01 > p_values[1]


def test_what_moves_no_prediction_absorbs_nothing():
    """Commands from before a recording, of a simulator in which nothing remembers them."""
    rng, (windows, rows) = np.random.default_rng(3), (5, 30)
    moves = np.linspace(-1, 1, rows)[None, None].repeat(windows, 0)
    still, measured = np.zeros_like(moves), np.ones((windows, rows, 1), bool)
    noise = rng.standard_normal((windows, rows, 1))
    alone, beside = (
        judge_misfit(jax.random.key(0), noise, jax.numpy.asarray(slopes), measured)
        for slopes in (moves, np.concatenate([moves, still, moves], axis=1))
    )
    assert alone.p_value == beside.p_value
    np.testing.assert_allclose(alone.excess, beside.excess, rtol=1e-4)


def test_what_moves_no_prediction_takes_no_part_of_what_others_move():
    """Where rows are missing the diagnosis of a crane had ended in an error for it."""
    rng, (windows, rows) = np.random.default_rng(3), (5, 30)
    measured = np.ones((windows, rows, 2), bool)
    measured[:, 0] = False
    draw = lambda: np.where(measured, rng.standard_normal((windows, rows, 2)).cumsum(1), 0.0)  # noqa: E731
    one, two, three = (draw().reshape(windows, 1, -1) for _ in range(3))
    noise = np.where(measured, rng.standard_normal((windows, rows, 2)), 0.0)
    alone, beside = (
        judge_misfit(jax.random.key(0), noise, jax.numpy.asarray(np.concatenate(slopes, axis=1)), measured)
        for slopes in ((one, two, three), (one, two, np.zeros_like(one), three))
    )
    np.testing.assert_allclose(alone.excess, beside.excess, atol=1e-4)
    assert alone.p_value == beside.p_value


def test_windows_that_do_not_count_are_no_evidence_before_or_after():
    """An effect that remembers is off where its past is unknown: these windows are left out on both sides."""
    rng, (windows, rows) = np.random.default_rng(2), (20, 40)
    slopes = jax.numpy.asarray(np.linspace(-1, 1, rows)[None, None].repeat(windows, 0))
    measured = np.ones((windows, rows, 1), bool)
    noise = 0.1 * rng.standard_normal((windows, rows, 1))
    wave = np.sin(np.linspace(0, 5, rows))[:, None]
    first = np.arange(windows)[:, None, None] < 5
    before = judge_misfit(jax.random.key(0), noise + wave, slopes, measured)
    after = noise + np.where(first, wave, 0.02 * wave)
    every = judge_misfit(jax.random.key(0), after, slopes, measured)
    later = judge_misfit(jax.random.key(0), after, slopes, measured, judged=~first[:, 0, 0])
    assert share_left(every, before) == pytest.approx(0.25, abs=0.03)
    assert share_left(later, before) < 0.005
    assert every.p_value < 0.01 < later.p_value
    assert (later.excess[:5] == 0).all()


@pytest.mark.parametrize(("windows", "rows"), [(40, 13), (20, 51)])
def test_noise_that_few_differences_show_is_no_alarm(windows, rows):
    """In short windows the noise is hardly better known than the slow power that is compared with it."""
    rng, obs = np.random.default_rng(4), 4
    slopes = np.zeros((obs, rows, obs))
    slopes[np.arange(obs), :, np.arange(obs)] = np.linspace(0, 1, rows)
    slopes = slopes.reshape(1, obs, rows * obs).repeat(windows, 0)
    q, _ = np.linalg.qr(slopes[0].T)
    measured, p_values = np.ones((windows, rows, obs), bool), []
    for trial in range(200):
        noise = rng.standard_normal((windows, rows * obs))
        noise = (noise - noise @ q @ q.T).reshape(windows, rows, obs)
        p_values.append(judge_misfit(jax.random.key(trial), noise, slopes, measured).p_value)
    shares = [float(np.mean(np.array(p_values) < p)) for p in (0.05, 0.2, 0.5)]
    assert shares[0] < 0.09  # 0.12 where the noise is taken for known
    assert shares[1] < 0.28
    assert shares[2] == pytest.approx(0.5, abs=0.15)
