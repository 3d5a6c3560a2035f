"""Diagnoses of made-up machines with something concealed in them, and of clean ones."""

import json
import re

import jax
import mujoco
import numpy as np
import pytest

from bayessim_jax.cli.main import main
from bayessim_jax.recordings.diagnosing import _lowest, _take_case
from bayessim_jax.recordings.loading import load_case
from bayessim_jax.recordings.repaired import load_repaired
from bayessim_jax.recordings.shots import case_model
from benchmarks.strangers import make_stranger
from benchmarks.worlds import make_case
from tests.browser import CHROMIUM, open_in_chromium
from tests.recordings.made_up_case import columns, write_case


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("diagnoses")


@pytest.fixture(scope="module")
def friction(folder):
    settings = {"seed": 11, "recordings": 4, "seconds": 3.0, "motions": "sines"}
    sealed = make_case(folder / "friction", "pendulum", "coulomb_friction", **settings)
    assert main(["diagnose", str(folder / "friction"), "--out", str(folder / "friction-run"), "--quiet"]) == 0
    assert not jax.config.read("jax_enable_x64")
    table = json.loads((folder / "friction-run" / "diagnosis.json").read_text())
    return folder / "friction-run", table, sealed


def test_dry_friction_is_named_with_its_level(friction):
    _, table, sealed = friction
    assert table["verdict"] == "explained"
    assert [(e["effect"], e["at"]) for e in table["effects"]] == [("coulomb_friction", "joint/hinge")]
    coulomb, level = table["effects"][0]["parameters"]["coulomb"], sealed["effects"][0]["parameters"]["coulomb"]
    assert coulomb["unit"] == "N m" and coulomb["mean"] == pytest.approx(level, rel=0.1)
    assert table["misfit"]["p_value"] < 0.05
    place = table["locations"][0]
    assert place["at"] == "joint/hinge" and place["share"] == 1.0 and place["windows"]
    assert sum(p["share"] for p in table["locations"]) == pytest.approx(1.0, abs=1e-3)


def test_predictions_of_recordings_left_out_get_as_good_as_noise_allows(friction):
    _, table, _ = friction
    fit = table["fit"]
    assert fit["augmented"]["nrmse"] < 0.2 * fit["baseline"]["nrmse"]
    assert fit["augmented"]["nrmse"] < 2.5 * fit["noise_floor"]
    assert fit["augmented"]["log_score"] > fit["baseline"]["log_score"]
    assert len(fit["held_out"]) == 1
    mass = table["parameters"]["rod_mass"]
    assert abs(mass["augmented"]["mean"] - mass["baseline"]["mean"]) > 5 * mass["augmented"]["sd"]


def test_every_candidate_is_told_with_its_score(friction):
    run, table, _ = friction
    finalists, page = table["finalists"], (run / "report.html").read_text()
    (named,) = (each for each in finalists if each["probability"] is not None)
    assert named["effects"] == ["coulomb_friction@joint/hinge"]
    assert named["probability"] == table["effects"][0]["probability"]
    assert finalists[0]["behind"] == finalists[0]["behind_se"] == 0.0
    assert all(each["behind"] >= 0.0 and each["gain_se"] > 0.0 for each in finalists)
    gains = [each["gain"] for each in finalists]
    assert gains == sorted(gains, reverse=True)
    assert finalists[0]["gain"] - named["gain"] == pytest.approx(named["behind"])
    assert named["misfit_left"] < 0.03
    assert {name for each in finalists for name in each["effects"]} <= {each["effect"] for each in table["screened"]}
    assert all(f"<td>{name}" in page for each in finalists for name in each["effects"][:1])


def test_the_run_folder_is_complete_and_the_model_has_the_friction(friction):
    run, table, _ = friction
    for name in ("posterior.nc", "report.html", "config.toml", "run.json", "simulators.json"):
        assert (run / name).stat().st_size > 0
    model = mujoco.MjModel.from_xml_path(str(run / "model_augmented.xml"))
    wanted = table["effects"][0]["parameters"]["coulomb"]["mean"]
    assert model.dof_frictionloss[0] == pytest.approx(wanted, rel=1e-4)
    page = (run / "report.html").read_text()
    assert "Missing is coulomb_friction at joint/hinge" in page
    assert all(f"<h2>{title}" in page for title in ("Where it sits", "What it does", "Replay"))


