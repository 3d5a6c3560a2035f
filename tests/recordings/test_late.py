"""Velocities behind a filter are found, told, and not used."""

import re
import shutil
from pathlib import Path

import mujoco
import numpy as np
import pytest

from bayessim_jax.recordings.late import Lateness, measure_lag
from bayessim_jax.recordings.loading import load_case
from bayessim_jax.recordings.shots import case_model, split_windows
from bayessim_jax.recordings.stepping import ratio_of_motion
from benchmarks.strangers import STEP, draw_strangers, make_stranger
from benchmarks.worlds import make_case
from tests.recordings.made_up_case import MODEL, columns, write_case

TAU = 0.006


def _filter(path: Path, tau: float) -> None:
    """Put every velocity of a recording behind a low-pass filter of the first order."""
    text = path.read_text().splitlines()
    names, table = text[0].split(","), np.loadtxt(path, delimiter=",", skiprows=1)
    time, columns = table[:, 0], [k for k, name in enumerate(names) if name.endswith("/qvel")]
    fine = np.linspace(time[0], time[-1], 20 * len(time))
    share = 1.0 - np.exp(-(fine[1] - fine[0]) / tau)
    for k in columns:
        behind = np.interp(fine, time, table[:, k])
        for i in range(1, len(fine)):
            behind[i] = behind[i - 1] + share * (behind[i] - behind[i - 1])
        table[:, k] = np.interp(time, fine, behind)
    np.savetxt(path, table, delimiter=",", header=",".join(names), comments="", fmt="%.10g")


@pytest.fixture(scope="module")
def prompt(tmp_path_factory):
    folder = tmp_path_factory.mktemp("prompt") / "case"
    make_case(folder, "slide", recordings=3, seconds=4.0, rate=125.0, noise=1.0, seed=3)
    return folder


@pytest.fixture
def late(prompt, tmp_path):
    folder = tmp_path / "late"
    shutil.copytree(prompt, folder)
    for path in sorted((folder / "recordings").glob("*.csv")):
        _filter(path, TAU)
    return folder


@pytest.mark.parametrize("lag", [-0.004, 0.0, 0.0005, 0.004])
def test_the_lag_is_measured_whatever_the_scale(lag):
    """Two sines, and a position in other units; a position that is late itself makes the lag negative."""
    rng, time = np.random.default_rng(0), np.arange(300) / 125.0

    def motion(t):
        return 0.4 * np.sin(5.0 * t) + 0.1 * np.sin(13.0 * t + 1.0), 2.0 * np.cos(5.0 * t) + 1.3 * np.cos(
            13.0 * t + 1.0
        )

    starts = rng.uniform(0.0, 60.0, (8, 1))
    q = 1.1 * motion(starts + time)[0] + 2e-4 * rng.standard_normal((8, 300))
    v = motion(starts + time - lag)[1] + 2e-2 * rng.standard_normal((8, 300))
    ((found, sd),) = measure_lag(np.tile(time, (8, 1)), q, v, np.ones(q.shape, bool))
    assert sd < 1e-3
    assert found == pytest.approx(lag, abs=4 * sd + 2e-5)


def test_late_velocities_are_told_and_not_used(prompt, late):
    before, after = load_case(prompt), load_case(late)
    assert before.lateness.channels == ()
    assert not [f for f in before.findings if "later" in f.what]
    assert all(r.qvel_measured.all() for r in before.recordings)
    assert after.lateness.channels == after.layout.qvel
    assert not any(r.qvel_measured.any() for r in after.recordings)
    told = [str(f) for f in after.findings if "later" in f.what]
    assert len(told) == 1
    assert float(re.search(r"/qvel is ([\d.]+) ms later", told[0])[1]) == pytest.approx(1e3 * TAU, rel=0.1)
    assert "record it without a filter" in told[0]
    # what they are taken from instead is no later
    for r, other in zip(before.recordings, after.recordings, strict=True):
        inner = slice(20, -20)
        error = other.qvel[inner, 0] - r.qvel[inner, 0]
        assert np.sqrt((error**2).mean()) < 0.1 * r.qvel[inner, 0].std()


