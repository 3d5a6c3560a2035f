"""Masks, windows and resampling of recordings with gaps, jitter and missing numbers."""

import jax
import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from bayessim_jax.recordings.loading import load_case
from bayessim_jax.recordings.recording import resample
from bayessim_jax.recordings.shots import case_model
from bayessim_jax.recordings.windows import find_windows, stack_windows
from bayessim_jax.recordings.wording import CaseError
from tests.recordings.made_up_case import columns, csv_text, write_case

QPOS, QVEL, CTRL = "joint/hinge/qpos", "joint/hinge/qvel", "actuator/motor/ctrl"


def loaded(tmp_path, *changes, **recordings):
    data = columns()
    for name, rows, value in changes:
        data[name][rows] = value
    return load_case(write_case(tmp_path, **(recordings or {"run1": data})), mask=True)


def one(tmp_path, *changes):
    (recording,) = loaded(tmp_path, *changes).check().recordings
    return recording


def test_without_trouble_everything_is_measured_and_valid(tmp_path):
    recording = one(tmp_path)
    assert recording.valid.all()
    assert recording.known.all()
    assert recording.qpos_measured.all()
    assert recording.qvel_measured.all()
    assert recording.spans == [(0, 399)]
    assert find_windows(recording, 0.5) == [(50 * k, 50 * k + 50) for k in range(7)]


def test_what_follows_on_an_unknown_past_is_left_out_where_that_costs_little(tmp_path):
    recording = one(tmp_path)
    assert find_windows(recording, 0.5, lead=0.2) == [(20 + 50 * k, 70 + 50 * k) for k in range(7)]
    assert find_windows(recording, 1.9, lead=0.2) == [(0, 190), (190, 380)]  # half of them would be lost


def test_missing_positions_are_masked_and_filled_in(tmp_path):
    recording = one(tmp_path, (QPOS, [30, 31], np.nan))
    assert np.flatnonzero(~recording.qpos_measured[:, 0]).tolist() == [30, 31]
    np.testing.assert_allclose(recording.qpos[30:32, 0], columns()[QPOS][30:32], atol=0.02)
    assert recording.valid.all()
    assert recording.known.all()


def test_no_window_starts_where_the_state_is_not_known(tmp_path):
    recording = one(tmp_path, (QPOS, slice(95, 130), np.nan))
    assert np.flatnonzero(~recording.known).tolist() == list(range(95, 130))
    windows = find_windows(recording, 0.5)
    assert windows[:3] == [(0, 50), (50, 100), (130, 180)]
    stacked = stack_windows([recording], 0.5)
    assert not stacked.qpos_measured[1, 45:].any()
    assert stacked.qpos_measured[1, :45].all()
    assert np.isfinite(stacked.qpos).all()


def test_no_window_spans_a_gap(tmp_path):
    data = columns()
    data["time"][120:] += 0.7
    case = loaded(tmp_path, run1=data).check()
    (recording,) = case.recordings
    assert np.flatnonzero(~recording.valid).tolist() == [119]
    assert recording.spans == [(0, 119), (120, 399)]
    for start, stop in find_windows(recording, 0.5):
        assert recording.valid[start:stop].all()
    assert find_windows(recording, 0.5)[:3] == [(0, 50), (50, 100), (120, 170)]
    stacked = case.windows()
    assert (np.diff(stacked.time, axis=1) < 0.02).all()
    assert stacked.start[2] == pytest.approx(1.9)


def test_no_window_spans_an_unknown_command(tmp_path):
    recording = one(tmp_path, (CTRL, [70, 71], np.nan))
    assert np.flatnonzero(~recording.valid).tolist() == [70, 71]
    assert find_windows(recording, 0.5)[:2] == [(0, 50), (72, 122)]


def test_a_command_logged_at_a_lower_rate_is_held_and_said(tmp_path):
    rows = np.arange(400)
    case = loaded(tmp_path, (CTRL, rows % 5 != 0, np.nan)).check()
    (recording,) = case.recordings
    np.testing.assert_array_equal(recording.ctrl[:, 0], np.repeat(columns()[CTRL][::5], 5))
    assert recording.valid.all()
    assert "actuator/motor/ctrl is empty or NaN in 320 of 400 rows, first here; it is held where it is missing" in str(
        case.findings[0]
    )


