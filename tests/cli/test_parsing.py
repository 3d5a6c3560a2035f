import dataclasses
import re
import subprocess
import sys
import typing
from pathlib import Path

import pytest

from bayessim_jax import __version__
from bayessim_jax.cli.main import main
from bayessim_jax.cli.options import DIAGNOSED, Online, Settings
from bayessim_jax.cli.parsing import UsageError, parse
from bayessim_jax.cli.resolution import read_command


def test_flags_fill_the_settings():
    words = "pendulum --truth length=0.5 mass=0.3 --rounds 7 --seed 4 --encoder lstm --out /x --resume --quiet"
    command = parse(Online, words.split(), "bayessim online")
    assert command.settings == Settings(
        "pendulum", truth={"length": 0.5, "mass": 0.3}, rounds=7, seed=4, encoder="lstm"
    )
    assert (command.out, command.resume, command.quiet) == (Path("/x"), True, True)


def test_the_defaults_are_the_papers():
    settings = parse(Online, ["cartpole"], "bayessim online").settings
    assert (settings.rounds, settings.simulations, settings.steps, settings.components) == (30, 200, 50, 5)
    assert (settings.target, settings.truth, settings.seeds) == ("auto", {}, 1)
    assert str(Online(settings).folder) == "runs/cartpole-seed0"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("cartpol", "unknown system 'cartpol': did you mean 'cartpole'?"),
        ("", "bayessim online needs one of cartpole, pendulum, acrobot, skid_steer, hopper, fetch_push, fetch_slide"),
        ("cartpole --ronds 3", "unknown flag '--ronds': did you mean '--rounds'?"),
        ("--sed=3 cartpole", "unknown flag '--sed': did you mean '--seed'?"),
        ("cartpole --prior 3", "--prior has no flag; set it in a table [prior] of a file for --config."),
        ("cartpole --rounds x", "--rounds needs a whole number, not 'x'."),
        ("cartpole --rounds 2.5", "--rounds needs a whole number, not '2.5'."),
        ("cartpole --noise loud", "--noise needs a number, not 'loud'."),
        ("cartpole --rounds 0", "rounds is 0; it must be 1 or more."),
        ("cartpole --seed -1", "seed is -1; it must be 0 or more."),
        ("cartpole --seed 5000000000", "seed is 5000000000; it must be below 4294967296."),
        ("cartpole --truth length", "--truth 'length' is not of the form NAME=NUMBER, such as length=0.5"),
        ("cartpole --truth length=long", "'length=long' is not of the form NAME=NUMBER"),
        ("cartpole --encoder lst", "unknown encoder 'lst': did you mean 'lstm'?"),
        ("cartpole --rounds", "Missing value for argument '--rounds'"),
        ("cartpole pendulum", "Unrecognized options: pendulum"),
    ],
)
def test_bad_usage_is_one_line(words, message):
    with pytest.raises(UsageError) as error:
        parse(Online, words.split(), "bayessim online")
    assert message in str(error.value)
    assert "\n" not in str(error.value)
    assert not set("│╭╰─") & set(str(error.value))


def told(tmp_path, text, words=()):
    path = tmp_path / "some.toml"
    path.write_text(text)
    return read_command([*words, "--config", str(path)])


def test_flags_win_over_the_config_file(tmp_path):
    text = 'system = "acrobot"\nrounds = 3\nnoise = 1\n[prior]\nmass1 = [0.5, 1.5]\n[learner]\nenvs = 4\n'
    settings = told(tmp_path, text, ["--rounds", "5"]).settings
    assert settings == Settings("acrobot", rounds=5, noise=1.0, prior={"mass1": (0.5, 1.5)}, learner={"envs": 4})
    assert told(tmp_path, text, ["cartpole"]).settings.system == "cartpole"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("ronds = 3", "unknown key 'ronds': did you mean 'rounds'?"),
        ("rounds = 'many'", "rounds is 'many'; it needs a whole number."),
        ("rounds = true", "rounds is True; it needs a whole number."),
        ("rounds = 0", "rounds is 0; it must be 1 or more."),
        ("encoder = 'lst'", "encoder: unknown value 'lst': did you mean 'lstm'?"),
        ("truth = 3", "truth is 3; it needs a table."),
        ("[truth]\nlength = 'long'", "truth.length is 'long'; it needs a number."),
        ("[prior]\nlength = [1.0, 0.1]", "prior.length: low 1.0 must be below high 0.1"),
        ("[prior]\nlength = [0.3, 0.3]", "prior.length: low 0.3 must be below high 0.3"),
        ("[prior]\nlength = 0.3", "prior.length is 0.3; it needs two numbers, [low, high]."),
        ("rounds = ", "is not TOML"),
    ],
)
def test_a_bad_config_file_is_one_line_with_file_and_key(tmp_path, text, message):
    with pytest.raises(UsageError) as error:
        told(tmp_path, text, ["cartpole"])
    assert message in str(error.value)
    assert "config" in str(error.value)


