"""`bayessim infer` as a person runs it."""

import json
import re

import mujoco
import numpy as np
import pytest
import xarray as xr

from bayessim_jax.cli.main import main
from bayessim_jax.recordings.results import sample_models
from benchmarks.worlds import make_case
from tests.browser import CHROMIUM, open_in_chromium


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("infer")
    sealed = make_case(folder / "rig", "slide", seed=2, recordings=3, seconds=2.0)
    assert main(["infer", str(folder / "rig"), "--out", str(folder / "run"), "--quiet"]) == 0
    return folder, sealed


def test_the_run_folder_holds_what_was_learned(run):
    folder, sealed = run
    table = json.loads((folder / "run" / "inference.json").read_text())
    mass = table["parameters"]["carriage_mass"]
    assert mass["q05"] < mass["mean"] < mass["q95"]
    assert mass["mean"] == pytest.approx(sealed["parameters"]["carriage_mass"], abs=6 * mass["sd"])
    assert table["fit"]["posterior"]["nrmse"] < table["fit"]["baseline"]["nrmse"]
    assert set(table["fit"]["posterior"]["per_channel"]) == {"joint/rail/qpos", "joint/rail/qvel"}
    assert table["fit"]["held_out"] and table["identifiability"]["not_informed"] == []
    facts = json.loads((folder / "run" / "run.json").read_text())
    assert facts["status"] == "finished" and facts["seconds"] > 0
    with xr.open_datatree(folder / "run" / "posterior.nc", engine="h5netcdf") as tree:
        draws = tree["posterior"]["carriage_mass"].values
        assert draws.shape == (1, 2000)
        assert tree["posterior"]["carriage_mass"].attrs["units"] == "kg"
        assert draws.mean() == pytest.approx(mass["mean"], rel=1e-6)
        assert {"prior", "posterior", "posterior_predictive", "observed_data"} <= set(tree.children)


@pytest.mark.slow
def test_networks_leave_the_same_files_and_say_how_they_were_judged(run):
    folder, _ = run
    words = ["infer", str(folder / "rig"), "--out", str(folder / "networks"), "--method", "amortised", "--quiet"]
    assert main(words) == 0
    files = [{p.name for p in (folder / name).iterdir()} for name in ("run", "networks")]
    assert files[0] == files[1]
    direct, found = (json.loads((folder / name / "inference.json").read_text()) for name in ("run", "networks"))
    assert set(direct) == set(found) and (direct["method"], found["method"]) == ("direct", "amortised")
    assert json.loads((folder / "networks" / "run.json").read_text())["method"] == "amortised"
    theirs, ours = direct["parameters"]["carriage_mass"], found["parameters"]["carriage_mass"]
    assert ours["mean"] == pytest.approx(theirs["mean"], abs=theirs["sd"])
    assert 0.8 * theirs["sd"] < ours["sd"] < 1.6 * theirs["sd"]
    assert direct["calibration"] is None
    assert found["calibration"]["coverage50"] == pytest.approx(0.5, abs=0.15)
    assert found["calibration"]["coverage90"] == pytest.approx(0.9, abs=0.1)
    assert found["fit"]["held_out"] == direct["fit"]["held_out"]
    with xr.open_datatree(folder / "networks" / "posterior.nc", engine="h5netcdf") as tree:
        drawn = tree["posterior"]["carriage_mass"]
        assert ((drawn.values > drawn.attrs["prior_low"]) & (drawn.values < drawn.attrs["prior_high"])).all()
    assert "of simulated recordings" in (folder / "networks" / "report.html").read_text()


def test_the_model_comes_out_with_the_mean_in_it(run):
    folder, _ = run
    mean = json.loads((folder / "run" / "inference.json").read_text())["parameters"]["carriage_mass"]["mean"]
    model = mujoco.MjModel.from_xml_path(str(folder / "run" / "model_posterior.xml"))
    assert model.body("carriage").mass[0] == pytest.approx(mean, rel=1e-4)  # MuJoCo writes six digits
    models = sample_models(folder / "run", 5, seed=1)
    masses = [m.body("carriage").mass[0] for m in models]
    assert len(set(masses)) == 5
    assert np.mean(masses) == pytest.approx(mean, rel=0.01)


def test_a_used_folder_and_slips_are_refused_in_one_line(run, capsys):
    folder, _ = run
    before = (folder / "run" / "inference.json").read_bytes()
    assert main(["infer", str(folder / "rig"), "--out", str(folder / "run")]) == 2
    assert (folder / "run" / "inference.json").read_bytes() == before
    assert main(["infer", str(folder / "rig"), "--metod", "direct"]) == 2
    assert main(["infer", str(folder / "rig"), "--method", "amortized", "--out", str(folder / "other")]) == 2
    assert main(["infer", str(folder / "nowhere")]) == 2
    assert main(["infer", str(folder / "rig"), "--draws", "3", "--out", str(folder / "other")]) == 2
    told = capsys.readouterr().err.strip().splitlines()
    assert len(told) == 5
    assert (
        "already used" in told[0]
        and "--method" in told[1]
        and "'amortised'" in told[2]
        and not (folder / "other").exists()
    )


def test_the_report_is_one_page_that_shows_everything(run):
    folder, _ = run
    page = (folder / "run" / "report.html").read_text()
    assert "carriage_mass is" in page and page.count("<canvas") == 2 and page.count("<svg") >= 3
    assert "http" not in page.replace("http://www.w3.org", "").replace("http-equiv", "")


@pytest.mark.skipif(CHROMIUM is None, reason="Chromium is not installed")
def test_the_reports_scripts_run_and_draw(run, tmp_path):
    page = (run[0] / "run" / "report.html").read_text()
    dom, errors = open_in_chromium(page, tmp_path)
    assert errors == []
    assert len(re.findall(r"<canvas[^>]* style=.height", dom)) == 2