def test_jitter_is_no_gap_and_windows_end_at_the_nearest_row(tmp_path):
    data, rng = columns(), np.random.default_rng(0)
    data["time"] = np.cumsum(rng.choice([0.006, 0.01, 0.014, 0.035], 400, p=[0.3, 0.4, 0.25, 0.05]))
    case = loaded(tmp_path, run1=data)
    assert not case.errors
    (recording,) = case.recordings
    assert recording.valid.all()
    for start, stop in find_windows(recording, 0.5):
        miss = recording.time[stop] - recording.time[start] - 0.5
        assert abs(miss) <= 0.0175 + 1e-9
    stacked = case.windows()
    lengths = stacked.valid.sum(1)
    assert len(set(lengths.tolist())) > 1
    for w, (start, stop) in enumerate(find_windows(recording, 0.5)):
        assert lengths[w] == stop - start
        np.testing.assert_array_equal(stacked.qpos[w, : stop - start + 1], recording.qpos[start : stop + 1])
        np.testing.assert_array_equal(stacked.ctrl[w, : stop - start], recording.ctrl[start:stop])
        assert not stacked.qpos[w, stop - start + 1 :].any()
        assert not stacked.qpos_measured[w, stop - start + 1 :].any()


def test_recordings_of_different_rates_stand_side_by_side(tmp_path):
    fast, slow = columns(400, 0.01), columns(200, 0.02)
    case = loaded(tmp_path, fast=fast, slow=slow).check()
    stacked = case.windows()
    assert [r.name for r in case.recordings] == ["fast.csv", "slow.csv"]
    assert stacked.recording.tolist() == [0] * 7 + [1] * 7
    assert stacked.valid.sum(1).tolist() == [50] * 7 + [25] * 7
    np.testing.assert_allclose(stacked.time[7, :26], np.arange(26) * 0.02, atol=1e-9)


def test_windows_may_overlap(tmp_path):
    recording = one(tmp_path)
    assert [start for start, _ in find_windows(recording, 0.5, stride=0.1)] == list(range(0, 350, 10))


def test_a_wrapped_angle_is_made_continuous(tmp_path):
    data = columns()
    data[QPOS] = (data[QPOS] + 2.5 + np.pi) % (2 * np.pi) - np.pi
    (recording,) = load_case(write_case(tmp_path, run1=data), mask=True).check().recordings
    np.testing.assert_allclose(np.diff(recording.qpos[:, 0]), np.diff(columns()[QPOS]), atol=1e-12)


def test_a_fast_joint_does_not_wrap(tmp_path):
    data = columns()
    data[QPOS] = np.cumsum(np.full(400, 6.2))  # more than the simulator's joint does, but no turn that is lost
    (recording,) = load_case(write_case(tmp_path, run1=data), mask=True).recordings
    np.testing.assert_array_equal(recording.qpos[:, 0], data[QPOS])


def test_no_window_where_rows_are_farther_apart_than_the_horizon(tmp_path):
    case = loaded(tmp_path, run1=columns(200, 0.8))
    assert [f.what for f in case.errors] == ["no recording holds a window of horizon = 0.5 s"]
    assert any("looks like milliseconds" in f.what for f in case.findings)


def test_resampling_moves_measurements_and_keeps_the_impulse(tmp_path):
    data = columns()
    data["time"][200:] += 1.0
    data[QPOS][10] = np.nan
    (recording,) = load_case(write_case(tmp_path, run1=data), mask=True).recordings
    uniform = resample(recording, 0.025)
    steps = np.diff(uniform.time)
    np.testing.assert_allclose(steps[uniform.valid], 0.025)
    assert (~uniform.valid).sum() == 1
    rows = uniform.spans[0]
    held = uniform.ctrl[rows[0] : rows[1], 0].sum() * 0.025
    end = uniform.time[rows[1]]
    original = (recording.ctrl[:199, 0] * np.diff(np.minimum(recording.time[:200], end))).sum()
    assert held == pytest.approx(original, rel=1e-9)
    smooth = CubicSpline(np.delete(recording.time[:200], 10), np.delete(recording.qpos[:200, 0], 10))
    measured = uniform.qpos_measured[:79, 0]
    np.testing.assert_allclose(uniform.qpos[:79, 0][measured], smooth(uniform.time[:79])[measured], atol=1e-5)
    assert np.flatnonzero(~uniform.qpos_measured[:, 0]).tolist() == [4]


