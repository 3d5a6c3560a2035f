"""`bayessim new`: a case that can be checked as soon as there are recordings."""

import tomllib

import mujoco
import numpy as np
import pytest

from bayessim_jax.cli.main import main
from bayessim_jax.recordings.loading import load_case
from bayessim_jax.recordings.mjcf import referenced_files
from tests.recordings.made_up_case import MODEL, columns, csv_text

ARM = """
<mujoco model="arm">
  <compiler meshdir="assets"/>
  <asset><mesh name="tetra" file="tetra.obj"/></asset>
  <worldbody>
    <body name="upper &quot;arm&quot;">
      <joint name="2nd joint" type="hinge" axis="0 1 0" damping="0.2" range="-90 90"/>
      <geom type="mesh" mesh="tetra"/>
      <body name="slider"><joint name="rail" type="slide"/><geom name="tip" size="0.05" pos="0 0 0.1"/></body>
    </body>
    <body name="cube" pos="0 0 1"><freejoint name="cube"/><geom size="0.1"/></body>
  </worldbody>
  <actuator>
    <position name="servo" joint="2nd joint" kp="20"/>
    <motor name="motor" joint="rail" gear="-3"/>
  </actuator>
  <sensor><accelerometer name="imu" site="s"/></sensor>
</mujoco>
""".replace('<geom type="mesh"', '<site name="s"/><geom type="mesh"')
TETRA = "v 0 0 0\nv 0.1 0 0\nv 0 0.1 0\nv 0 0 0.1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"


def write_arm(folder, text=ARM):
    (folder / "assets").mkdir(parents=True)
    (folder / "assets" / "tetra.obj").write_text(TETRA)
    (folder / "arm.xml").write_text(text)
    return folder / "arm.xml"


def test_a_new_case_needs_recordings_only(tmp_path, capsys):
    (tmp_path / "robot.xml").write_text(MODEL)
    assert main(["new", str(tmp_path / "case"), "--model", str(tmp_path / "robot.xml")]) == 0
    assert "put recordings into" in capsys.readouterr().out
    assert main(["check", str(tmp_path / "case")]) == 2
    assert capsys.readouterr().err.count("no file matches recordings") == 1
    (tmp_path / "case" / "recordings" / "run1.csv").write_text(csv_text(columns()))
    assert main(["check", str(tmp_path / "case")]) == 0
    case = load_case(str(tmp_path / "case")).check()
    assert {p.name: p.nominal for p in case.parameters} == {"bob_mass": pytest.approx(0.3), "hinge_damping": 0.05}
    for parameter in case.parameters:
        assert parameter.prior.low <= parameter.nominal <= parameter.prior.high
        assert parameter.prior.low < parameter.prior.high


def test_every_candidate_is_a_parameter_that_the_model_has(tmp_path):
    main(["new", str(tmp_path / "case"), "--model", str(write_arm(tmp_path / "robot"))])
    path = tmp_path / "case" / "case.toml"
    text = path.read_text()
    start = text.index("[[parameters]]")
    lines = [line.removeprefix("# ") for line in text[start:].splitlines()]
    path.write_text(text[:start] + "\n".join(lines) + "\n")
    names = [table["name"] for table in tomllib.loads(path.read_text())["parameters"]]
    some = {"slider_mass", "p2nd_joint_damping", "rail_armature", "servo_gain", "motor_gear", "tip_friction"}
    assert some < set(names)
    (tmp_path / "case" / "recordings" / "run.csv").write_text("time\n0\n")
    loaded = load_case(tmp_path / "case")
    assert [p.name for p in loaded.parameters] == names
    assert not [f for f in loaded.findings if f.file == "case.toml"]
    for parameter in loaded.parameters:
        _, model = loaded.augmented({parameter.name: parameter.prior.mean})
        assert isinstance(model, mujoco.MjModel)


def test_the_channels_are_listed(tmp_path):
    main(["new", str(tmp_path / "case"), "--model", str(write_arm(tmp_path / "robot"))])
    comments = [line.split()[1] for line in (tmp_path / "case" / "case.toml").read_text().splitlines() if "/" in line]
    for channel in ("joint/rail/qpos", "joint/cube/qpos/6", "joint/cube/qvel/5", "sensor/imu/2", "actuator/servo/ctrl"):
        assert channel in comments


def test_what_the_model_refers_to_comes_along(tmp_path):
    assert main(["new", str(tmp_path / "case"), "--model", str(write_arm(tmp_path / "robot"))]) == 0
    assert (tmp_path / "case" / "assets" / "tetra.obj").read_text() == TETRA
    assert mujoco.MjModel.from_xml_path(str(tmp_path / "case" / "arm.xml")).nmesh == 1


