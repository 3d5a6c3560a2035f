"""A sitting of a run with a made-up loop: what is on disk however it ends, and how it is taken up again."""

import html
import json
import os
import re
import shlex
import shutil
import signal
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest

from bayessim_jax.cli.options import Settings
from bayessim_jax.cli.parsing import UsageError
from bayessim_jax.cli.resolution import read_command
from bayessim_jax.cli.session import Session
from bayessim_jax.recordings.run_folder import RunFolder
from bayessim_jax.recordings.truths import Truths
from bayessim_jax.systems import CartPole
from tests.recordings.synthetic import stacked, state_after

SETTINGS = Settings("cartpole", rounds=4, seed=3, prior={"length": (0.1, 1.0), "mass": (0.1, 1.0)})


class MadeUp:
    """A plan whose rounds cost nothing; `before` is called at the start of each."""

    remarks = ()

    def __init__(self, rounds=4, seeds=1, before=lambda index: None):
        self.settings = replace(SETTINGS, rounds=rounds, seeds=seeds)
        self.setup = SimpleNamespace(system=CartPole.create(), remembered=32)
        self.seeds = list(range(3, 3 + seeds))
        self.truths = Truths.constant(np.tile(np.array([0.5, 0.4], np.float32), (seeds, 1)))
        self.hidden, self.hidden_names = self.truths, self.setup.system.parameters.names
        self.before = before

    def start(self):
        return state_after(0)

    def compile(self, state):
        def advance(state):
            index = int(state["round"]) + 1
            self.before(index)
            return state_after(index), stacked(self.setup.system, index, self.truths.at(index))

        return advance

    def sources(self):
        return ["Possas et al. 2020"]


def sit(path, plan, resume=False, quiet=False):
    folder = RunFolder(path) if resume else RunFolder(path).create()
    return Session(plan, folder, ["cartpole"], resume, quiet).run()


def metrics(path):
    """The lines without what a clock decides."""
    lines = [json.loads(line) for line in (path / "metrics.jsonl").read_text().splitlines()]
    return [{k: v for k, v in line.items() if k not in ("seconds", "simulations_per_second")} for line in lines]


def facts(path):
    return json.loads((path / "run.json").read_text())


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    path = tmp_path_factory.mktemp("session") / "whole"
    assert sit(path, MadeUp(), quiet=True) == 0
    return path


def test_a_finished_run_is_all_there(whole):
    assert {p.name for p in whole.iterdir()} == {
        "config.toml", "run.json", "metrics.jsonl", "posterior.nc", "checkpoints", "tensorboard", "report.html"
    }  # fmt: skip
    told = facts(whole)
    assert (told["status"], told["rounds_done"], told["command"]) == ("finished", 4, "bayessim online cartpole")
    assert told["truth"] == pytest.approx({"length": 0.5, "mass": 0.4})
    assert told["citations"] == ["possas2020online"]
    assert {"jax", "python", "bayessim_jax"} <= set(told["versions"])
    assert told["started"] <= told["ended"]
    assert Settings(**RunFolder(whole).read_config() | {"prior": SETTINGS.prior}) == MadeUp().settings
    assert "After 4 rounds length is" in (whole / "report.html").read_text()


def test_progress_is_plain_lines_where_there_is_no_terminal(tmp_path, capsys):
    sit(tmp_path / "run", MadeUp(rounds=2))
    told = capsys.readouterr().err
    assert "compiling" in told
    assert re.search(r"compiled in \d+\.\d s", told)
    rounds = re.findall(r"round \d/2 .*", told)
    assert len(rounds) == 2
    for word in ("log q(θ*)", "return", "simulations/s", "left"):
        assert all(word in line for line in rounds)
    assert "\x1b" not in told


def test_quiet_is_quiet(tmp_path, capsys):
    sit(tmp_path / "run", MadeUp(rounds=1), quiet=True)
    captured = capsys.readouterr()
    assert captured.out == captured.err == ""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_interrupted_and_resumed_equals_whole(whole, tmp_path, capsys, number):
    def interrupt(index):
        if index == 2:
            os.kill(os.getpid(), number)

    path = tmp_path / "a run"
    assert sit(path, MadeUp(before=interrupt)) == 128 + number
    told = capsys.readouterr().err
    assert f"continue with: bayessim online cartpole --out '{path}' --resume" in told
    assert (facts(path)["status"], facts(path)["rounds_done"]) == ("interrupted", 2)
    assert (path / "report.html").exists()
    assert sit(path, MadeUp(), resume=True, quiet=True) == 0
    assert facts(path)["status"] == "finished"
    assert len(facts(path)["resumed"]) == 1
    assert metrics(path) == metrics(whole)


@pytest.mark.parametrize("last", [1, 3])
def test_killed_and_resumed_equals_whole(whole, tmp_path, last):
    """A kill -9 in round `last`: nothing of the session's end is run, and a torn line lies beyond the checkpoint."""
    path = tmp_path / "run"

    class Killed(BaseException):
        pass

    def kill(index):
        if index == last:
            raise Killed

    with pytest.raises(Killed):
        sit(path, MadeUp(before=kill), quiet=True)
    assert facts(path)["status"] == "running"
    with (path / "metrics.jsonl").open("a") as file:
        file.write(json.dumps({"round": last, "seed": 3, "log_prob_true": 99.0}) + "\n")
    assert sit(path, MadeUp(), resume=True, quiet=True) == 0
    assert metrics(path) == metrics(whole)