def test_noise_of_jittered_recordings_stays_white_on_a_grid(tmp_path):
    rng, dt = np.random.default_rng(0), 0.01
    data = columns(4000, dt)
    data["time"] = data["time"] + 0.3 * dt * rng.uniform(-0.5, 0.5, 4000)
    noise = 0.01 * rng.standard_normal(4000)
    data[QPOS] = np.sin(3.0 * data["time"]) + noise
    (recording,) = load_case(write_case(tmp_path, run1=data), mask=True).recordings
    uniform = resample(recording, dt)
    left = uniform.qpos[:, 0] - np.sin(3.0 * uniform.time)
    left = left[uniform.qpos_measured[:, 0]]
    assert len(left) > 3900
    assert left.std() == pytest.approx(0.01, rel=0.04)
    assert abs(np.corrcoef(left[1:], left[:-1])[0, 1]) < 0.05


def test_a_measurement_counts_once_where_the_grid_is_finer(tmp_path):
    (recording,) = load_case(write_case(tmp_path, run1=columns())).recordings
    finer = resample(recording, 0.004)
    assert finer.qpos_measured[:, 0].sum() == pytest.approx(len(recording.time), abs=1)
    assert (finer.known <= finer.qpos_measured[:, 0]).all()


def test_resampling_to_its_own_rows_changes_nothing(tmp_path):
    recording = one(tmp_path, (QPOS, [30], np.nan))
    same = resample(recording, 0.01)
    for name in ("time", "qpos", "qvel", "ctrl"):
        np.testing.assert_allclose(getattr(same, name), getattr(recording, name), atol=1e-9)
    with pytest.raises(ValueError, match="dt is 0"):
        resample(recording, 0)


def test_effects_count_time_from_the_first_row_of_a_recording(tmp_path):
    """A log that is cut out of a longer one, or has the clock of the day, is simulated as one that begins at zero."""
    late = columns()
    late["time"] = late["time"] + 4096.0
    cases = (loaded(tmp_path / "a"), loaded(tmp_path / "b", run1=late))
    models = [case_model(case.check(), before=0.1) for case in cases]
    windows = [model.windows([0]) for model in models]
    np.testing.assert_allclose(windows[1].start - windows[0].start, 4096.0)
    prompt, shifted = (model.inputs(w) for model, w in zip(models, windows, strict=True))
    assert float(prompt.time[0]) == 0.0 and float(prompt.time[-1]) > 0.0
    for a, b in zip(jax.tree.leaves(prompt), jax.tree.leaves(shifted), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-6)


def test_the_first_error_stops_and_the_others_are_counted(tmp_path):
    data = columns()
    data["time"][5] = data["time"][4]
    case = loaded(tmp_path, run1=data, run2=csv_text(columns()).replace("time", "t", 1))
    assert len(case.errors) == 2
    with pytest.raises(CaseError, match=r"run1\.csv, row 6 .*time occurs twice.*\(1 more: bayessim check"):
        case.check()


def test_values_put_into_a_case_are_in_its_model(tmp_path):
    case = loaded(tmp_path)
    spec, model = case.augmented({"bob_mass": 0.45})
    assert model.body("bob").mass == pytest.approx(0.45)
    assert "0.45" in spec.to_xml()
    assert case.model.body("bob").mass == pytest.approx(0.3)
    with pytest.raises(ValueError, match="unknown parameter 'bob_mas'; did you mean 'bob_mass'"):
        case.augmented({"bob_mas": 1})
