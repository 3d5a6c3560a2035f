"""`bayessim conceal`: a case that can be read, with its label sealed."""

import json
import shutil

import mujoco
import numpy as np
import pytest

from bayessim_jax.cli.main import main
from bayessim_jax.recordings.concealing import SEALED, AbsorbedError, conceal
from bayessim_jax.recordings.loading import load_case
from benchmarks.concealed import GROUPS, ONE_LAW, draw_cases, judge, summarize
from benchmarks.worlds import MODELS, RIGS

QUICK = {"recordings": 2, "seconds": 1.5}


@pytest.fixture
def model(tmp_path):
    path = tmp_path / "model.xml"
    path.write_text(RIGS["pendulum"].xml)
    return path


def rows(path):
    return np.genfromtxt(path, delimiter=",", names=True, deletechars="")


def test_a_clean_world_is_the_simulator_with_the_true_parameters(tmp_path, model):
    sealed = conceal(tmp_path / "case", model, noise=0.0, **QUICK)
    assert sealed["effects"] == []
    loaded = load_case(tmp_path / "case").check()
    low, high = loaded.parameters[0].prior.low, loaded.parameters[0].prior.high
    mass = sealed["parameters"]["rod_mass"]
    assert low + 0.15 * (high - low) <= mass <= high - 0.15 * (high - low)
    _, true = loaded.augmented({"rod_mass": mass})
    for divide, most in ((4, 1e-6), (1, 1e-2)):  # on the world's own grid, and on the simulator's
        data = mujoco.MjData(true)
        true.opt.timestep = 0.002 / divide
        for recording in loaded.recordings:
            data.qpos[:], data.qvel[:] = recording.qpos[0], recording.qvel[0]
            for k in range(len(recording.time) - 1):
                assert abs(data.qpos[0] - recording.qpos[k, 0]) < most
                data.ctrl[:] = recording.ctrl[k]
                mujoco.mj_step(true, data, 2 * divide)


def test_what_only_moves_what_is_unknown_hides_nothing(tmp_path):
    model = tmp_path / "model.xml"
    model.write_text(RIGS["swing"].xml)
    settings = {"parameters": ["body/rod/ipos/2"], "at": "body/rod", "strength": 0.2, **QUICK}
    told = set()
    for seed in range(4):  # along the rod or across it, as the seed draws
        folder = tmp_path / str(seed)
        try:
            told.add(conceal(folder, model, "link_offset", seed=seed, **settings)["effects"][0]["at"])
        except AbsorbedError as error:
            told.add(str(error))
            assert not folder.exists()
    assert len(told) == 2
    assert any("it only moves body/rod/ipos/2" in each for each in told)


@pytest.mark.parametrize(("effect", "told"), [("actuator_gain", True), ("viscous_friction", False)])
def test_it_is_measured_what_the_unknown_makes_up_for(tmp_path, capsys, effect, told):
    """Another mass is another gain of the only motor of a slide, and no friction."""
    model = tmp_path / "model.xml"
    model.write_text(RIGS["slide"].xml)
    words = ["--effect", effect, "--strength", "0.2", "--recordings", "2", "--seconds", "1.5"]
    assert main(["conceal", str(model), *words, "--out", str(tmp_path / "case")]) == 0
    lacks = json.loads((tmp_path / "case" / SEALED).read_text())["lacks"]
    assert lacks["with_truth"] == pytest.approx(0.2, rel=0.15)
    assert lacks["with_best"] < 1e-3 if told else lacks["with_best"] > 0.1
    assert ("other values of what is unknown make up for it" in capsys.readouterr().out) == told


def test_the_label_is_sealed_and_never_read(tmp_path, model):
    folder = tmp_path / "case"
    sealed = conceal(folder, model, "coulomb_friction", at="joint/hinge", seed=4, **QUICK)
    assert json.loads((folder / SEALED).read_text()) == sealed
    told = sealed["effects"][0]
    assert told["effect"] == "coulomb_friction" and told["at"] == told["joint"] == "joint/hinge"
    assert told["strength"]["measured"] == pytest.approx(0.3, rel=0.1)
    for file in folder.rglob("*"):
        if file.is_file() and file.name != SEALED:
            assert "coulomb" not in file.read_text()
    before = load_case(folder).check()
    (folder / SEALED).write_bytes(b"\xff\x00 not JSON")
    after = load_case(folder).check()
    assert [str(f) for f in after.findings] == [str(f) for f in before.findings]
    np.testing.assert_array_equal(before.recordings[0].qpos, after.recordings[0].qpos)