def test_recordings_given_later_are_scored(friction, folder, capsys):
    run, table, _ = friction
    held = table["fit"]["held_out"][0]
    assert main(["evaluate", str(run), "--recordings", str(folder / "friction" / "recordings" / held)]) == 0
    found = json.loads((run / "evaluation.json").read_text())["fit"]
    assert found["held_out"] == [held]
    ratios = [fit["augmented"]["nrmse"] / fit["baseline"]["nrmse"] for fit in (found, table["fit"])]
    assert ratios[0] == pytest.approx(ratios[1], rel=0.3)  # each over how far its own recordings go
    told = capsys.readouterr()
    assert "augmented" in told.out and told.err == ""
    holed = folder / "holed.csv"
    lines = (folder / "friction" / "recordings" / held).read_text().splitlines()
    lines[20:25] = [re.sub(r"^([^,]*),[^,]*", r"\1,nan", line) for line in lines[20:25]]
    holed.write_text("\n".join(lines) + "\n")
    assert main(["evaluate", str(run), "--recordings", str(holed)]) == 0
    assert capsys.readouterr().err.startswith("warning: holed.csv")
    assert main(["evaluate", str(run), "--recordings", str(folder / "nothing" / "*.csv")]) == 2
    assert main(["evaluate", str(folder), "--recordings", "x.csv"]) == 2
    told = capsys.readouterr().err.strip().splitlines()
    assert len(told) == 2 and "no file matches" in told[0]


def test_the_repaired_simulator_is_there_to_train_on(friction):
    run, table, _ = friction
    repaired = load_repaired(run)
    assert (repaired.verdict, repaired.effects) == ("explained", ("coulomb_friction@joint/hinge",))
    own = table["effects"][0]["parameters"]
    found = [table["parameters"]["rod_mass"]["augmented"], own["coulomb"], own["onset"], own["hold"]]
    np.testing.assert_allclose(repaired.mean, [p["mean"] for p in found], rtol=1e-6)
    np.testing.assert_allclose(repaired.sd, [p["sd"] for p in found], rtol=1e-6)
    settings = json.loads((run / "simulators.json").read_text())
    baseline = settings["simulators"]["baseline"]["noise"]
    assert (repaired.noise > 0).all() and (repaired.noise <= 1.2 * np.array(baseline)).all()


@pytest.mark.parametrize("seed", range(4))
def test_windows_have_their_own_motion_also_of_machines_that_nothing_drives(tmp_path, seed):
    """Which recordings are left out then hangs on where they begin, and smoothing moves what is at rest there."""
    rng, recordings = np.random.default_rng(seed), {}
    for k in range(4):
        data = columns(rows=200)
        data["actuator/motor/ctrl"] *= 0.0
        data["joint/hinge/qpos"] = (k + 1.0) * np.cos(3.0 * data["time"])
        data["joint/hinge/qvel"] = -3.0 * (k + 1.0) * np.sin(3.0 * data["time"])
        for name in ("joint/hinge/qpos", "joint/hinge/qvel"):
            data[name] = data[name] + 1e-3 * rng.normal(size=200)
        recordings[f"run{k}"] = data
    model = case_model(load_case(write_case(tmp_path / "free", **recordings)).check())
    taken = _take_case(jax.random.key(0), model, [], lambda text: None)
    motion, y = taken.problem.motion, np.asarray(taken.problem.shots.y)
    there = np.asarray(taken.problem.shots.measured)[..., 0]
    assert np.abs(np.asarray(motion.qpos)[..., 0] - y[..., 0])[there].max() < 0.02