def test_velocities_from_backward_differences_are_half_a_row_late(prompt, tmp_path):
    folder = tmp_path / "differences"
    shutil.copytree(prompt, folder)
    for path in sorted((folder / "recordings").glob("*.csv")):
        names, table = path.read_text().splitlines()[0], np.loadtxt(path, delimiter=",", skiprows=1)
        columns = names.split(",")
        q, v = (next(k for k, name in enumerate(columns) if name.endswith(end)) for end in ("/qpos", "/qvel"))
        table[1:, v] = np.diff(table[:, q]) / np.diff(table[:, 0])
        np.savetxt(path, table, delimiter=",", header=names, comments="", fmt="%.10g")
    (told,) = [f for f in load_case(folder).findings if "later" in f.what]
    assert float(re.search(r"is ([\d.]+) ms later", told.what)[1]) == pytest.approx(4.0, abs=0.2)


@pytest.mark.parametrize(("kv", "tau"), [(2.0, 0.0), (0.2, TAU)])
def test_a_velocity_that_jumps_where_a_command_does_is_not_late(tmp_path, kv, tau):
    """A stiff servo follows a command within a row, so that a velocity is that of the row before; a filter is found."""
    servo = f'<position name="motor" joint="hinge" kp="{10.0 * kv}" kv="{kv}"/>'
    model = re.sub("<motor .*/>", servo, MODEL).replace('mass="0.3"', 'mass="0.01"')
    compiled, rows, rng = mujoco.MjModel.from_xml_string(model), 600, np.random.default_rng(0)
    data, table = mujoco.MjData(compiled), np.zeros((600, 4))
    for k in range(rows):
        data.ctrl[0] = np.sin(0.05 * k) + 0.1 * rng.standard_normal()
        table[k] = data.time, data.qpos[0], data.qvel[0], data.ctrl[0]
        mujoco.mj_step(compiled, data, 5)
    folder = write_case(tmp_path / "case", model=model, run1=dict(zip(columns(), table.T, strict=True)))
    if tau:
        _filter(folder / "recordings" / "run1.csv", tau)
    assert load_case(folder).lateness == Lateness(("joint/hinge/qvel",) if tau else ())


def test_recordings_that_come_later_are_read_alike(late, prompt):
    """A diagnosis' simulators know no velocities, so recordings given to `evaluate` have none either."""
    from bayessim_jax.recordings.evaluation import with_recordings

    case = load_case(late)
    more = with_recordings(case, str(prompt / "recordings" / "*.csv"))
    assert not any(r.qvel_measured.any() for r in more.recordings)


def test_velocities_late_by_half_a_step_are_steps(tmp_path):
    """Of a machine that was simulated by semi-implicit Euler, and is believed to be one of Runge and Kutta."""
    drawn = draw_strangers(1, 5)[0] | {"rig": "arm", "group": "clean", "effects": [], "filter": 0.0, "jitter": 0.0}
    case = drawn | {"seconds": 6.0, "recordings": 3, "rate": 100, "noise": 1e-4, "velocities": True, "timestep": 0.002}
    for integrator, stepped in (("RK4", True), ("Euler", False)):
        make_stranger(tmp_path / integrator, case | {"integrator": integrator})
        loaded = load_case(tmp_path / integrator).check()
        assert loaded.lateness == Lateness((), stepped)
        model = case_model(loaded)
        assert model.compiled.opt.integrator == mujoco.mjtIntegrator.mjINT_EULER
        assert any("instead of Runge-Kutta" in remark for remark in model.remarks) == stepped
    s, sd = ratio_of_motion(model, split_windows(model)[0])
    assert s == pytest.approx(STEP / 0.002, abs=3.0 * sd)