def test_the_same_seed_makes_the_same_case(tmp_path, model):
    for name in ("a", "b"):
        conceal(tmp_path / name, model, "unknown:wind", seed=3, **QUICK)
    assert (tmp_path / "a" / SEALED).read_text() == (tmp_path / "b" / SEALED).read_text()
    one, two = ((tmp_path / name / "recordings" / "run1.csv").read_text() for name in ("a", "b"))
    assert one == two


def test_encoders_count_times_scatter_and_velocities_are_left_out(tmp_path, model):
    conceal(tmp_path / "case", model, quantize=1000, jitter=0.4, velocities=False, rate=100, **QUICK)
    table = rows(tmp_path / "case" / "recordings" / "run1.csv")
    assert table.dtype.names == ("time", "joint/hinge/qpos", "actuator/motor/ctrl")
    counts = table["joint/hinge/qpos"] * 1000 / (2 * np.pi)
    np.testing.assert_allclose(counts, np.round(counts), atol=1e-4)
    steps = np.diff(table["time"])
    assert steps.mean() == pytest.approx(0.01, rel=0.01)
    assert steps.std() > 0.0005 and (np.abs(steps / 0.01 - 1) <= 0.41).all()


def test_noise_is_as_large_as_told(tmp_path, model):
    for noise in (0.0, 3.0):
        conceal(tmp_path / f"case{noise}", model, noise=noise, **QUICK)
    clean, noisy = (rows(tmp_path / f"case{noise}" / "recordings" / "run1.csv") for noise in (0.0, 3.0))
    assert (noisy["joint/hinge/qpos"] - clean["joint/hinge/qpos"]).std() == pytest.approx(3e-3, rel=0.15)
    assert (noisy["joint/hinge/qvel"] - clean["joint/hinge/qvel"]).std() == pytest.approx(3e-2, rel=0.15)


@pytest.mark.parametrize("rig", ["swing", "cart", "arm3", "arm6"])
def test_machines_of_one_to_six_joints_move_without_spinning(tmp_path, rig):
    (tmp_path / "model.xml").write_text(RIGS[rig].xml)
    conceal(tmp_path / "case", tmp_path / "model.xml", **QUICK)
    loaded = load_case(tmp_path / "case").check()
    for recording in loaded.recordings:
        assert (np.ptp(recording.qpos, axis=0) > 0.02).all() and np.ptp(recording.qpos, axis=0).max() < 2 * np.pi


def test_position_servos_are_given_positions(tmp_path, model):
    servo = '<position name="motor" joint="hinge" kp="20" kv="1" ctrllimited="true" ctrlrange="-0.5 0.5"/>'
    model.write_text(RIGS["pendulum"].xml.replace('<motor name="motor" joint="hinge" gear="1"/>', servo))
    conceal(tmp_path / "case", model, "actuator_delay", **QUICK)
    table = rows(tmp_path / "case" / "recordings" / "run1.csv")
    assert 0.2 < np.abs(table["actuator/motor/ctrl"]).max() <= 0.5
    assert np.corrcoef(table["actuator/motor/ctrl"], table["joint/hinge/qpos"])[0, 1] > 0.3


def test_two_effects_at_once(tmp_path, model):
    both = ["viscous_friction", "actuator_bias"]
    sealed = conceal(tmp_path / "case", model, both, strength=[0.2, 0.1], **QUICK)
    assert [e["effect"] for e in sealed["effects"]] == both
    assert [e["strength"]["measured"] for e in sealed["effects"]] == pytest.approx([0.2, 0.1], rel=0.1)