@pytest.mark.parametrize(("at", "bend"), [(0.4, 3.0), (0.05, 3.0), (0.97, 3.0), (-0.3, 3.0), (1.4, 3.0), (0.2, -3.0)])
def test_the_lowest_place_of_a_parabola_is_found_within_the_places(at, bend):
    places = np.linspace(0.0, 1.0, 5)
    wanted = np.clip(at, 0.0, 1.0) if bend > 0.0 else 1.0
    assert _lowest(places, bend * (places - at) ** 2) == pytest.approx(wanted, abs=1e-9)


@pytest.mark.slow
def test_a_clean_machine_lacks_nothing(folder):
    make_case(folder / "clean", "slide", seed=12)
    assert main(["diagnose", str(folder / "clean"), "--out", str(folder / "clean-run"), "--quiet"]) == 0
    table = json.loads((folder / "clean-run" / "diagnosis.json").read_text())
    assert table["verdict"] == "no_mismatch"
    assert table["effects"] == [] and table["locations"] == [] and table["confusion_set"] == []


@pytest.mark.slow
def test_what_no_candidate_explains_is_refused_and_located(folder):
    make_case(folder / "beat", "pendulum", "unknown:beat", seed=13)
    assert main(["diagnose", str(folder / "beat"), "--out", str(folder / "beat-run"), "--quiet"]) == 0
    table = json.loads((folder / "beat-run" / "diagnosis.json").read_text())
    assert table["verdict"] == "unexplained"
    assert table["effects"] == [] and table["locations"][0]["at"] == "joint/hinge"
    # nothing is put in, so nothing is changed: neither here nor where the simulators are run again
    assert all(found["augmented"] == found["baseline"] for found in table["parameters"].values())
    later = folder / "beat" / "recordings" / table["fit"]["held_out"][0]
    assert main(["evaluate", str(folder / "beat-run"), "--recordings", str(later), "--quiet"]) == 0
    fit = json.loads((folder / "beat-run" / "evaluation.json").read_text())["fit"]
    assert fit["augmented"] == fit["baseline"]


@pytest.mark.slow
def test_commands_that_are_recorded_a_row_late_are_told(folder):
    make_case(folder / "mistimed", "pendulum", seed=16)
    for path in (folder / "mistimed" / "recordings").glob("*.csv"):
        head, table = path.read_text().partition("\n")[0], np.loadtxt(path, delimiter=",", skiprows=1)
        last = [i for i, name in enumerate(head.split(",")) if name.startswith("actuator")]
        table[1:, last] = table[:-1, last]
        np.savetxt(path, table[1:], fmt="%.9g", delimiter=",", header=head, comments="")
    assert main(["diagnose", str(folder / "mistimed"), "--out", str(folder / "mistimed-run"), "--quiet"]) == 0
    table = json.loads((folder / "mistimed-run" / "diagnosis.json").read_text())
    assert table["verdict"] == "unexplained" and "when commands are recorded" in table["next_experiment"]
    assert "recorded a row too late" in (folder / "mistimed-run" / "report.html").read_text()


@pytest.mark.slow
def test_what_noise_hides_in_short_pieces_is_named_in_long_ones(folder):
    """In 0.16 s the friction of this carriage has a hundredth of the noise's power."""
    machine = {"rig": "carriage", "effects": ["viscous_friction"], "size": 0.276, "damped": False, "seed": 200_032}
    motion = {"motion": "chirp", "feedback": False, "rate": 500, "seconds": 4.0, "recordings": 5}
    sensors = {"velocities": False, "filter": 0.0, "noise": 0.003, "jitter": 0.1}
    make_stranger(folder / "noisy", machine | motion | sensors | {"integrator": "RK4", "timestep": 0.002})
    assert main(["diagnose", str(folder / "noisy"), "--out", str(folder / "noisy-run"), "--quiet"]) == 0
    table = json.loads((folder / "noisy-run" / "diagnosis.json").read_text())
    assert table["confusion_set"] == [["viscous_friction@joint/rail"], ["back_emf@actuator/drive"]]
    assert all(entry["misfit_left"] < 0.03 for entry in table["finalists"][:2])


