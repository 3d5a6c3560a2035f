"""Diagnoses of a registered system: a skid-steered vehicle with something left out, simulated in NumPy."""

import json
import os
import re
from pathlib import Path

import jax
import pytest

from bayessim_jax.cli.main import main
from bayessim_jax.effects import EFFECTS
from bayessim_jax.recordings.diagnosing import diagnose_case
from bayessim_jax.recordings.loading import load_case
from bayessim_jax.recordings.shots import case_model
from benchmarks.vehicle import THETA, Vehicle, write_case
from tests.browser import CHROMIUM, open_in_chromium

ROOT = Path(__file__).parents[2]
CASES = Path(os.environ.get("BAYESSIM_CASES", ROOT.parent / "shared" / "data" / "cases"))
LEFT, RIGHT, BOTH = "actuator/input/left", "actuator/input/right", "actuator/*"
ABSORBED = [f"actuator_gain@{BOTH}", f"wheel_slip@{LEFT}"]
"""By the wheels' radius and distance."""


def diagnosed(folder, vehicle, seed=0):
    case = write_case(folder / "case", vehicle, seed)
    assert main(["diagnose", str(case), "--out", str(folder / "run"), "--quiet"]) == 0
    return json.loads((folder / "run" / "diagnosis.json").read_text())


def named(table):
    return {(e["effect"], e["at"]): {n: p["mean"] for n, p in e["parameters"].items()} for e in table["effects"]}


@pytest.fixture
def double():
    jax.config.update("jax_enable_x64", True)
    yield
    jax.config.update("jax_enable_x64", False)


@pytest.mark.slow
def test_late_wheels_on_one_side_are_named_among_few(tmp_path, double):
    case = write_case(tmp_path / "case", Vehicle(lag=(0.15, 0.0)), seed=1, recordings=5, rows=80)
    model = case_model(load_case(case).check(), before=1.0)
    few = [EFFECTS[name] for name in ("actuator_lag", "wheel_slip")]
    table = diagnose_case(jax.random.key(0), model, effects=few).table()
    assert table["verdict"] == "explained"
    assert named(table) == {("actuator_lag", LEFT): {"time_constant": pytest.approx(0.15, abs=0.015)}}
    assert [(place["at"], place["share"]) for place in table["locations"]] == [(LEFT, 1.0)]
    assert table["absorbed"] == ABSORBED[1:]


@pytest.fixture(scope="module")
def late(tmp_path_factory):
    folder = tmp_path_factory.mktemp("late")
    return folder, diagnosed(folder, Vehicle(lag=(0.12, 0.25)))


@pytest.mark.slow
def test_late_wheels_of_both_sides_are_named_with_their_times(late):
    folder, table = late
    assert table["verdict"] == "explained"
    wanted = {("actuator_lag", LEFT): 0.12, ("actuator_lag", RIGHT): 0.25}
    assert named(table) == {k: {"time_constant": pytest.approx(time, rel=0.1)} for k, time in wanted.items()}
    shares = {place["at"]: place["share"] for place in table["locations"]}
    assert shares[RIGHT] > shares[LEFT] > 0.1
    fit = table["fit"]
    assert fit["augmented"]["nrmse"] < 0.75 * fit["baseline"]["nrmse"]
    assert "flexible" not in fit
    for name, true in zip(("wheel_radius", "axial_distance", "icr_offset"), THETA, strict=True):
        found = table["parameters"][name]["augmented"]
        assert abs(found["mean"] - true) < 4 * found["sd"]
    for name in ("posterior.nc", "report.html", "simulators.json"):
        assert (folder / "run" / name).stat().st_size > 0