def test_the_command_makes_a_case_and_tells_slips_in_one_line(tmp_path, model, capsys):
    def run(*words):
        return main(["conceal", str(model), "--out", str(tmp_path / "out"), *words])

    for words, told in (
        (["--effect", "colomb_friction"], "did you mean 'coulomb_friction'?"),
        (["--effect", "armature", "--at", "joint/hing"], "did you mean 'joint/hinge'?"),
        (["--effect", "contact_friction"], "no place for it"),
        (["--effect", "armature", "--strength", "0"], "strength is 0"),
        (["--effect", "actuator_saturation", "--strength", "9", "--recordings", "1", "--seconds", "1"], "out of reach"),
        (["--parameters", "body/rood/mass"], "body/rod/mass"),
        (["--motions", "sinus"], "sines"),
        (["--seconds", "0.1"], "horizon"),
        (["--rate", "9000"], "up to 500 Hz"),
        (["--effect", "armature", "viscous_friction", "--at", "a", "b", "c"], "3 values for 2 effects"),
    ):
        assert run(*words) == 2, words
        lines = capsys.readouterr().err.strip().splitlines()
        assert len(lines) == 1 and told in lines[0], lines
        assert not (tmp_path / "out").exists()
    assert run("--effect", "viscous_friction", "--recordings", "2", "--seconds", "1.5") == 0
    assert "viscous" not in capsys.readouterr().out
    assert main(["check", str(tmp_path / "out")]) == 0
    capsys.readouterr()
    assert run("--recordings", "2") == 2
    assert "is there already" in capsys.readouterr().err
    shutil.rmtree(tmp_path / "out")
    model.write_text("<mujoco><worldbody><body><freejoint/><geom size='1'/></body></worldbody></mujoco>")
    assert run() == 2 and "has no hinge and no slide" in capsys.readouterr().err
    hinges = "<body><joint name='still'/><geom size='1'/></body>" * 2
    driven = hinges.replace("still", "driven", 1).replace("<body>", "<body pos='4 0 0'>", 1)
    actuator = "<actuator><motor joint='driven' gear='100'/></actuator>"
    model.write_text(f"<mujoco><option gravity='0 0 0'/><worldbody>{driven}</worldbody>{actuator}</mujoco>")
    for seed in ("0", "1", "2"):
        words = ("--effect", "viscous_friction", "--recordings", "2", "--seconds", "1.5", "--seed", seed)
        assert run(*words) == 0, "a place that is drawn is one that moves"
        assert "what had no name has one in the case: actuator/driven." in capsys.readouterr().out
        assert json.loads((tmp_path / "out" / "sealed.json").read_text())["effects"][0]["at"] == "joint/driven"
        shutil.rmtree(tmp_path / "out")


def test_drawn_cases_hold_every_group_and_every_effect():
    cases = draw_cases(list(MODELS), 240, 1)
    counts = {group: sum(c["group"] == group for c in cases) for group in GROUPS}
    assert counts["clean"] >= 60 and counts["unknown"] >= 40 and sum(counts.values()) == 240
    effects = {name for c in cases for name in c["effects"]}
    assert len([e for e in effects if e.startswith("unknown:")]) == 9 and len(effects) >= 9 + 31
    assert {c["rig"] for c in cases} == set(MODELS) and len({c["seed"] for c in cases}) == 240
    assert all(len(c["effects"]) == 2 for c in cases if c["group"] == "pair")
    assert all((0.02 <= c["strength"] <= 0.1) == (c["group"] == "weak") for c in cases if c["strength"] != 0.1)
    assert cases == draw_cases(list(MODELS), 240, 1)
    pairs = [set(case["effects"]) for case in cases if case["group"] == "pair"]
    assert pairs and not any(pair <= law for pair in pairs for law in ONE_LAW)


