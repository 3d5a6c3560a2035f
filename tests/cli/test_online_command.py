"""`bayessim online` itself: bad input before anything is written, and one small run against Gymnasium."""

import json
import signal
import subprocess
import sys
import time
import tomllib
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr

from bayessim_jax import online
from bayessim_jax.cli.config_file import settings_from
from bayessim_jax.cli.main import main
from bayessim_jax.cli.options import Settings
from bayessim_jax.cli.parsing import UsageError
from bayessim_jax.cli.plan import make_plan
from bayessim_jax.cli.resolution import read_command
from bayessim_jax.effects.vehicle import TERRAINS
from bayessim_jax.programs import keep_traces_in

TINY = """
system = "cartpole"
encoder = "summary"
rounds = 3
simulations = 20
steps = 10
pool = 2
components = 2
history = 3
calibrations = 8

[schedule]
epochs = 10

[learner]
episodes = 8
episode_steps = 10
envs = 4
horizon = 10
epochs = 2
minibatches = 2
"""


@pytest.fixture(autouse=True)
def own_settings(monkeypatch):
    """The command switches the compilation cache on: let it be that of the tests, and put JAX's settings back."""
    names = (
        "jax_compilation_cache_dir",
        "jax_persistent_cache_min_compile_time_secs",
        "jax_persistent_cache_min_entry_size_bytes",
    )
    before = {name: getattr(jax.config, name) for name in names}
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", before["jax_compilation_cache_dir"])
    yield
    for name, value in before.items():
        jax.config.update(name, value)
    keep_traces_in(None)


