"""The recordings of real rigs: every case is read, and what is told of it is what is known of the rig."""

import json
import os
from pathlib import Path

import numpy as np
import pytest

from bayessim_jax.cli.main import main
from bayessim_jax.recordings.loading import load_case
from benchmarks.thresholds import FAMILIES

ROOT = Path(__file__).parents[2]
CASES = Path(os.environ.get("BAYESSIM_CASES", ROOT.parent / "shared" / "data" / "cases"))
pytestmark = pytest.mark.skipif(not CASES.is_dir(), reason="the real recordings are not here; set BAYESSIM_CASES")

KNOWN = {
    # case: (recordings, rows of the first one, rate in Hz, measured velocities, windows)
    "emps": (5, 1242, 250, 0, 45),
    "dfki_double_pendulum": (10, 1999, 250, 2, 142),
    "dfki_simple_pendulum": (4, 749, 250, 1, 16),
    "multiarm_single": (4, 2292, 250, 1, 16),
    "multiarm_double": (12, 667, 250, 2, 24),
    "bam_xl330": (8, 1198, 200, 0, 88),
    "contactnets_cube": (20, 105, 148, 6, 20),
}


@pytest.mark.parametrize("name", KNOWN)
def test_a_case_is_read_without_remarks(name):
    loaded = load_case(CASES / name).check()
    assert loaded.findings == ()
    recordings, rows, rate, velocities, windows = KNOWN[name]
    first = loaded.recordings[0]
    assert (len(loaded.recordings), len(first.time), round(1 / first.step)) == (recordings, rows, rate)
    assert int(first.qvel_measured.all(0).sum()) == velocities
    stacked = loaded.windows()
    assert len(stacked) == windows
    assert stacked.valid.all(1).all() or name == "contactnets_cube"
    np.testing.assert_allclose(stacked.time.max(1), loaded.case.horizon, atol=first.step / 2)
    for parameter in loaded.parameters:
        assert parameter.prior.low <= parameter.nominal <= parameter.prior.high
        _, model = loaded.augmented({parameter.name: parameter.prior.mean})
        assert model.nq == loaded.model.nq


@pytest.mark.parametrize("name", ["multiarm_single", "multiarm_double", "dfki_double_pendulum"])
def test_estimated_velocities_agree_with_those_of_the_authors(name):
    loaded = load_case(CASES / name)
    from bayessim_jax.recordings.velocity import estimate_slopes

    for recording in loaded.recordings[:3]:
        for i in range(recording.qpos.shape[1]):
            slopes, _ = estimate_slopes(recording.time, recording.qpos[:, i], ~recording.valid)
            assert np.std(slopes - recording.qvel[:, i]) < 0.05 * np.std(recording.qvel[:, i])


@pytest.mark.parametrize("name", ["warthog_asphalt", "warthog_ice"])
def test_a_case_of_a_registered_system(name):
    loaded = load_case(CASES / name).check()
    assert len(loaded.recordings) == 60
    assert [p.targets for p in loaded.parameters] == [("wheel_radius",), ("axial_distance",), ("icr_offset",)]
    unused = [finding for finding in loaded.findings if "unknown column" in finding.what]
    assert [(f.what, f.others) for f in unused] == [
        ("unknown column 'wheel/left' is not used", 59),
        ("unknown column 'wheel/right' is not used", 59),
    ]
    assert len(unused) == len(loaded.findings)
    stacked = loaded.windows()
    assert stacked.sensors.shape[1:] == (21, 3)
    assert stacked.sensors_measured.all()
    assert len(stacked) == 60


@pytest.mark.slow
@pytest.mark.parametrize("name", ["warthog_asphalt", "warthog_ice"])
def test_the_geometry_of_a_real_vehicle_predicts_windows_that_were_left_out(name, tmp_path):
    """Slip and a late powertrain are not in the model, so what is found is a geometry that makes up for them."""
    assert main(["infer", str(CASES / name), "--out", str(tmp_path / "run"), "--quiet"]) == 0
    found = json.loads((tmp_path / "run" / "inference.json").read_text())
    assert found["fit"]["held_out"]
    assert found["fit"]["posterior"]["nrmse"] < 0.8 * found["fit"]["baseline"]["nrmse"]
    assert set(found["parameters"]) == {"wheel_radius", "axial_distance", "icr_offset"}
    assert found["parameters"]["axial_distance"]["mean"] > 1.4


DRY = set(FAMILIES["dry friction"])


def diagnosed(name, tmp_path):
    """What `bayessim diagnose` says of a rig, and the sets that it cannot tell apart, each as {(effect, place), …}."""
    assert main(["diagnose", str(CASES / name), "--out", str(tmp_path / "run"), "--quiet"]) == 0
    table = json.loads((tmp_path / "run" / "diagnosis.json").read_text())
    best = [f"{e['effect']}@{e['at']}" for e in table["effects"]]
    return table, [{tuple(n.split("@", 1)) for n in names} for names in table["confusion_set"] or [best]]


def shrinks(table, share):
    """Whether the error on recordings left out is at most a share of what it was."""
    return table["fit"]["augmented"]["nrmse"] <= share * table["fit"]["baseline"]["nrmse"]


@pytest.mark.slow
def test_a_free_arm_lacks_viscous_friction_and_no_dry_one(tmp_path):
    table, sets = diagnosed("multiarm_single", tmp_path)
    assert sets[0] == {("viscous_friction", "joint/hinge")}
    assert not any(effect in DRY for names in sets for effect, _ in names)
    assert shrinks(table, 0.25)


@pytest.mark.slow
def test_a_rail_lacks_viscous_friction_and_dry_friction_with_two_levels(tmp_path):
    table, sets = diagnosed("emps", tmp_path)
    assert {("viscous_friction", "joint/rail"), ("asymmetric_friction", "joint/rail")} in sets
    assert all(("asymmetric_friction", "joint/rail") in names for names in sets)
    found = {(e["effect"], name): p["mean"] for e in table["effects"] for name, p in e["parameters"].items()}
    assert found.get(("viscous_friction", "viscous"), 203.5) == pytest.approx(203.5, rel=0.1)  # the authors' value
    assert shrinks(table, 0.06)


@pytest.mark.slow
def test_geared_joints_lack_dry_friction_and_a_rotor(tmp_path):
    table, sets = diagnosed("dfki_double_pendulum", tmp_path)
    for names in sets:
        assert {place for effect, place in names if effect in DRY} == {"joint/shoulder", "joint/elbow"}, sets
        assert {effect for effect, _ in names} <= DRY | {"armature"}, sets
    assert any(effect == "armature" for names in sets for effect, _ in names)
    assert shrinks(table, 0.25)