def test_verdicts_are_judged_by_what_is_sealed():
    hidden = {"effects": [{"effect": "base_tilt", "at": "world#joint/a", "joint": None}]}
    friction = {"effects": [{"effect": "coulomb_friction", "at": "joint/a", "joint": "joint/a"}]}

    def table(verdict, *answers):
        effects = [dict(zip(("effect", "at"), name.split("@"), strict=True)) for name in answers[0]] if answers else []
        sets = [list(a) for a in answers] if len(answers) > 1 else []
        return {"verdict": verdict, "effects": effects, "confusion_set": sets, "locations": [{"at": "joint/a"}]}

    right, tilt = ["coulomb_friction@joint/a"], ["base_tilt@world"]
    assert judge(hidden, table("explained", tilt))["outcome"] == "named"
    assert judge(friction, table("explained", right))["outcome"] == "named"
    assert judge(friction, table("ambiguous", tilt, right))["outcome"] == "among"
    assert judge(friction, table("ambiguous", tilt, right, ["a@x"], ["b@x"]))["outcome"] == "crowd"
    assert not judge(friction, table("ambiguous", tilt, right))["single_best"]
    assert judge(friction, table("explained", tilt))["outcome"] == "wrong"
    assert judge(friction, table("unexplained"))["outcome"] == "refused"
    assert judge(friction, table("no_mismatch"))["outcome"] == "missed"
    assert judge({"effects": []}, table("explained", tilt))["outcome"] == "false alarm"
    pair = {"effects": hidden["effects"] + friction["effects"]}
    assert judge(pair, table("explained", right))["outcome"] == "part"
    assert judge(pair, table("explained", right + tilt))["outcome"] == "named"
    third = judge(pair, table("explained", [*right, *tilt, "armature@joint/a"]))
    assert third["outcome"] == "wrong" and third["third"]


def test_the_scoreboard_counts_predictions_and_intervals():
    sealed = {
        "effects": [
            {
                "effect": "coulomb_friction",
                "at": "joint/a",
                "joint": "joint/a",
                "parameters": {"coulomb": 0.10, "smoothing": 3.0},
            }
        ],
        "parameters": {"mass": 0.5},
    }
    moment = {"mean": 0.11, "sd": 0.01, "unit": "N m"}
    found = {"effect": "coulomb_friction", "at": "joint/a", "parameters": {"coulomb": moment}}
    moments = {"baseline": {"mean": 0.6, "sd": 0.01}, "augmented": {"mean": 0.505, "sd": 0.01}}
    row = {
        "case": {"group": "single"},
        "sealed": sealed,
        "seconds": 3.0,
        "verdict": "explained",
        "effects": [found],
        "confusion_set": [],
        "closest": ["coulomb_friction@joint/a"],
        "locations": [{"at": "joint/a"}],
        "parameters": {"mass": moments},
        "nrmse": {"baseline": 0.5, "augmented": 0.14, "flexible": 0.2},
        "noise_floor": 0.1,
    }
    board = summarize([row | judge(sealed, row)])
    assert "named 1, single best 1, joint right 1 of 1, library without abstention: wrong in 0" in board
    assert "90.0% (median)" in board and "worse than the baseline in 0" in board
    assert "100% of 1 with the effect, 0% without; median error 1.00% against 20.00%" in board
    assert "those of effects hold the world's in 100% of 1" in board
    missed = {**row, "verdict": "no_mismatch", "effects": [], "locations": [], "closest": []}
    missed["sealed"] = {**sealed, "lacks": {"with_truth": 0.2, "with_best": 0.001}}
    assert "of the 1 missed, 1 are other values of what is unknown" in summarize([missed | judge(sealed, missed)])
    refused = {**row, "verdict": "unexplained", "effects": [], "closest": ["armature@joint/a"]}
    assert "refused 1, single best 0, joint right 1 of 1, library without abstention: wrong in 1" in summarize(
        [refused | judge(sealed, refused)]
    )


def test_the_scoreboard_compares_angles_on_the_circle():
    ripple = {"effect": "cogging", "at": "joint/a", "joint": "joint/a", "parameters": {"phase": -3.13}}
    moment = {"mean": 3.14, "sd": 0.02, "unit": "rad"}
    sealed = {"effects": [ripple], "parameters": {"mass": 0.5}}
    row = {
        "case": {"group": "single"},
        "sealed": sealed,
        "seconds": 3.0,
        "verdict": "explained",
        "effects": [{"effect": "cogging", "at": "joint/a", "parameters": {"phase": moment}}],
        "confusion_set": [],
        "closest": ["cogging@joint/a"],
        "locations": [{"at": "joint/a"}],
        "parameters": {"mass": {"baseline": {"mean": 0.5, "sd": 0.1}, "augmented": {"mean": 0.5, "sd": 0.1}}},
        "nrmse": {"baseline": 0.5, "augmented": 0.14, "flexible": 0.2},
        "noise_floor": 0.1,
    }
    assert "those of effects hold the world's in 100% of 1" in summarize([row | judge(sealed, row)])