@pytest.mark.slow
def test_its_simulators_are_scored_on_recordings_given_later(late, tmp_path):
    folder, _ = late
    later = write_case(tmp_path / "later", Vehicle(lag=(0.12, 0.25)), seed=9, recordings=3)
    words = ["evaluate", str(folder / "run"), "--recordings", str(later / "recordings" / "*.csv"), "--quiet"]
    assert main(words) == 0
    fit = json.loads((folder / "run" / "evaluation.json").read_text())["fit"]
    assert fit["augmented"]["nrmse"] < 0.8 * fit["baseline"]["nrmse"]


@pytest.mark.slow
def test_training_on_it_is_refused_in_one_line(late, tmp_path, capsys):
    folder, _ = late
    assert main(["online", "--from", str(folder / "run"), "--out", str(tmp_path / "online")]) == 2
    told = capsys.readouterr().err
    assert "is of the registered system skid_steer; train on that: bayessim online skid_steer." in told


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="Chromium is not installed")
def test_its_report_runs_without_complaints(late, tmp_path):
    folder, _ = late
    page, complaints = open_in_chromium((folder / "run" / "report.html").read_text(), tmp_path)
    assert not complaints
    assert "Not there to be found" in page


@pytest.mark.slow
def test_a_delay_of_both_sides_is_named(tmp_path):
    table = diagnosed(tmp_path, Vehicle(delay=0.2))
    assert table["verdict"] == "explained"
    wanted = {"seconds": pytest.approx(0.2, abs=0.02)}
    assert named(table) == {("actuator_delay", BOTH): wanted}


@pytest.mark.slow
def test_a_lag_does_not_stand_for_a_delay_beside_it(tmp_path):
    """A longer lag leaves a hundredth of the misfit, which shows."""
    table = diagnosed(tmp_path, Vehicle(lag=(0.17, 0.17), delay=0.1))
    assert named(table) == {
        ("actuator_delay", BOTH): {"seconds": pytest.approx(0.1, abs=0.015)},
        ("actuator_lag", BOTH): {"time_constant": pytest.approx(0.17, abs=0.02)},
    }


@pytest.mark.slow
@pytest.mark.parametrize("slip", [0.0, 0.2])
def test_nothing_is_missing_where_slip_is_a_smaller_and_wider_vehicle(tmp_path, slip):
    """A vehicle that slips is the one with r (1 − s) and d (1 − s)/(1 − c)."""
    table = diagnosed(tmp_path, Vehicle(slip=slip, turning_slip=0.9 * slip))
    assert table["verdict"] == "no_mismatch"
    assert table["effects"] == [] and table["locations"] == []
    assert table["absorbed"] == ABSORBED
    radius = table["parameters"]["wheel_radius"]["baseline"]
    assert abs(radius["mean"] - THETA[0] * (1 - slip)) < 4 * radius["sd"]


@pytest.mark.slow
def test_friction_of_turning_that_changes_in_time_is_no_effect_of_the_library(tmp_path):
    table = diagnosed(tmp_path, Vehicle(turning_slip=0.35, swing=0.3))
    assert table["verdict"] == "unexplained"
    assert table["effects"] == []
    assert table["locations"][0]["at"] == "base/yaw"


@pytest.mark.slow
@pytest.mark.skipif(not CASES.is_dir(), reason="the real recordings are not here; set BAYESSIM_CASES")
def test_a_real_vehicle_lacks_more_than_two_effects(tmp_path):
    """Its authors: lag and delay of each side's wheels, and slip, which the geometry can take the place of.

    Whether the wheels lag or wait is not told: no command changes within a recording.
    """
    assert main(["diagnose", str(CASES / "warthog_asphalt"), "--out", str(tmp_path / "run"), "--quiet"]) == 0
    table = json.loads((tmp_path / "run" / "diagnosis.json").read_text())
    assert table["verdict"] == "unexplained"
    assert table["misfit"]["p_value"] < 0.05
    assert table["absorbed"] == ABSORBED
    closest = re.search("The closest, (.*), leaves", (tmp_path / "run" / "report.html").read_text())
    assert closest and re.search(r"actuator_(lag|delay)@actuator/\*", closest.group(1))