def test_folders_and_other_models_come_along_once(tmp_path):
    text = ARM.replace('meshdir="assets"', 'meshdir="assets/deep"').replace("tetra.obj", "../tetra.obj")
    text = text.replace("<worldbody>", '<include file="part.xml"/><worldbody>', 1)
    text = text.replace("<asset>", '<asset><model name="hand" file="hand.xml"/>')
    model = write_arm(tmp_path / "robot", text)
    (tmp_path / "robot" / "assets" / "deep").mkdir()
    (tmp_path / "robot" / "part.xml").write_text('<mujocoinclude><option gravity="0 0 -1"/></mujocoinclude>')
    hand = '<mujoco model="hand"><asset><mesh name="t" file="assets/tetra.obj"/></asset></mujoco>'
    (tmp_path / "robot" / "hand.xml").write_text(hand)
    files = referenced_files(model, tmp_path / "robot")
    assert len(files) == len({file.resolve() for file in files})
    assert {file.name for file in files} == {"arm.xml", "part.xml", "hand.xml", "tetra.obj"}


def test_models_that_refer_to_one_another_are_read_once(tmp_path):
    (tmp_path / "d" / "e").mkdir(parents=True)
    (tmp_path / "a.xml").write_text('<mujoco><include file="d/x.xml"/><asset><model file="a.xml"/></asset></mujoco>')
    (tmp_path / "d" / "x.xml").write_text('<mujocoinclude><include file="e/../x.xml"/></mujocoinclude>')
    assert {file.name for file in referenced_files(tmp_path / "a.xml", tmp_path)} == {"a.xml", "x.xml"}


def test_a_model_in_the_folder_stays_where_it_is(tmp_path):
    write_arm(tmp_path / "case" / "models")
    assert main(["new", str(tmp_path / "case"), "--model", str(tmp_path / "case" / "models" / "arm.xml")]) == 0
    assert 'model = "models/arm.xml"' in (tmp_path / "case" / "case.toml").read_text()
    assert not (tmp_path / "case" / "arm.xml").exists()


def test_elements_without_names_get_some_in_the_copy(tmp_path, capsys):
    """After joints and bodies, apart from names that are taken; only tags without names change."""
    text = ARM.replace('name="rail" ', "").replace('joint="rail"', 'joint="2nd joint"')
    text = text.replace('name="servo" ', "").replace('name="motor" ', "").replace('name="imu" ', "")
    text = text.replace("<worldbody>", '<include file="part.xml"/><worldbody>', 1).replace('body name="slider"', "body")
    model = write_arm(tmp_path / "robot", text)
    part = '<default><joint damping="0.1"/></default><sensor><jointpos joint="2nd joint"/></sensor>'
    part = f"<mujocoinclude>{part}</mujocoinclude>"
    (tmp_path / "robot" / "part.xml").write_text(part)
    before = mujoco.MjModel.from_xml_path(str(model))
    assert main(["new", str(tmp_path / "case"), "--model", str(model)]) == 0
    told = capsys.readouterr().out
    assert "arm.xml: what had no name has one in the case: " in told
    after = mujoco.MjModel.from_xml_path(str(tmp_path / "case" / "arm.xml"))
    names = [after.joint(i).name for i in range(after.njnt)], [after.actuator(i).name for i in range(after.nu)]
    assert names == (["2nd joint", "joint", "cube"], ["2nd joint", "2nd joint_2"])
    assert sorted(after.sensor(i).name for i in range(2)) == ["accelerometer_s", "jointpos_2nd joint"]
    np.testing.assert_array_equal(after.jnt_axis, before.jnt_axis)
    np.testing.assert_array_equal(after.actuator_gear, before.actuator_gear)
    assert "<freejoint name=" in (tmp_path / "case" / "arm.xml").read_text()
    assert (tmp_path / "robot" / "part.xml").read_text() == part


def test_elements_without_names_are_told_where_the_model_is_in_the_case(tmp_path, capsys):
    model = write_arm(tmp_path / "case", ARM.replace('name="rail" ', "").split("<actuator>")[0] + "</mujoco>")
    assert main(["new", str(tmp_path / "case"), "--model", str(model)]) == 0
    assert "joint 1 (of body slider) has no name" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("prepare", "message"),
    [
        (lambda case, robot: (case / "case.toml").write_text("x"), "case.toml: is there already"),
        (lambda case, robot: (case / "arm.xml").write_text("x"), "arm.xml: is there already and differs"),
        (lambda case, robot: (robot / "arm.xml").unlink(), "arm.xml: cannot be read (No such file or directory)"),
        (lambda case, robot: (robot / "arm.xml").write_text(ARM.replace("tetra.obj", "../tetra.obj")), None),
        (lambda case, robot: (robot / "arm.xml").write_text(ARM.replace("tetra.obj", "/tetra.obj")), "outside"),
        (lambda case, robot: (robot / "arm.xml").write_text(ARM.replace("2nd joint", "x", 1)), "does not compile"),
        (lambda case, robot: (robot / "assets" / "tetra.obj").unlink(), "does not compile"),
    ],
)
def test_nothing_is_written_where_something_is_wrong(tmp_path, capsys, prepare, message):
    case, robot = tmp_path / "case", tmp_path / "robot"
    case.mkdir()
    write_arm(robot)
    prepare(case, robot)
    before = {path: path.is_file() and path.read_bytes() for path in tmp_path.rglob("*")}
    assert main(["new", str(case), "--model", str(robot / "arm.xml")]) == 2
    told = capsys.readouterr().err
    assert told.count("\n") == 1
    assert (message or "arm.xml") in told
    assert {path: path.is_file() and path.read_bytes() for path in tmp_path.rglob("*")} == before
