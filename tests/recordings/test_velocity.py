"""Estimated velocities: exact on parabolas, close to the truth in noise, never across a gap."""

import mujoco
import numpy as np
import pytest

from bayessim_jax.recordings.loading import load_case
from bayessim_jax.recordings.velocity import HALF_WIDTHS, estimate_slopes, local_quadratic
from tests.recordings.made_up_case import CASE, columns, write_case

CUBE = """
<mujoco>
  <worldbody>
    <body name="cube" pos="0 0 1"><freejoint name="cube"/><geom type="box" size="0.1 0.2 0.3"/></body>
  </worldbody>
</mujoco>
"""


def jittered(rows, dt, rng):
    return np.cumsum(dt * rng.uniform(0.4, 1.6, rows))


def none(rows):
    return np.zeros(rows - 1, bool)


@pytest.mark.parametrize("start", [0.0, 1.7e9])
def test_a_parabola_is_recovered_at_jittered_times(start):
    time = start + jittered(500, 0.004, np.random.default_rng(0))
    since = time - time[0]
    slopes, _ = estimate_slopes(time, 2 + 3 * since - 5 * since**2, none(500))
    np.testing.assert_allclose(slopes, 3 - 10 * since, rtol=1e-6 if start else 1e-8, atol=1e-5 if start else 1e-9)


@pytest.mark.parametrize(("noise", "better"), [(1e-3, 5), (1e-4, 2.5)])
def test_noise_is_smoothed_more_than_by_differences(noise, better):
    rng = np.random.default_rng(1)
    time = jittered(5000, 0.004, rng)
    seen = np.sin(6 * time) + noise * rng.standard_normal(5000)
    slopes, half = estimate_slopes(time, seen, none(5000))
    truth = 6 * np.cos(6 * time)
    error, bare = np.std(slopes - truth), np.std(np.gradient(seen, time) - truth)
    assert error * better < bare
    run = np.zeros(5000, int)
    best = min(np.std(local_quadratic(time, seen, run, 0, 5000, h)[0] - truth) for h in HALF_WIDTHS)
    assert error < 1.6 * best
    assert half in HALF_WIDTHS


def test_what_is_not_noisy_is_hardly_smoothed():
    time = np.arange(2000) * 0.004
    slopes, half = estimate_slopes(time, np.sin(6 * time), none(2000))
    assert half == HALF_WIDTHS[0]
    np.testing.assert_allclose(slopes[2:-2], 6 * np.cos(6 * time[2:-2]), atol=0.01)


def test_where_an_acceleration_jumps_the_rows_of_one_side_tell_the_velocity():
    rng, dt = np.random.default_rng(3), 0.01
    acceleration = np.repeat(rng.uniform(-100.0, 100.0, 25), 40)
    truth = np.concatenate([[0.0], np.cumsum(acceleration * dt)])[:-1]
    places = np.cumsum(truth * dt + 0.5 * acceleration * dt**2) - (truth * dt + 0.5 * acceleration * dt**2)
    time = dt * np.arange(1000)
    seen = places + 1e-4 * rng.standard_normal(1000)
    slopes, half = estimate_slopes(time, seen, none(1000))
    central = local_quadratic(time, seen, np.zeros(1000, int), 0, 1000, half)[0]
    assert np.abs(central - truth).max() > 0.3
    assert np.abs(slopes - truth).max() < 0.05
    calm = np.abs(np.arange(1000) % 40 - 20) < 15
    np.testing.assert_array_equal(slopes[calm], central[calm])


@pytest.mark.parametrize("step", [0.0, 0.002])
def test_no_side_is_chosen_for_noise_or_for_the_steps_of_an_encoder(step):
    rng = np.random.default_rng(4)
    time = 0.005 * np.arange(4000)
    seen = 0.3 * np.sin(2 * time) + (1e-4 if not step else 1e-5) * rng.standard_normal(4000)
    seen = np.round(seen / step) * step if step else seen
    slopes, half = estimate_slopes(time, seen, none(4000))
    central = local_quadratic(time, seen, np.zeros(4000, int), 0, 4000, half)[0]
    assert (slopes == central).mean() > 0.999


def test_a_jump_across_a_break_is_not_a_velocity():
    time = np.arange(60) * 0.01
    values = np.where(np.arange(60) < 30, 0.0, 100.0)
    breaks = none(60)
    breaks[29] = True
    slopes, _ = estimate_slopes(time, values, breaks)
    np.testing.assert_allclose(slopes, 0, atol=1e-9)
    breaks[[9, 10]] = True  # row 10 stands alone
    assert np.isnan(estimate_slopes(time, values, breaks)[0]).nonzero()[0].tolist() == [10]


def test_long_recordings_are_done_in_pieces(monkeypatch):
    from bayessim_jax.recordings import velocity

    rng = np.random.default_rng(2)
    time = jittered(5000, 0.01, rng)
    values = np.cumsum(rng.standard_normal(5000))
    run = np.zeros(5000, int)
    whole, half = estimate_slopes(time, values, none(5000))
    monkeypatch.setattr(velocity, "CHUNK", 700)
    pieces, other = estimate_slopes(time, values, none(5000))
    assert half == other
    np.testing.assert_allclose(pieces, whole, rtol=1e-9, atol=1e-9)
    assert run.sum() == 0


def test_a_joint_without_measured_velocity_gets_the_one_that_it_had(tmp_path):
    truth = columns()
    without = {name: values for name, values in truth.items() if "qvel" not in name}
    (recording,) = load_case(write_case(tmp_path, run1=without)).check().recordings
    assert recording.qvel_estimated.all()
    assert not recording.qvel_measured.any()
    np.testing.assert_allclose(recording.qvel[:, 0], truth["joint/hinge/qvel"], atol=0.03)


@pytest.mark.parametrize("flip", [False, True])
def test_the_angular_velocity_of_a_free_body(tmp_path, flip):
    model = mujoco.MjModel.from_xml_string(CUBE)
    data = mujoco.MjData(model)
    data.qvel[:] = [0.3, -0.2, 1.0, 2.0, -3.0, 1.5]
    rows = 300
    qpos, qvel = np.empty((rows, 7)), np.empty((rows, 6))
    for i in range(rows):
        qpos[i], qvel[i] = data.qpos, data.qvel
        mujoco.mj_step(model, data)
    time = np.arange(rows) * model.opt.timestep
    if flip:
        qpos[100:200, 3:] *= -1
    case = CASE.replace("body/bob/mass", "body/cube/mass").replace("low = 0.15, high = 0.6", "low = 1, high = 90")
    table = {"time": time} | {f"joint/cube/qpos/{k}": qpos[:, k] for k in range(7)}
    loaded = load_case(write_case(tmp_path, case=case, model=CUBE, run1=table)).check()
    (recording,) = loaded.recordings
    np.testing.assert_allclose(recording.qvel, qvel, atol=0.05)
    np.testing.assert_allclose(np.abs((recording.qpos[1:, 3:] * recording.qpos[:-1, 3:]).sum(1)), 1, atol=1e-3)
    assert ((recording.qpos[1:, 3:] * recording.qpos[:-1, 3:]).sum(1) > 0).all()
    # MuJoCo's own integration with the estimated velocity reaches the next orientation
    reached = recording.qpos[50].copy()
    mujoco.mj_integratePos(model, reached, recording.qvel[50], model.opt.timestep)
    np.testing.assert_allclose(reached, recording.qpos[51], atol=1e-3)