def test_a_config_file_that_is_not_there(tmp_path):
    with pytest.raises(UsageError, match=r"cannot read config file .*none\.toml: No such file"):
        read_command(["cartpole", "--config", str(tmp_path / "none.toml")])


def test_the_command_itself(capsys):
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"bayessim {__version__}\n"
    assert main(["--help"]) == 0
    assert "online SYSTEM" in capsys.readouterr().out
    assert main(["online", "--help"]) == 0
    assert "--rounds" in capsys.readouterr().out
    assert main([]) == 2
    assert "usage" in capsys.readouterr().err
    for words, hint in (
        (["onlin"], "'online'"),
        (["--versoin"], "'--version'"),
        (["systems", "x"], "no arguments"),
    ):
        assert main(words) == 2
        captured = capsys.readouterr()
        assert captured.out == ""
        assert captured.err.count("\n") == 1
        assert hint in captured.err


@pytest.mark.parametrize("command", ["online", "new", "check", "infer", "diagnose", "conceal", "evaluate"])
def test_every_flag_that_help_shows_is_a_flag(command, capsys):
    assert main([command, "--help"]) == 0
    shown = set(re.findall(r"--[a-z][a-z-]*", re.sub(r"(?m)^usage.*", "", capsys.readouterr().out))) - {"--help"}
    assert shown
    for flag in shown:
        main([command, flag, "--wrong"])
        assert f"unknown flag {flag!r}" not in capsys.readouterr().err


def test_systems_are_listed_with_priors_and_units(capsys):
    assert main(["systems"]) == 0
    told = capsys.readouterr().out
    assert "length 0.1 to 1 m, mass 0.1 to 1 kg" in told
    assert "angle_dot (rad/s)" in told
    assert [line.split(":")[0] for line in told.splitlines() if line[:1].isalpha()] == [
        "cartpole",
        "pendulum",
        "acrobot",
        "skid_steer",
        "hopper",
        "fetch_push",
        "fetch_slide",
    ]


def test_a_system_whose_package_is_missing_is_listed_with_the_remedy(capsys, monkeypatch):
    from bayessim_jax.systems import SYSTEMS

    def missing():
        raise ValueError("Fetch needs gymnasium-robotics: pip install it.")

    monkeypatch.setitem(SYSTEMS, "fetch_push", dataclasses.replace(SYSTEMS["fetch_push"], system=missing))
    assert main(["systems"]) == 0
    assert "fetch_push: push a box" in (told := capsys.readouterr().out)
    assert "  Fetch needs gymnasium-robotics: pip install it.\n" in told


@pytest.mark.parametrize("words", [["--help"], ["--version"], ["online", "--help"], ["online", "cartpol"]])
def test_help_and_bad_usage_are_answered_without_jax(words):
    code = (
        "import sys\nfrom bayessim_jax.cli.main import main\n"
        f"code = main({words!r})\nheavy = {{'jax', 'numpy', 'matplotlib', 'xarray'}} & set(sys.modules)\n"
        "assert not heavy, heavy\nsys.exit(code)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert done.returncode == (2 if "cartpol" in words else 0), done.stderr
    assert "Traceback" not in done.stderr


def test_the_choices_are_those_of_the_registries():
    from bayessim_jax.inference.encoders import ENCODERS
    from bayessim_jax.inference.proposals import PROPOSALS
    from bayessim_jax.systems import SYSTEMS

    hints = typing.get_type_hints(Settings)
    assert set(typing.get_args(hints["system"])) == {*SYSTEMS, DIAGNOSED}
    assert set(typing.get_args(hints["proposal"])) == set(PROPOSALS)
    assert set(typing.get_args(hints["encoder"])) == {*ENCODERS, "fourier", "summary"}


def test_the_defaults_are_those_of_the_library():
    import inspect

    from bayessim_jax import online
    from bayessim_jax.cli.plan import INFERENCES, make_plan
    from bayessim_jax.inference.estimators import recurrent_mixture

    settings = Settings("cartpole")
    setup = make_plan(settings).setup
    assert setup.calibrations == online.Setup.create(setup.system, setup.learner, setup.task).calibrations
    for field in dataclasses.fields(online.Setup):
        if field.name not in ("inferences", "replay", "calibrations") and field.default is not dataclasses.MISSING:
            assert getattr(settings, field.name) == field.default, field.name
    assert INFERENCES[settings.scheme] == online.Setup.inferences
    assert settings.proposal == inspect.signature(online.Setup.create).parameters["proposal"].default
    assert settings.encoder == inspect.signature(recurrent_mixture).parameters["encoder"].default


def test_a_reader_that_has_seen_enough_is_no_crash():
    command = [sys.executable, "-c", "from bayessim_jax.cli.main import main; import sys; sys.exit(main())", "--help"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        process.stdout.close()
        assert (process.stderr.read(), process.wait(timeout=60)) == ("", 1)