@pytest.mark.slow
def test_two_effects_that_hide_each_other_are_both_named(folder):
    """Neither of them leads by itself: what gains most alone is another."""
    effects = ["actuator_lag", "quadratic_drag"]
    make_case(folder / "pair", "slide", effects, strength=0.4, noise=3.0, seed=15)
    assert main(["diagnose", str(folder / "pair"), "--out", str(folder / "pair-run"), "--quiet"]) == 0
    table = json.loads((folder / "pair-run" / "diagnosis.json").read_text())
    assert table["verdict"] == "explained"
    assert sorted(e["effect"] for e in table["effects"]) == effects


@pytest.mark.slow
def test_what_is_found_beside_another_effect_is_tried_by_itself(folder):
    """A drop by itself is fitted at another time; beside a drift that is hardly there it is found where it is."""
    make_case(folder / "drop", "slide", "gain_drop", strength=0.516, noise=3.0, finer=4, seed=5300040)
    assert main(["diagnose", str(folder / "drop"), "--out", str(folder / "drop-run"), "--quiet"]) == 0
    table = json.loads((folder / "drop-run" / "diagnosis.json").read_text())
    assert [e["effect"] for e in table["effects"]] == ["gain_drop"]


@pytest.mark.slow
def test_a_spring_with_hysteresis_is_named_however_it_was_bent_before(folder):
    """A rod that is let go in mid-swing: how far it is bent then does not follow from its state."""
    make_case(folder / "bent", "swing", "hysteresis", strength=0.409, velocities=False, finer=4, seed=5500100)
    assert main(["diagnose", str(folder / "bent"), "--out", str(folder / "bent-run"), "--quiet"]) == 0
    table = json.loads((folder / "bent-run" / "diagnosis.json").read_text())
    assert [e["effect"] for e in table["effects"]] == ["hysteresis"]


@pytest.mark.slow
def test_gains_that_the_masses_trade_for_each_other_are_both_told(folder):
    """One motor's gain is as good as the other's where all masses are unknown."""
    make_case(folder / "gain", "double", "actuator_gain", strength=0.296, velocities=False, finer=4, seed=5600098)
    assert main(["diagnose", str(folder / "gain"), "--out", str(folder / "gain-run"), "--quiet"]) == 0
    table = json.loads((folder / "gain-run" / "diagnosis.json").read_text())
    assert {tuple(names) for names in table["confusion_set"]} == {
        ("actuator_gain@actuator/m1",),
        ("actuator_gain@actuator/m2",),
    }


@pytest.mark.slow
def test_a_tilt_is_the_same_as_an_offset_however_large(folder):
    settings = {"strength": 0.539, "noise": 0.3, "quantize": 2048, "jitter": 0.3, "finer": 4, "seed": 5300049}
    sealed = make_case(folder / "tilt", "swing", "base_tilt", **settings)
    assert abs(sealed["effects"][0]["parameters"]["angle"]) > 0.5
    assert main(["diagnose", str(folder / "tilt"), "--out", str(folder / "tilt-run"), "--quiet"]) == 0
    table = json.loads((folder / "tilt-run" / "diagnosis.json").read_text())
    assert {"base_tilt", "sensor_offset"} <= {names[0].partition("@")[0] for names in table["confusion_set"]}


@pytest.mark.slow
def test_a_limit_that_is_always_behind_its_command_is_named(folder):
    """Its memory is longer than any window, and without it θ is driven to the edge of its prior."""
    make_case(folder / "late", "slide", "actuator_rate_limit", strength=0.5, seed=16)
    assert main(["diagnose", str(folder / "late"), "--out", str(folder / "late-run"), "--quiet"]) == 0
    table = json.loads((folder / "late-run" / "diagnosis.json").read_text())
    assert [e["effect"] for e in table["effects"]] == ["actuator_rate_limit"]


@pytest.mark.skipif(CHROMIUM is None, reason="Chromium is not installed")
def test_the_reports_scripts_run_and_draw(friction, tmp_path):
    page = (friction[0] / "report.html").read_text()
    dom, errors = open_in_chromium(page, tmp_path)
    assert errors == []
    assert len(re.findall(r"<canvas[^>]* style=.height", dom)) == 2  # traces and replay