def test_more_rounds_go_on_from_a_finished_run(whole, tmp_path):
    path = tmp_path / "run"
    sit(path, MadeUp(rounds=2), quiet=True)
    assert sit(path, MadeUp(rounds=4), resume=True, quiet=True) == 0
    assert metrics(path) == metrics(whole)
    assert RunFolder(path).read_config()["rounds"] == 4
    with pytest.raises(UsageError, match="rounds is 3, but 4 are done"):
        sit(path, MadeUp(rounds=3), resume=True)


def test_nothing_is_done_twice(whole, tmp_path, capsys):
    path = tmp_path / "run"
    shutil.copytree(whole, path)
    assert sit(path, MadeUp(before=lambda _: pytest.fail("a round was run")), resume=True) == 0
    assert "all 4 rounds are done already" in capsys.readouterr().err
    assert metrics(path) == metrics(whole)


def test_a_run_that_fails_says_so_in_one_line(tmp_path, capsys):
    def fail(index):
        if index == 2:
            raise RuntimeError("the robot is on fire\nand more")

    path = tmp_path / "run"
    assert sit(path, MadeUp(before=fail), quiet=True) == 1
    captured = capsys.readouterr()
    assert captured.err.count("\n") == 1
    assert "the run failed: RuntimeError: the robot is on fire" in captured.err
    assert facts(path)["status"] == "failed"
    assert "Traceback" in facts(path)["error"]
    assert sit(path, MadeUp(), resume=True, quiet=True) == 0
    assert len(metrics(path)) == 4
    assert facts(path)["status"] == "finished"
    assert "error" not in facts(path)


def test_a_run_killed_before_its_first_checkpoint_starts_from_what_is_on_disk(whole, tmp_path, capsys):
    class Killed(BaseException):
        pass

    class DiesCompiling(MadeUp):
        def start(self):
            raise Killed

    path = tmp_path / "run"
    with pytest.raises(Killed):
        sit(path, DiesCompiling())
    assert facts(path)["status"] == "running"
    words = ["--out", str(path), "--resume"]
    assert read_command(words).settings == MadeUp().settings
    assert sit(path, MadeUp(), resume=True) == 0
    assert "round 1/4" in capsys.readouterr().err
    assert metrics(path) == metrics(whole)
    assert len(facts(path)["resumed"]) == 1


def test_what_to_do_next_is_a_command_that_starts_the_same_run_anew(whole):
    """The settings of the run but for the one that is named, and a folder that is free."""
    page = html.unescape((whole / "report.html").read_text())
    commands = [line for line in re.findall(r"bayessim online [^<\n]*", page) if "--config" in line]
    assert len(commands) == 1
    command = read_command(shlex.split(commands[0])[2:])
    assert command.settings == replace(MadeUp().settings, seeds=8)
    RunFolder(command.folder).check_free()


def test_several_seeds_have_a_line_each(tmp_path):
    path = tmp_path / "run"
    sit(path, MadeUp(rounds=2, seeds=2), quiet=True)
    assert [(line["round"], line["seed"]) for line in metrics(path)] == [(r, s) for r in (1, 2) for s in (3, 4)]
    assert facts(path)["truth"]["length"] == pytest.approx([0.5] * 2)
    assert {p.name for p in (path / "tensorboard").iterdir()} == {"seed3", "seed4"}


def test_a_checkpoint_of_another_configuration_is_refused(whole, tmp_path):
    path = tmp_path / "run"
    shutil.copytree(whole, path)
    plan = MadeUp()
    plan.settings = replace(plan.settings, simulations=50)
    before = {p: p.read_bytes() for p in Path(path).rglob("*") if p.is_file()}
    with pytest.raises(UsageError, match=r"simulations is 200 there and 50 in config\.toml"):
        sit(path, plan, resume=True)
    assert before == {p: p.read_bytes() for p in Path(path).rglob("*") if p.is_file()}


def test_no_checkpoint_is_told(whole, tmp_path):
    path = tmp_path / "run"
    shutil.copytree(whole, path, ignore=shutil.ignore_patterns("checkpoints"))
    with pytest.raises(UsageError, match="no checkpoint in"):
        sit(path, MadeUp(), resume=True)


@pytest.mark.parametrize("name", ["posterior.nc", "metrics.jsonl"])
def test_a_damaged_file_is_told(whole, tmp_path, name):
    path = tmp_path / "run"
    shutil.copytree(whole, path)
    (path / name).write_bytes(b"\x00\xff")
    with pytest.raises(UsageError, match=f"{name} is missing or damaged"):
        sit(path, MadeUp(), resume=True)


def test_metrics_that_lack_a_round_are_told(whole, tmp_path):
    path = tmp_path / "run"
    shutil.copytree(whole, path)
    lines = (path / "metrics.jsonl").read_text().splitlines(keepends=True)
    (path / "metrics.jsonl").write_text("".join(lines[:2]))
    with pytest.raises(UsageError, match="holds 2 lines of metrics and 4 posteriors for a checkpoint of 4 rounds"):
        sit(path, MadeUp(), resume=True)


def test_states_of_another_shape_are_refused(whole, tmp_path):
    path = tmp_path / "run"
    shutil.copytree(whole, path)
    plan = MadeUp(rounds=5)
    plan.start = lambda: {"weights": jnp.zeros(7), "round": jnp.array(0)}
    with pytest.raises(UsageError) as error:
        sit(path, plan, resume=True)
    assert "4 holds another state: ['weights'] is float32[4] there and float32[7] here" in str(error.value)