def refused(capsys, *words):
    """The one line on standard error."""
    assert main(["online", *map(str, words)]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith("bayessim: ")
    assert captured.err.count("\n") == 1
    return captured.err


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("--truth lenght=0.5", "truth: unknown parameter 'lenght': did you mean 'length'?"),
        ("--truth length=3", "truth length=3.0 lies outside the prior, 0.1 to 1.0 m"),
        ("--truth length=nan", "truth length=nan lies outside the prior"),
        ("--seed -3", "seed is -3; it must be 0 or more."),
    ],
)
def test_bad_words(capsys, tmp_path, words, message):
    assert message in refused(capsys, "cartpole", *words.split(), "--out", tmp_path / "run")
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[prior]\nlenght = [0.1, 0.5]", "prior: unknown parameter 'lenght': did you mean 'length'?"),
        ("[learner]\nenvz = 3", "[learner]: unknown key 'envz': did you mean 'envs'?"),
        ("[learner]\nenvs = 2.5", "[learner]: envs is 2.5; it needs a whole number."),
        ("[learner]\nminibatches = 7", "minibatches 7 must divide"),
        ("[schedule]\nepoch = 3", "[schedule]: unknown key 'epoch': did you mean 'epochs'?"),
        ("[schedule]\nlearning_rate = 'high'", "[schedule]: learning_rate is 'high'; it needs a number."),
        ("truth = { length = 0.9 }\nprior = { length = [0.1, 0.5] }", "outside the prior, 0.1 to 0.5 m"),
    ],
)
def test_bad_config(capsys, tmp_path, text, message):
    (tmp_path / "c.toml").write_text(text)
    assert message in refused(capsys, "cartpole", "--config", tmp_path / "c.toml", "--out", tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_a_system_that_gymnasium_does_not_have(capsys, tmp_path):
    told = refused(capsys, "skid_steer", "--target", "gymnasium", "--out", tmp_path / "run")
    assert told == "bayessim: Gymnasium has no environment for skid_steer; add --target simulated.\n"
    assert not (tmp_path / "run").exists()


def test_bad_folders(capsys, tmp_path):
    (tmp_path / "note.txt").write_text("mine")
    assert "already used; continue with --resume" in refused(capsys, "cartpole", "--out", tmp_path)
    assert "is a file" in refused(capsys, "cartpole", "--out", tmp_path / "note.txt")
    assert "cannot write" in refused(capsys, "cartpole", "--out", tmp_path / "note.txt" / "run")
    assert "no run in" in refused(capsys, "cartpole", "--out", tmp_path / "none", "--resume")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["note.txt"]


def stored(folder, **changes):
    """A run folder with settings and facts, but nothing computed."""
    folder.mkdir()
    lines = {"system": '"cartpole"', "seed": "3", "rounds": "4", **changes}
    (folder / "config.toml").write_text("\n".join(f"{k} = {v}" for k, v in lines.items()))
    (folder / "run.json").write_text("{}")
    return folder


def test_a_run_of_another_configuration_is_not_continued(capsys, tmp_path):
    out = stored(tmp_path / "run")
    told = refused(capsys, "cartpole", "--seed", 4, "--encoder", "lstm", "--out", out, "--resume")
    assert "seed is 3 there and 4 in the command" in told
    assert "encoder is 'pooled_lstm' there and 'lstm' in the command" in told
    assert "system is 'cartpole' there" in refused(capsys, "pendulum", "--out", out, "--resume")
    assert "truth.mass is not set there and 0.3" in refused(
        capsys, "cartpole", "--truth", "mass=0.3", "--out", out, "--resume"
    )
    (tmp_path / "c.toml").write_text("steps = 7")
    told = refused(capsys, "cartpole", "--config", tmp_path / "c.toml", "--out", out, "--resume")
    assert "steps is 50 there and 7" in told
    # the same words as before, or none at all, differ in nothing: what is missing now is the checkpoint
    (tmp_path / "run" / "metrics.jsonl").touch()
    assert "no checkpoint" in refused(capsys, "--out", out, "--resume")
    assert "no checkpoint" in refused(capsys, "cartpole", "--seed", 3, "--rounds", 9, "--out", out, "--resume")


def test_damaged_runs_are_not_continued(capsys, tmp_path):
    out = stored(tmp_path / "a")
    (out / "run.json").write_text('{"status": "run')
    assert "run.json is missing or damaged" in refused(capsys, "cartpole", "--out", out, "--resume")
    out = stored(tmp_path / "b", ronds="3")
    assert "config.toml: unknown key 'ronds'" in refused(capsys, "cartpole", "--out", out, "--resume")
    out = stored(tmp_path / "c")
    (out / "config.toml").write_text("= 3")
    assert "config.toml is missing or damaged" in refused(capsys, "cartpole", "--out", out, "--resume")


def test_a_plan_is_complete_and_repeats():
    plan = make_plan(Settings("cartpole", seed=5, seeds=2, truth={"mass": 0.3}, prior={"length": (0.2, 0.8)}))
    assert plan.settings.prior == {"length": (0.2, 0.8), "mass": (0.1, 1.0)}
    assert plan.settings.schedule["epochs"] > 0
    assert plan.settings.learner["envs"] > 0
    assert plan.seeds == [5, 6]
    lengths, masses = plan.truths.first.T
    assert masses == pytest.approx([0.3, 0.3])
    assert lengths[0] != lengths[1]
    assert ((lengths >= 0.2) & (lengths <= 0.8)).all()
    again = make_plan(plan.settings)
    assert again.settings == plan.settings
    np.testing.assert_array_equal(again.truths.first, plan.truths.first)
    alone = make_plan(Settings("cartpole", seed=6, truth={"mass": 0.3}, prior={"length": (0.2, 0.8)}))
    np.testing.assert_array_equal(alone.truths.first[0], plan.truths.first[1])


def test_a_run_that_only_warms_up_says_so():
    (told,) = make_plan(Settings("cartpole", rounds=3, warmup=3)).remarks
    assert told.startswith("warmup is 3 and rounds is 3") and "--rounds 4" in told
    assert not make_plan(Settings("cartpole", rounds=4, warmup=3)).remarks
    assert not make_plan(Settings("cartpole", rounds=3, warmup=3, scheme="uniform")).remarks


def lines(path):
    read = [json.loads(line) for line in (path / "metrics.jsonl").read_text().splitlines()]
    return [{k: v for k, v in line.items() if k not in ("seconds", "simulations_per_second")} for line in read]


def tiny_plan():
    return make_plan(Settings(**settings_from(tomllib.loads(TINY), "here")))


def test_a_small_run_end_to_end(tmp_path, capsys):
    """Against Gymnasium's environment, cut after two rounds and resumed."""
    (tmp_path / "tiny.toml").write_text(TINY)
    run = tmp_path / "run"
    words = ["online", "--config", str(tmp_path / "tiny.toml"), "--out", str(run)]
    assert main([*words, "--rounds", "2", "--quiet"]) == 0
    assert main(["online", "--out", str(run), "--rounds", "3", "--resume"]) == 0
    assert "round 3/3" in capsys.readouterr().err
    told = lines(run)
    assert [line["round"] for line in told] == [1, 2, 3]
    assert all(line["return_target"] > 0 for line in told)
    facts = json.loads((run / "run.json").read_text())
    assert facts["status"] == "finished"
    assert "barto1983neuronlike" in facts["citations"]
    assert "hochreiter1997long" not in facts["citations"]
    with xr.open_datatree(run / "posterior.nc", engine="h5netcdf") as tree:
        seen = tree["observed_data"].to_dataset().load()
        length = tree["posterior"]["length"].load()
    assert seen["angle"].shape == (3, 1, 11)
    assert abs(seen["angle"].values[:, :, 0]).max() < 0.2
    truth = facts["truth"]["length"]
    assert length.attrs["truth"] == truth == pytest.approx(float(tiny_plan().truths.first[0, 0]))
    assert float(length.mean()) == pytest.approx(told[-1]["mean"]["length"], rel=1e-5)
    before = (run / "report.html").read_text()
    (run / "report.html").unlink()
    assert main(["report", str(run)]) == 0
    assert (run / "report.html").read_text() == before


@pytest.mark.slow
def test_the_command_does_what_the_library_does(tmp_path):
    """The rounds that the command puts together are those of one `online.run`, to rounding.

    They are two compiled programs, and a compiler may order their sums differently on another
    processor; what one program does is the same bit for bit, whole or resumed (tested below).
    """
    (tmp_path / "tiny.toml").write_text(TINY)
    assert main(["online", "--config", str(tmp_path / "tiny.toml"), "--out", str(tmp_path / "run"), "--quiet"]) == 0
    plan = tiny_plan()
    run = jax.jit(online.run, static_argnames="rounds", compiler_options=online.COMPILER_OPTIONS)
    _, infos = run(jax.random.key(0), plan.setup, plan.target, rounds=3)
    with xr.open_datatree(tmp_path / "run" / "posterior.nc", engine="h5netcdf") as tree:
        seen = tree["observed_data"].to_dataset().load()
    x = np.stack([seen[name].values for name in plan.setup.system.observations.names], axis=-1)
    np.testing.assert_allclose(x, infos.recordings.observations, atol=1e-4)
    told = lines(tmp_path / "run")
    np.testing.assert_allclose([line["log_q_validation"] for line in told], infos.fit.log_q_validation, rtol=1e-3)
    np.testing.assert_array_equal([line["return_target"] for line in told], infos.return_target)
    exact = jax.vmap(lambda belief: belief.log_prob(jnp.asarray(plan.truths.first[0])))(infos.belief)
    np.testing.assert_allclose([line["log_prob_true"] for line in told], exact, atol=1e-3)


@pytest.mark.slow
def test_several_seeds_at_once(tmp_path):
    (tmp_path / "tiny.toml").write_text(TINY)
    words = ["--seed", "6", "--seeds", "3", "--rounds", "2", "--quiet", "--out", str(tmp_path / "run")]
    assert main(["online", "--config", str(tmp_path / "tiny.toml"), *words]) == 0
    told = lines(tmp_path / "run")
    assert [(line["round"], line["seed"]) for line in told] == [(r, s) for r in (1, 2) for s in (6, 7, 8)]
    for r in (1, 2):
        assert len({line["log_prob_true"] for line in told if line["round"] == r}) == 3
    with xr.open_datatree(tmp_path / "run" / "posterior.nc", engine="h5netcdf") as tree:
        assert len(set(tree["posterior"]["length"].attrs["truth"])) == 3
        x = tree["observed_data"]["x"].values
    assert len({float(first) for first in x[0, :, 0, 0]}) == 3


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_a_process_that_is_stopped_goes_on_as_if_it_had_not_been(tmp_path, number):
    (tmp_path / "tiny.toml").write_text(TINY.replace("rounds = 3", "rounds = 40"))
    command = [sys.executable, "-c", "import sys; from bayessim_jax.cli.main import main; sys.exit(main())", "online"]
    start = [*command, "--config", str(tmp_path / "tiny.toml"), "--out"]
    whole, cut = tmp_path / "whole", tmp_path / "cut"
    subprocess.run([*start, str(whole), "--quiet"], check=True, timeout=600)
    process = subprocess.Popen([*start, str(cut)], stderr=subprocess.PIPE, text=True)
    while not (Path(cut) / "metrics.jsonl").exists() or len(lines(cut)) < 3:
        time.sleep(0.02)
        assert process.poll() is None
    process.send_signal(number)
    _, told = process.communicate(timeout=300)
    assert process.returncode == (130 if number == signal.SIGINT else -9)
    assert "Traceback" not in told
    assert ("--resume" in told) == (number == signal.SIGINT)
    assert len(lines(cut)) < 40
    subprocess.run([*command, "--out", str(cut), "--resume", "--quiet"], check=True, timeout=600)
    assert lines(cut) == lines(whole)
    with (
        xr.open_datatree(whole / "posterior.nc", engine="h5netcdf") as a,
        xr.open_datatree(cut / "posterior.nc", engine="h5netcdf") as b,
    ):
        xr.testing.assert_identical(a, b)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("acrobot --controller disco", "acrobot has no task that one can plan for; take --controller ppo"),
        ("cartpole --target vehicle", "cartpole has none: take another --target"),
        ("pendulum --change length=0.5", "change needs the round from which it holds"),
        ("pendulum --change round=3", "change names no parameter"),
        ("pendulum --change round=3 length=4", "change length=4.0 lies outside the prior"),
        ("pendulum --change round=3 length=0.5 --rounds 2", "change holds from round 3, but rounds is 2"),
        ("pendulum --change round=3 terrain=ice", "only the vehicle drives on a terrain; add --target vehicle"),
        ("skid_steer --target vehicle --change round=3 terrain=ise", "unknown terrain 'ise': did you mean 'ice'"),
        ("skid_steer --target vehicle --change round=3 slip=1", "lies outside its range, 0.0 to 0.9; choose another"),
        ("skid_steer --target vehicle --truth turn_slip=0.1", "did you mean 'turning_slip'"),
        ("skid_steer --change round=3 slip=0.1", "unknown parameter 'slip'"),
        ("skid_steer --change round=3 slip=much", "'slip=much' is not of the form NAME=NUMBER"),
        ("pendulum --forget 1", "forget is 1.0; it is a probability"),
    ],
)
def test_bad_words_of_control(capsys, tmp_path, words, message):
    assert message in refused(capsys, *words.split(), "--out", tmp_path / "run")


