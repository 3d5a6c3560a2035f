"""`bayessim check` and `bayessim new`: what is told of good cases, and one line for everything that is broken."""

import io
import os
import pickle
import shutil
import subprocess
import sys
import zipfile

import numpy as np
import pytest

from bayessim_jax.cli.main import main
from tests.recordings.made_up_case import CASE, MODEL, columns, csv_text, write_case

DEGREES = 180 / np.pi
QPOS = "joint/hinge/qpos"


def contents(folder):
    return {path.relative_to(folder): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_a_good_case_is_described(tmp_path, capsys):
    assert main(["check", str(write_case(tmp_path))]) == 0
    told = capsys.readouterr()
    assert told.err == ""
    assert "model.xml with 1 joint, 1 actuator, 1 sensor value" in told.out
    assert "bob_mass = body/bob/mass: uniform, 0.15 to 0.6 kg; 0.3 in the model" in told.out
    assert (
        "run1.csv: 400 rows, 3.99 s at 100 Hz; qpos 1/1, qvel 1/1, sensors 0/1, ctrl 1/1 measured; 7 windows"
        in told.out
    )
    assert "windows     7 of 0.5 s, from 1 recording; 0.49 of 3.99 s lie in none of them" in told.out
    assert told.out.endswith("ok          the case can be used\n")


def csv(**changes):
    """The recording with columns replaced; None takes one away."""
    data = columns()
    for name, change in changes.items():
        name = {"qpos": "joint/hinge/qpos", "qvel": "joint/hinge/qvel", "ctrl": "actuator/motor/ctrl"}.get(name, name)
        if change is None:
            del data[name]
        else:
            data[name] = change(data[name]) if name in data else change(data["time"])
    return csv_text(data)


def put(row, value):
    def change(column):
        column = column.astype(object)
        column[row] = value
        return column

    return change


def swap(a, b):
    def change(column):
        column[[a, b]] = column[[b, a]]
        return column

    return change


def toml(old, new):
    assert old in CASE
    return CASE.replace(old, new)


def xml(old, new):
    assert old in MODEL
    return MODEL.replace(old, new)


TARGET = '"body/bob/mass"'
PRIOR = '{ distribution = "uniform", low = 0.15, high = 0.6 }'

BROKEN = {
    # name: (what is written, fragments of the one line)
    "time backwards": (
        {"run1": csv(time=swap(100, 101))},
        ["run1.csv, row 102 (line 103)", "time runs backwards, from 1.01 to 1 s", "sort the rows"],
    ),
    "clock set back": (
        {"run1": csv(time=lambda t: np.where(t > 2, t - 1.5, t))},
        ["run1.csv, row 202", "time runs backwards", "split the file"],
    ),
    "jitter that is not monotonic": (
        {"run1": csv(time=lambda t: t + 0.02 * np.random.default_rng(0).standard_normal(len(t)))},
        ["run1.csv, row", "time runs backwards", "times in the file"],
    ),
    "duplicate time": (
        {"run1": csv(time=lambda t: put(50, t[49])(t))},
        ["run1.csv, row 51 (line 52)", "time occurs twice, at 0.49 s", "keep one row"],
    ),
    "NaN in time": ({"run1": csv(time=put(7, "nan"))}, ["run1.csv, row 8 (line 9)", "time is not a finite number"]),
    "missing position": (
        {"run1": csv(qpos=None)},
        ["run1.csv: column 'joint/hinge/qpos' is missing", "cannot be started without it"],
    ),
    "missing command": (
        {"run1": csv(ctrl=None)},
        ["run1.csv: column 'actuator/motor/ctrl' is missing", "zeros where the actuator was off"],
    ),
    "missing time": ({"run1": csv_text(columns()).replace("time,", "t,", 1)}, ["column 'time' is missing", "in s"]),
    "channel under another name": (
        {"run1": csv_text(columns()).replace("joint/hinge/qpos", "joint/hinge/pos", 1)},
        ["column 'joint/hinge/qpos' is missing", "did you mean 'joint/hinge/pos'?", '[channels."joint/hinge/qpos"]'],
    ),
    "channel all NaN": ({"run1": csv(qpos=lambda q: np.nan * q)}, ["run1.csv: joint/hinge/qpos holds no number"]),
    "column of text": (
        {"run1": csv(qpos=put(20, "left"))},
        ["run1.csv, row 21 (line 22)", "column 'joint/hinge/qpos' holds 'left'", "no number"],
    ),
    "empty file": ({"run1": ""}, ["run1.csv: the file is empty"]),
    "header without rows": ({"run1": "time,joint/hinge/qpos,actuator/motor/ctrl\n"}, ["run1.csv: has 0 rows"]),
    "no header": ({"run1": csv_text(columns()).split("\n", 1)[1]}, ["run1.csv: has no header"]),
    "truncated row": (
        {"run1": csv_text(columns()).rsplit(",", 2)[0]},
        ["run1.csv, row 400 (line 401)", "has 2 of 4 columns", "cut off"],
    ),
    "semicolons": ({"run1": csv_text(columns()).replace(",", ";")}, ["columns are separated by semicolons"]),
    "column twice": (
        {"run1": csv_text(columns()).replace("joint/hinge/qvel", "joint/hinge/qpos", 1)},
        ["run1.csv: column 'joint/hinge/qpos' occurs twice"],
    ),
    "no window": ({"run1": columns(40)}, ["case.toml: no recording holds a window of horizon = 0.5 s"]),
    "no recordings": (
        {"case": toml("recordings/*.csv", "records/*.csv")},
        ["case.toml: no file matches recordings = 'records/*.csv'", ".parquet"],
    ),
    "recordings outside": (
        {"case": toml("recordings/*.csv", "../*.csv")},
        ["recordings '../*.csv' lie outside of the case folder"],
    ),
    "unknown body": (
        {"case": toml(TARGET, '"body/bobb/mass"')},
        ["parameter bob_mass: unknown path 'body/bobb/mass'", "no such body", "did you mean 'body/bob/mass'"],
    ),
    "unknown joint": (
        {"case": toml(TARGET, '"joint/elbow/damping"')},
        ["unknown path 'joint/elbow/damping'", "no such joint", "'joint/hinge/damping'"],
    ),
    "unknown field": (
        {"case": toml(TARGET, '"joint/hinge/dampng"')},
        ["unknown path 'joint/hinge/dampng'", "did you mean 'joint/hinge/damping'?"],
    ),
    "unknown kind": (
        {"case": toml(TARGET, '"joints/hinge/damping"')},
        ["unknown path 'joints/hinge/damping'", "did you mean 'joint/hinge/damping'"],
    ),
    "missing index": ({"case": toml(TARGET, '"body/bob/ipos"')}, ["ipos needs an index, ipos/0 to ipos/2"]),
    "index too large": (
        {"case": toml(TARGET, '"option/gravity/3"')},
        ["gravity needs an index, gravity/0 to gravity/2"],
    ),
    "prior outside the physical range": (
        {"case": toml("low = 0.15", "low = -0.15")},
        ["parameter bob_mass: the prior reaches down to -0.15", "body/bob/mass has to be above 0", "raise 'low'"],
    ),
    "normal prior far below zero": (
        {"case": toml(PRIOR, '{ distribution = "normal", mean = 0.1, sd = 1 }')},
        ["0.46 of the prior lies below 0", "use a lognormal or truncated normal prior"],
    ),
    "negative mass": (
        {"case": toml(PRIOR, '{ distribution = "uniform", low = -0.6, high = -0.15 }')},
        ["the prior reaches down to -0.6", "has to be above 0"],
    ),
    "low above high": (
        {"case": toml("low = 0.15, high = 0.6", "low = 0.6, high = 0.15")},
        ["case.toml: parameter bob_mass: prior: low 0.6 must be below high 0.15; swap"],
    ),
    "low equals high": ({"case": toml("low = 0.15", "low = 0.6")}, ["low 0.6 must be below high 0.6"]),
    "unknown distribution": (
        {"case": toml('"uniform"', '"unifrom"')},
        ["case.toml: parameter bob_mass: prior: unknown distribution 'unifrom'", "did you mean 'uniform'?"],
    ),
    "missing bound": ({"case": toml("low = 0.15, ", "")}, ["key 'low' of the uniform prior is missing"]),
    "bound that is text": ({"case": toml("0.15", '"0.15"')}, ["low is '0.15'", "needs a finite number"]),
    "bound that is infinite": ({"case": toml("0.15", "-inf")}, ["low is '-inf'", "needs a finite number"]),
    "wrong schema": ({"case": toml("schema = 1", "schema = 2")}, ["case.toml: schema is '2', this version reads 1"]),
    "no schema": ({"case": toml("schema = 1", "")}, ["case.toml: key 'schema' is missing"]),
    "wrong key": (
        {"case": toml("horizon", "horizont")},
        ["case.toml: unknown key 'horizont'", "did you mean 'horizon'?"],
    ),
    "wrong key of a parameter": (
        {"case": toml("targets", "target")},
        ["case.toml: parameter 1: unknown key 'target'", "did you mean 'targets'?"],
    ),
    "wrong key of a channel": (
        {"case": CASE + '[channels."joint/hinge/qpos"]\nscle = 2\n'},
        ["channels.'joint/hinge/qpos': unknown key 'scle'", "did you mean 'scale'?"],
    ),
    "unknown channel": (
        {"case": CASE + '[channels."joint/hing/qpos"]\nscale = 2\n'},
        ["case.toml: [channels]: unknown channel 'joint/hing/qpos'", "did you mean 'joint/hinge/qpos'"],
    ),
    "channel from a missing column": (
        {"case": CASE + '[channels."joint/hinge/qpos"]\ncolumn = "joint/hinge/qos"\n'},
        ["run1.csv: column 'joint/hinge/qos', which case.toml names for joint/hinge/qpos, is missing", "did you mean"],
    ),
    "horizon of zero": ({"case": toml("0.5", "0")}, ["horizon is 0; it must be above 0 s"]),
    "parameter twice": (
        {"case": CASE + CASE[CASE.index("[[") :].replace("body/bob/mass", "joint/hinge/damping")},
        ["parameter bob_mass occurs twice"],
    ),
    "target that is no list": ({"case": toml(f"[{TARGET}]", TARGET)}, ["targets is 'body/bob/mass'; it needs a list"]),
    "targets empty": ({"case": toml(TARGET, "")}, ["parameter bob_mass: targets is '[]'; it needs a list of paths"]),
    "pattern that is none": ({"case": toml("*.csv", "**x")}, ["recordings = 'recordings/**x' is no pattern"]),
    "target twice": (
        {"case": CASE + CASE[CASE.index("[[") :].replace("bob_mass", "other")},
        ["parameter other: target 'body/bob/mass' is bob_mass's already"],
    ),
    "TOML syntax": ({"case": toml("schema = 1", "schema = = 1")}, ["case.toml: is not TOML", "line 2"]),
    "both model and system": (
        {"case": toml("schema = 1", 'schema = 1\nsystem = "pendulum"')},
        ["both 'model' and 'system' are given"],
    ),
    "unknown system": (
        {"case": toml('model = "model.xml"', 'system = "pendulm"')},
        ["case.toml: unknown system 'pendulm'", "did you mean 'pendulum'?"],
    ),
    "no model": ({"case": toml("model.xml", "robot.xml")}, ["robot.xml: cannot be read (No such file"]),
    "model outside": ({"case": toml("model.xml", "../model.xml")}, ["'../model.xml' lies outside of the case folder"]),
    "model that does not compile": (
        {"model": xml('joint="hinge" gear', 'joint="elbow" gear')},
        ["model.xml: does not compile", "elbow", "correct it"],
    ),
    "massless body": (
        {"model": xml('mass="0.3"', 'mass="0"')},
        ["model.xml: does not compile", "mass and inertia of moving bodies", "line"],
    ),
    "model that is not XML": ({"model": xml("</mujoco>", "")}, ["model.xml: is not XML"]),
    "model that is not MJCF": (
        {"model": "<robot name='r'/>"},
        ["model.xml: is not MJCF, its outermost element is <robot>"],
    ),
    "include outside": (
        {"model": xml("<worldbody>", '<include file="../secret.xml"/><worldbody>')},
        ["model.xml: <include> refers to '../secret.xml', outside of the case folder"],
    ),
    "absolute mesh": (
        {"model": xml("<worldbody>", '<asset><mesh name="m" file="/etc/hostname.stl"/></asset><worldbody>')},
        ["<mesh> refers to '/etc/hostname.stl', outside"],
    ),
    "mesh folder outside": (
        {"model": xml("<worldbody>", '<compiler meshdir=".."/><asset><mesh file="m.stl"/></asset><worldbody>')},
        ["<compiler> refers to '..', outside"],
    ),
    "joint without a name": (
        {"model": MODEL.replace('name="hinge" type', "type").split("<actuator>")[0] + "</mujoco>"},
        ["model.xml: joint 0 (of body bob) has no name", "name it"],
    ),
    "size of a mesh-like geom": ({"case": toml(TARGET, '"geom/floor/size/0"')}, ["has no sizes that can be set"]),
    "NaN": ({"run1": csv(qpos=put(30, "nan"))}, ["run1.csv, row 31 (line 32): joint/hinge/qpos is empty or NaN"]),
    "empty cells": (
        {"run1": csv(qvel=lambda v: put(slice(10, 14), "")(v))},
        [
            "run1.csv, row 11",
            "joint/hinge/qvel is empty or NaN in 4 of 400 rows",
            "fill it in where you know it, or give --mask",
        ],
    ),
    "infinite": ({"run1": csv(qpos=put(30, "inf"))}, ["run1.csv, row 31", "joint/hinge/qpos is not finite"]),
    "gap": (
        {"run1": csv(time=lambda t: np.where(t >= 2, t + 1, t))},
        ["run1.csv, row 201 (line 202): gap of 1.01 s from 1.99 to 3 s", "split the file there, or give --mask"],
    ),
}


def broken(tmp_path, written):
    parts = {key: value for key, value in written.items() if key in ("case", "model")}
    runs = {key: value for key, value in written.items() if key.startswith("run")}
    return write_case(tmp_path / "case", **parts, **runs)


@pytest.mark.parametrize("name", BROKEN)
def test_a_broken_case_is_one_line_and_exit_code_two(tmp_path, capsys, name):
    written, fragments = BROKEN[name]
    folder = broken(tmp_path, written)
    before = contents(tmp_path)
    assert main(["check", str(folder)]) == 2
    told = capsys.readouterr()
    assert told.err.count("\n") == 1, told.err
    assert told.err.startswith("bayessim: ")
    for fragment in fragments:
        assert fragment in told.err
    assert "Traceback" not in told.err
    assert contents(tmp_path) == before


@pytest.mark.parametrize("name", ["NaN", "empty cells", "infinite", "gap"])
def test_holes_are_masked_where_that_is_asked_for(tmp_path, capsys, name):
    folder = broken(tmp_path, BROKEN[name][0])
    assert main(["check", str(folder), "--mask"]) == 0
    told = capsys.readouterr()
    assert told.err == ""
    warnings = [line for line in told.out.splitlines() if line.startswith("warning")]
    assert len(warnings) == 1
    assert "masked there" in warnings[0] or "no window is compared across it" in warnings[0]


def latin(folder):
    path = folder / "recordings" / "run1.csv"
    path.write_bytes(path.read_bytes().replace(b"joint/hinge/qvel", "joint/hinge/größe".encode("latin-1"), 1))


def utf16(folder):
    path = folder / "recordings" / "run1.csv"
    path.write_text(path.read_text(), encoding="utf-16")


def toml_latin(folder):
    (folder / "case.toml").write_bytes(CASE.replace('"rig"', '"größe"').encode("latin-1"))


def npz(folder, **arrays):
    (folder / "case.toml").write_text(toml("*.csv", "*.npz"))
    np.savez(folder / "recordings" / "run1.npz", **arrays)
    return folder / "recordings" / "run1.npz"


def object_array(folder):
    npz(folder, **{**columns(), "joint/hinge/qpos": np.array([{}] * 400, object)})


def pickled(folder):
    path = npz(folder)
    path.write_bytes(pickle.dumps(columns()))


def pickle_inside(folder):
    path = npz(folder, time=columns()["time"])
    with zipfile.ZipFile(path, "a") as file:
        for name in ("joint/hinge/qpos", "actuator/motor/ctrl"):
            stream = io.BytesIO()
            np.lib.format.write_array(stream, np.array([print] * 3, object), allow_pickle=True)
            file.writestr(f"{name}.npy", stream.getvalue())


def npz_lengths(folder):
    npz(folder, **{**columns(), "joint/hinge/qpos": np.zeros(7)})


def npz_truncated(folder):
    path = npz(folder, **columns())
    path.write_bytes(path.read_bytes()[:5000])


def parquet(folder, data):
    import pyarrow as pa
    from pyarrow import parquet

    (folder / "case.toml").write_text(toml("*.csv", "*.parquet"))
    path = folder / "recordings" / "run1.parquet"
    parquet.write_table(pa.table(data), path)
    return path


def parquet_truncated(folder):
    path = parquet(folder, columns())
    path.write_bytes(path.read_bytes()[:-100])


def parquet_text(folder):
    parquet(folder, {**columns(), "joint/hinge/qpos": ["left"] * 400})


def mcap_garbage(folder):
    (folder / "case.toml").write_text(toml("*.csv", "*.mcap"))
    (folder / "recordings" / "run1.mcap").write_bytes(b"no recording at all" * 10)


def unknown_format(folder):
    (folder / "case.toml").write_text(toml("*.csv", "*.bag"))
    (folder / "recordings" / "run1.bag").write_bytes(b"x")


def no_folder(folder):
    shutil.rmtree(folder)


def linked_mesh(folder):
    (folder.parent / "outside.xml").write_text("<mujocoinclude/>")
    (folder / "inside.xml").symlink_to(folder.parent / "outside.xml")
    (folder / "model.xml").write_text(xml("<worldbody>", '<include file="inside.xml"/><worldbody>'))


def nested_include(folder):
    (folder / "part.xml").write_text('<mujocoinclude><include file="../other.xml"/></mujocoinclude>')
    (folder / "model.xml").write_text(xml("<worldbody>", '<include file="part.xml"/><worldbody>'))


def folder_from_an_include(folder):
    (folder / "part.xml").write_text('<mujocoinclude><compiler assetdir="/tmp"/></mujocoinclude>')
    (folder / "model.xml").write_text(
        xml("<worldbody>", '<asset><mesh file="m.stl"/></asset><include file="part.xml"/><worldbody>')
    )


@pytest.mark.parametrize(
    ("spoil", "fragments"),
    [
        (latin, ["run1.csv: the header is not UTF-8 text"]),
        (utf16, ["run1.csv: is not UTF-8 text"]),
        (toml_latin, ["case.toml: is not UTF-8 text"]),
        (object_array, ["run1.npz: array 'joint/hinge/qpos' holds Python objects"]),
        (pickled, ["run1.npz: is a pickle"]),
        (pickle_inside, ["run1.npz: array 'joint/hinge/qpos' holds Python objects"]),
        (npz_lengths, ["run1.npz: 'joint/hinge/qpos' has 7 rows", "give all arrays one length"]),
        (npz_truncated, ["run1.npz: is damaged or not NPZ"]),
        (parquet_truncated, ["run1.parquet: is damaged or not Parquet"]),
        (parquet_text, ["run1.parquet: column 'joint/hinge/qpos' holds string, not numbers"]),
        (mcap_garbage, ["run1.mcap: is damaged or not MCAP"]),
        (unknown_format, ["run1.bag: unknown format '.bag'"]),
        (no_folder, ["case.toml: cannot be read in", "No such file"]),
        (linked_mesh, ["model.xml: <include> refers to 'inside.xml', outside"]),
        (folder_from_an_include, ["part.xml: <compiler> refers to '/tmp', outside"]),
        (nested_include, ["part.xml: <include> refers to '../other.xml', outside"]),
    ],
    ids=lambda x: getattr(x, "__name__", ""),
)
def test_a_file_that_cannot_be_read_is_one_line(tmp_path, capsys, spoil, fragments):
    folder = write_case(tmp_path / "case")
    spoil(folder)
    before = contents(tmp_path)
    assert main(["check", str(folder)]) == 2
    told = capsys.readouterr()
    assert told.err.count("\n") == 1, told.err
    for fragment in fragments:
        assert fragment in told.err
    assert contents(tmp_path) == before


DOUBTFUL = {
    "short gap": (
        {"run1": csv(time=lambda t: np.where(t >= 2, t + 0.2, t))},
        ["run1.csv, row 201 (line 202): gap of 0.21 s from 1.99 to 2.2 s", "no window is compared across it"],
    ),
    "a slower log": (
        {"run1": csv(qvel=lambda v: np.where(np.arange(len(v)) % 2, "", v.astype(str)))},
        ["run1.csv, row 2", "joint/hinge/qvel is empty or NaN in 200 of 400 rows", "masked there"],
    ),
    "unknown column": (
        {"run1": csv(temperature=lambda t: 20 + t)},
        ["run1.csv: unknown column 'temperature' is not used"],
    ),
    "column of an unknown joint": (
        {"run1": csv(**{"joint/elbow/qpos": lambda t: t})},
        ["unknown column 'joint/elbow/qpos' is not used: the simulator has no such channel"],
    ),
    "near miss of a sensor": (
        {"run1": csv(**{"sensor/encodr": lambda t: t})},
        [
            "unknown column 'sensor/encodr' is not used: the simulator has no such channel",
            "did you mean 'sensor/encoder'?",
        ],
    ),
    "HTML in a column": (
        {"run1": csv(**{"<script>alert(1)</script>": lambda t: t})},
        ["unknown column '<script>alert(1)</script>' is not used"],
    ),
    "letters in a column": ({"run1": csv(größe=lambda t: t)}, ["unknown column 'größe' is not used"]),
    "escape sequence in a column": ({"run1": csv(**{"\x1b[31mred": lambda t: t})}, [r"unknown column '\x1b[31mred'"]),
    "unused text": ({"run1": csv(note=lambda t: ["ok"] * len(t))}, ["unknown column 'note' is not used"]),
    "position in degrees": (
        {"run1": csv(qpos=lambda q: q * DEGREES)},
        ["suspicion   run1.csv: joint/hinge moves 57.", "qpos looks like degrees", "scale = 0.01745"],
    ),
    "velocity in degrees": (
        {"run1": csv(qvel=lambda v: v * DEGREES)},
        ["qvel looks like degrees per second", '[channels."joint/hinge/qvel"]'],
    ),
    "all in degrees": (
        {"run1": csv(qpos=lambda q: q * DEGREES, qvel=lambda v: v * DEGREES)},
        ["joint/hinge/qpos swings over", "it looks like degrees"],
    ),
    "position in degrees, no velocity": (
        {"run1": csv(qpos=lambda q: q * DEGREES, qvel=None)},
        ["joint/hinge/qpos swings over", "it looks like degrees"],
    ),
    "degrees against a limited joint": (
        {
            "run1": csv(qpos=lambda q: q * DEGREES, qvel=None),
            "model": xml('damping="0.05"', 'damping="0.05" range="-90 90"'),
        },
        ["its range is -1.571 to 1.571: it looks like degrees"],
    ),
    "reversed velocity": ({"run1": csv(qvel=lambda v: -v)}, ["the other way", "scale = -1"]),
    "time in milliseconds": (
        {"run1": csv(time=lambda t: t * 1000), "case": toml("0.5", "500")},
        ["rows are 10 s apart: time looks like milliseconds", '[channels."time"]'],
    ),
    "command beyond its range": (
        {"run1": csv(ctrl=lambda u: u * 100)},
        ["actuator/motor/ctrl goes from -40 to 40, its ctrlrange is -2 to 2"],
    ),
    "wrapped angle": (
        {"run1": csv(qpos=lambda q: (q + 2.5 + np.pi) % (2 * np.pi) - np.pi)},
        ["joint/hinge/qpos jumps by a whole turn", "made continuous"],
    ),
    "nominal outside the prior": (
        {"case": toml("low = 0.15", "low = 0.4")},
        ["parameter bob_mass: the model's own value 0.3 lies outside of the prior"],
    ),
    "normal prior that touches zero": (
        {"case": toml(PRIOR, '{ distribution = "normal", mean = 0.3, sd = 0.1 }')},
        ["0.0013 of the prior lies below 0", "it is cut off at 0.0003"],
    ),
    "no parameters": ({"case": CASE[: CASE.index("[[")]}, ["case.toml: names no parameters"]),
    "one recording too short": (
        {"run1": columns(), "run2": columns(40)},
        ["run2.csv: holds no window of 0.5 s without a gap"],
    ),
    "degrees in two files": (
        {
            "run1": csv(qpos=lambda q: q * DEGREES),
            "run2": csv_text(columns(300) | {QPOS: columns(300)[QPOS] * DEGREES}),
        },
        ["run1.csv and 1 more file: joint/hinge moves 57.", "qpos looks like degrees"],
    ),
    "a column in two files": (
        {"run1": csv(a=lambda t: t), "run2": csv(a=lambda t: t)},
        ["run1.csv and 1 more file: unknown column 'a' is not used"],
    ),
}


@pytest.mark.parametrize("name", DOUBTFUL)
def test_what_is_doubtful_or_not_used_gets_a_line_and_the_case_can_be_used(tmp_path, capsys, name):
    written, fragments = DOUBTFUL[name]
    folder = broken(tmp_path, written)
    assert main(["check", str(folder)]) == 0
    told = capsys.readouterr()
    assert told.err == ""
    remarks = [line for line in told.out.splitlines() if line.startswith(("warning", "suspicion"))]
    assert len(remarks) == 1, remarks
    for fragment in fragments:
        assert fragment in remarks[0]
    assert "\x1b" not in told.out


def test_names_are_shown_wherever_the_terminal_can(tmp_path):
    folder = write_case(tmp_path / "case", case=toml('"kg"', '"kg²"'))
    code = f"import sys\nfrom bayessim_jax.cli.main import main\nsys.exit(main(['check', {str(folder)!r}]))"
    for encoding, shown in (("utf-8", "kg²"), ("ascii", r"kg\xb2")):
        environment = os.environ | {"PYTHONIOENCODING": encoding}
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, env=environment, timeout=120)
        assert done.returncode == 0, done.stderr
        assert shown in done.stdout.decode(encoding)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["check"], "bayessim check needs CASE; see bayessim check --help."),
        (["check", "a", "--quick"], "unknown flag '--quick'"),
        (["new", "a"], "bayessim new needs --model FILE;"),
        (["check", "a", "b"], "Unrecognized options: b"),
        (["new", "a", "--modle", "b"], "unknown flag '--modle': did you mean '--model'?"),
    ],
)
def test_bad_usage_is_one_line(capsys, words, message):
    assert main(words) == 2
    told = capsys.readouterr().err
    assert message in told
    assert told.count("\n") == 1


def test_the_command_line_answers_without_jax(tmp_path):
    folder = write_case(tmp_path / "case")
    code = f"import sys\nfrom bayessim_jax.cli.main import main\ncode = main(['check', {str(folder)!r}])\n"
    code += "assert 'jax' not in sys.modules\nsys.exit(code)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
