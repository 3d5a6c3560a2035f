"""`bayessim online --from RUN`: what is refused, and a small run on the simulator of a diagnosis."""

import json
import tomllib

import numpy as np
import pytest

from bayessim_jax.cli.main import main
from bayessim_jax.cli.options import Settings
from bayessim_jax.cli.plan import make_plan
from bayessim_jax.cli.resolution import read_command
from tests.cli.test_online_command import own_settings as own_settings
from tests.cli.test_online_command import refused
from tests.recordings.diagnosed import RIG, write_diagnosis
from tests.recordings.made_up_case import columns

LEARNER = "[learner]\nepisodes = 4\nepisode_steps = 20\nenvs = 2\nhorizon = 20\nupdates = 4\nbatch = 16\n"
PLANNER = "[learner]\nhorizon = 6\nsamples = 8\n"
COULOMB = "coulomb_friction@joint/hinge/coulomb"


@pytest.fixture(scope="module")
def diagnosis(tmp_path_factory):
    return write_diagnosis(tmp_path_factory.mktemp("diagnosed"))


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("pendulum --from RUN", "--from is for the simulator of a diagnosis; leave out pendulum or --from."),
        ("pendulum --goal joint/hinge=1", "--goal is for the simulator of a diagnosis"),
        ("diagnosed", "add --from RUN, its run folder."),
        ("--from NOWHERE", "no run in"),
        ("--from RUN --goal joint/hing=1", "goal: unknown joint 'joint/hing': did you mean 'joint/hinge'?"),
        ("--from RUN --goal joint/hinge=nan", "goal joint/hinge=nan is not a pose"),
        ("--from RUN --truth bob_mass=0.5", "truth bob_mass=0.5 lies outside the prior"),
        ("--from RUN --target gymnasium", "add --target simulated"),
        ("--from RUN --controller her", "hindsight needs a task with goals"),
    ],
)
def test_bad_words(capsys, tmp_path, diagnosis, words, message):
    places = {"RUN": diagnosis, "NOWHERE": tmp_path / "nowhere"}
    words = [places.get(word, word) for word in words.split()]
    assert message in refused(capsys, *words, "--out", tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_what_is_no_diagnosis(capsys, tmp_path):
    run = write_diagnosis(tmp_path)
    config = run / "config.toml"
    diagnosed = config.read_text()
    for text, command in ((diagnosed.replace('"diagnose"', '"infer"'), "infer"), ('system = "cartpole"', "online")):
        config.write_text(text)
        told = refused(capsys, "--from", run, "--out", tmp_path / "out")
        assert f"holds a run of bayessim {command}; give a folder that bayessim diagnose wrote" in told
    config.write_text(diagnosed)
    state = json.loads((run / "simulators.json").read_text())
    del state["simulators"]["augmented"]["noise"]
    (run / "simulators.json").write_text(json.dumps(state))
    told = refused(capsys, "--from", run, "--out", tmp_path / "out")
    assert "lacks 'noise', as of an earlier version; run bayessim diagnose again" in told
    (run / "simulators.json").write_text("{")
    assert "simulators.json is missing or damaged" in refused(capsys, "--from", run, "--out", tmp_path / "out")
    (run / "diagnosis.json").unlink()
    assert "diagnosis.json is missing or damaged" in refused(capsys, "--from", run, "--out", tmp_path / "out")


def test_what_cannot_be_driven_or_planned_for(capsys, tmp_path):
    passive = RIG[: RIG.index("  <actuator>")] + RIG[RIG.index("  <sensor>") :]
    seen = columns()
    del seen["actuator/motor/ctrl"]
    run = write_diagnosis(tmp_path / "passive", model=passive, run1=seen)
    assert "its simulator has no actuator" in refused(capsys, "--from", run, "--out", tmp_path / "out")
    blind = columns()
    del blind["joint/hinge/qvel"]
    run = write_diagnosis(tmp_path / "blind", run1=blind)
    told = refused(capsys, "--from", run, "--controller", "mppi", "--out", tmp_path / "out")
    assert "mppi cannot plan" in told and "joint/hinge/qvel is missing" in told and "--controller sac" in told


def test_settings_of_a_run_from_a_diagnosis(diagnosis, tmp_path, monkeypatch):
    monkeypatch.chdir(diagnosis.parent)
    command = read_command(["--from", "run", "--goal", "joint/hinge=1"])
    settings = command.settings
    assert (settings.system, settings.diagnosis, settings.scheme) == ("diagnosed", str(diagnosis), "uniform")
    assert settings.goal == {"joint/hinge": 1.0} and str(command.folder) == "runs/run-seed0"
    assert read_command(["--from", "run", "--scheme", "online"]).settings.scheme == "online"
    (tmp_path / "c.toml").write_text(f'system = "diagnosed"\ndiagnosis = "{diagnosis}"\nrounds = 3')
    told = read_command(["--config", str(tmp_path / "c.toml")]).settings
    assert (told.diagnosis, told.rounds, told.scheme) == (str(diagnosis), 3, "uniform")


def test_the_target_has_the_posterior_mean_unless_told_otherwise(diagnosis):
    plan = make_plan(Settings("diagnosed", str(diagnosis), seeds=2))
    np.testing.assert_allclose(plan.truths.first, [[0.3, 0.05]] * 2, rtol=1e-6)
    assert plan.settings.prior["bob_mass"] == (pytest.approx(0.294), pytest.approx(0.306))
    assert plan.settings.target == "simulated" and plan.settings.controller == "sac"
    other = make_plan(Settings("diagnosed", str(diagnosis), truth={COULOMB: 0.06}))
    np.testing.assert_allclose(other.truths.first, [[0.3, 0.06]], rtol=1e-6)
    again = make_plan(plan.settings)
    assert again.settings == plan.settings
    np.testing.assert_array_equal(again.setup.system.parameters.low, plan.setup.system.parameters.low)


def metrics(path):
    read = [json.loads(line) for line in (path / "metrics.jsonl").read_text().splitlines()]
    return [{k: v for k, v in line.items() if k not in ("seconds", "simulations_per_second")} for line in read]


def test_a_small_run_end_to_end(tmp_path, diagnosis, capsys, monkeypatch):
    (tmp_path / "c.toml").write_text("rounds = 2\nsteps = 10\n" + LEARNER)
    monkeypatch.chdir(diagnosis.parent)
    start = ["online", "--from", "run", "--goal", "joint/hinge=0.2", "--config", str(tmp_path / "c.toml")]
    assert main([*start, "--out", str(tmp_path / "run")]) == 0
    told = capsys.readouterr().err
    assert "the simulator of rig with coulomb_friction@joint/hinge" in told
    assert "goal: joint/hinge at 0.2 rad" in told
    monkeypatch.chdir(tmp_path)  # a relative folder would no longer be found
    assert main(["online", "--out", "run", "--resume", "--rounds", "3", "--quiet"]) == 0
    assert main(["online", *start[3:], "--from", str(diagnosis), "--rounds", "3", "--out", "whole", "--quiet"]) == 0
    run = tmp_path / "run"
    assert metrics(run) == metrics(tmp_path / "whole") and len(metrics(run)) == 3
    assert all(line["return_target"] < 0 and line["cost_target"] > 0 for line in metrics(run))
    config = tomllib.loads((run / "config.toml").read_text())
    assert (config["diagnosis"], config["goal"]) == (str(diagnosis), {"joint/hinge": 0.2})
    facts = json.loads((run / "run.json").read_text())
    assert facts["truth"][COULOMB] == pytest.approx(0.05)
    assert facts["remarks"][1] == "goal: joint/hinge at 0.2 rad"
    page = (run / "report.html").read_text()
    assert "Online BayesSim on the simulator of run" in page and f"bayessim online --from {diagnosis}" in page
    assert f"domain randomization over bob_mass and {COULOMB} nothing was inferred" in page
    table = page[page.index(f"<td>{COULOMB}</td>") :]
    assert "±" in table[: table.index("</tr>")]


@pytest.mark.parametrize("scheme", [pytest.param("online", marks=pytest.mark.slow), "uniform"])
def test_a_planner_drives_what_was_repaired(tmp_path, diagnosis, scheme):
    small = 'encoder = "summary"\nrounds = 1\nsteps = 8\nsimulations = 20\npool = 1\nhistory = 1\ncalibrations = 8\n'
    (tmp_path / "c.toml").write_text(f"{small}components = 2\n[schedule]\nepochs = 10\n{PLANNER}")
    words = ["--from", str(diagnosis), "--config", str(tmp_path / "c.toml"), "--controller", "mppi"]
    assert main(["online", *words, "--scheme", scheme, "--out", str(tmp_path / "run"), "--quiet"]) == 0
    (line,) = metrics(tmp_path / "run")
    assert line["cost_target"] > 0 and (line["log_q_validation"] is not None) == (scheme == "online")