def test_planners_take_their_settings_and_targets():
    plan = make_plan(Settings("pendulum", controller="disco", learner={"samples": 7, "noise": "spline"}))
    assert (plan.settings.target, plan.settings.learner["samples"], plan.setup.replay) == ("gymnasium", 7, True)
    change = {"round": 3.0, "icr_offset": -0.2}
    skid = make_plan(Settings("skid_steer", target="vehicle", truth={"icr_offset": 0.1}, change=change))
    assert (skid.settings.controller, skid.truths.at(2)[0, 2], skid.truths.at(3)[0, 2]) == (
        "mppi",
        np.float32(0.1),
        np.float32(-0.2),
    )
    np.testing.assert_array_equal(skid.truths.at(2)[0, :2], skid.truths.at(3)[0, :2])
    assert make_plan(Settings("pendulum", controller="ppo")).settings.controller == "ppo"


def test_the_ground_of_the_vehicle_changes_and_theta_does_not(tmp_path):
    change = {"round": 3.0, "terrain": "ice", "lag": 0.2}
    plan = make_plan(Settings("skid_steer", target="vehicle", truth={"terrain": "asphalt"}, change=change, seeds=2))
    own = [TERRAINS[name] for name in ("asphalt", "ice")]
    expected = [[*values.values(), lag] for values, lag in zip(own, (0.12, 0.2), strict=True)]
    for index, values in zip((2, 3), expected, strict=True):
        np.testing.assert_allclose(plan.hidden.at(index)[:, 3:], [values] * 2, rtol=1e-6)
    np.testing.assert_array_equal(plan.truths.at(2), plan.truths.at(3))
    simulated = make_plan(Settings("skid_steer", seeds=2))
    np.testing.assert_array_equal(plan.truths.at(2), simulated.truths.at(2))
    assert plan.hidden_names[3:] == ("slip", "turning_slip", "looseness", "lag")
    radius = plan.apparent(3)[..., 0] / plan.truths.first[:, :1]
    np.testing.assert_allclose(radius, [[0.98, 0.98, 0.7]] * 2, rtol=1e-5)
    assert simulated.apparent(3) is None
    (tmp_path / "c.toml").write_text('target = "vehicle"\nchange = {round = 3, terrain = "ice"}\n')
    words = ["skid_steer", "--config", str(tmp_path / "c.toml")]
    assert read_command(words).settings.change == {"round": 3.0, "terrain": "ice"}
    (tmp_path / "c.toml").write_text('[change]\nround = 3\nlength = "long"\n')
    with pytest.raises(UsageError, match="length is 'long'; it needs a number"):
        read_command(["pendulum", "--config", str(tmp_path / "c.toml")])


