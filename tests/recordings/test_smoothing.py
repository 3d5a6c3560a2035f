"""Smoothed motion is nearer to the true one than what was recorded."""

import numpy as np
import pytest

from bayessim_jax.recordings.recording import CaseRecording
from bayessim_jax.recordings.smoothing import smooth_recordings


def recording(rng, noise, measured=True, rows=600, breaks=()):
    t = 0.004 * np.arange(rows)
    q = 0.8 * np.sin(4 * t) + 0.2 * np.cos(9 * t + 1)
    v = 3.2 * np.cos(4 * t) - 1.8 * np.sin(9 * t + 1)
    seen = np.ones((rows, 1), bool)
    valid = np.ones(rows - 1, bool)
    valid[list(breaks)] = False
    noisy = CaseRecording(
        name="a.csv",
        time=t,
        ctrl=np.zeros((rows, 0)),
        qpos=(q + noise * rng.standard_normal(rows))[:, None],
        qvel=(v + 10 * noise * rng.standard_normal(rows))[:, None] if measured else np.gradient(q, t)[:, None],
        sensors=np.zeros((rows, 0)),
        qpos_measured=seen,
        qvel_measured=seen & measured,
        sensors_measured=np.zeros((rows, 0), bool),
        valid=valid,
        known=np.ones(rows, bool),
    )
    return noisy, q, v


@pytest.mark.parametrize("measured", [True, False])
def test_errors_shrink(measured):
    rng = np.random.default_rng(0)
    noise = 2e-3
    one, q, v = recording(rng, noise, measured)
    smooth = smooth_recordings([one], [(0, 0)])[0]
    middle = slice(30, -30)
    assert np.std((smooth.qpos[:, 0] - q)[middle]) < 0.5 * noise
    assert np.std((smooth.qvel[:, 0] - v)[middle]) < (5 if measured else 25) * noise


def test_nothing_is_smoothed_across_a_break_and_other_joints_stay():
    rng = np.random.default_rng(1)
    one, _, _ = recording(rng, 1e-3, breaks=(299,))
    shifted = one.qpos.copy()
    shifted[300:] += 1.0
    import dataclasses

    jump = dataclasses.replace(one, qpos=shifted)
    smooth, plain = (smooth_recordings([r], [(0, 0)])[0].qpos for r in (jump, one))
    np.testing.assert_allclose(smooth[300:] - 1.0, plain[300:], atol=2e-4)
    np.testing.assert_allclose(smooth_recordings([one], [])[0].qpos, one.qpos)