@pytest.mark.slow
@pytest.mark.parametrize("system", ["skid_steer", "pendulum"])
def test_a_planner_drives_through_the_command(tmp_path, system):
    out = tmp_path / "run"
    text = TINY[: TINY.index("[learner]")].replace('"cartpole"', f'"{system}"').replace("rounds = 3", "rounds = 2")
    (tmp_path / "c.toml").write_text(text + "[learner]\nhorizon = 6\nsamples = 8\n")
    words = ["--config", str(tmp_path / "c.toml"), "--controller", "disco", "--out", str(out), "--quiet"]
    assert main(["online", system, *words, "--forget", "0.1"]) == 0
    lines = [json.loads(line) for line in (out / "metrics.jsonl").read_text().splitlines()]
    assert len(lines) == 2
    assert all(line["cost_target"] > 0 for line in lines)
    page = (out / "report.html").read_text()
    assert "Mean cost of a step so far" in page
    assert ("Paths around the circle" in page) == ('class="wide animation"' in page) == (system == "skid_steer")


@pytest.mark.parametrize(
    ("scheme", "inferred"),
    [pytest.param("offline", [False, True, False], marks=pytest.mark.slow), ("uniform", [False] * 3)],
)
def test_other_schemes_infer_once_or_never(tmp_path, scheme, inferred):
    (tmp_path / "c.toml").write_text(TINY)
    words = ["cartpole", "--config", tmp_path / "c.toml", "--scheme", scheme, "--warmup", 1, "--out", tmp_path / "run"]
    assert main(["online", *map(str, words), "--quiet"]) == 0
    lines = [json.loads(line) for line in (tmp_path / "run" / "metrics.jsonl").read_text().splitlines()]
    assert [line["log_q_validation"] is not None for line in lines] == inferred
    assert [line["gain_over_prior"] != pytest.approx(0.0, abs=1e-4) for line in lines] == np.cumsum(inferred).tolist()
    assert all(line["return_target"] > 0 for line in lines)
    report = (tmp_path / "run" / "report.html").read_text()
    assert "confidently wrong" not in report or scheme == "offline"
    assert main(["online", *map(str, words), "--quiet", "--resume", "--rounds", "4"]) == 0


def test_systems_have_habits_of_their_own(tmp_path):
    from bayessim_jax.cli.resolution import read_command

    assert read_command(["fetch_push"]).settings.warmup == 3
    assert read_command(["fetch_push", "--warmup", "1"]).settings.warmup == 1
    (tmp_path / "c.toml").write_text('system = "fetch_slide"\nnoise = 0.002')
    told = read_command(["--config", str(tmp_path / "c.toml")]).settings
    assert (told.system, told.noise, told.warmup) == ("fetch_slide", 0.002, 3)
    assert read_command(["cartpole"]).settings == Settings("cartpole")
