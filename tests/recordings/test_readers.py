"""The same recording in four formats gives the same arrays; MCAP as JSON and as ROS 2 messages."""

import json
from types import SimpleNamespace

import numpy as np
import pytest

from bayessim_jax.recordings.case import ChannelSpec
from bayessim_jax.recordings.loading import load_case
from bayessim_jax.recordings.readers import read_table
from bayessim_jax.recordings.wording import CaseError
from tests.recordings.made_up_case import CASE, columns, csv_text, write_case

JOINT_STATE = """\
std_msgs/Header header
string[] name
float64[] position
float64[] velocity
float64[] effort
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""
ARRAY = """\
std_msgs/MultiArrayLayout layout
float64[] data
================================================================================
MSG: std_msgs/MultiArrayLayout
std_msgs/MultiArrayDimension[] dim
uint32 data_offset
================================================================================
MSG: std_msgs/MultiArrayDimension
string label
uint32 size
uint32 stride
"""
EPOCH = 1_700_000_000


def write_parquet(path, data):
    import pyarrow as pa
    from pyarrow import parquet

    parquet.write_table(pa.table(data), path, row_group_size=97)


def write_json_mcap(path, data):
    from mcap.writer import Writer

    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        schema = writer.register_schema("state", "jsonschema", b"{}")
        channel = writer.register_channel("/state", "json", schema)
        for i in range(len(data["time"])):
            message = json.dumps({name: float(values[i]) for name, values in data.items()}).encode()
            writer.add_message(channel, log_time=i, data=message, publish_time=i)
        writer.finish()


def write_ros2_mcap(path, data, every=3):
    """Joint states at each row and commands at every third, on a topic of its own and 1 ms later."""
    from mcap_ros2.writer import Writer

    with path.open("wb") as stream:
        writer = Writer(stream)
        states = writer.register_msgdef("sensor_msgs/msg/JointState", JOINT_STATE)
        commands = writer.register_msgdef("std_msgs/msg/Float64MultiArray", ARRAY)
        for i, time in enumerate(data["time"]):
            nanoseconds = EPOCH * 10**9 + round(time * 1e9)
            stamp = {"sec": nanoseconds // 10**9, "nanosec": nanoseconds % 10**9}
            message = {
                "header": {"stamp": stamp, "frame_id": ""},
                "name": ["hinge"],
                "position": [float(data["joint/hinge/qpos"][i])],
                "velocity": [float(data["joint/hinge/qvel"][i])],
                "effort": [0.0],
            }
            writer.write_message("/joint_states", states, message, log_time=nanoseconds + 5)
            if i % every == 0:
                command = {
                    "layout": {"dim": [], "data_offset": 0},
                    "data": [float(data["actuator/motor/ctrl"][i])],
                }
                writer.write_message("/commands", commands, command, log_time=nanoseconds + 1_000_000)
        writer.finish()


WRITERS = {
    "csv": lambda path, data: path.write_text(csv_text(data)),
    "parquet": write_parquet,
    "npz": lambda path, data: np.savez(path, **data),
    "mcap": write_json_mcap,
}


@pytest.mark.parametrize("kind", WRITERS)
def test_formats_agree(tmp_path, kind):
    data = columns()
    data["joint/hinge/qpos"][5] = np.nan
    WRITERS[kind](tmp_path / f"run.{kind}", data)
    table = read_table(tmp_path / f"run.{kind}")
    assert set(table.names) == set(data)
    for name, values in data.items():
        np.testing.assert_array_equal(table.columns[name], values)
    some = read_table(tmp_path / f"run.{kind}", {"time", "actuator/motor/ctrl"})
    assert set(some.columns) == {"time", "actuator/motor/ctrl"}
    assert set(some.names) == set(data)


@pytest.mark.parametrize("kind", ["parquet", "npz", "mcap"])
def test_a_case_of_another_format_is_the_same_case(tmp_path, kind):
    plain = load_case(write_case(tmp_path / "plain")).check()
    other = write_case(tmp_path / "other", case=CASE.replace("*.csv", f"*.{kind}"))
    WRITERS[kind](other / "recordings" / f"run1.{kind}", columns())
    loaded = load_case(other).check()
    assert loaded.findings == plain.findings == ()
    for name in ("time", "qpos", "qvel", "ctrl", "valid", "known", "qvel_measured"):
        np.testing.assert_array_equal(getattr(loaded.recordings[0], name), getattr(plain.recordings[0], name))


ROS_CASE = CASE.replace("*.csv", "*.mcap") + '[channels."actuator/motor/ctrl"]\ncolumn = "/commands/data/0"\n'


def test_ros_2_topics_of_different_rates_are_merged(tmp_path):
    folder = write_case(tmp_path, case=ROS_CASE)
    data = columns()
    write_ros2_mcap(folder / "recordings" / "run1.mcap", data)
    loaded = load_case(folder).check()
    (recording,) = loaded.recordings
    states = recording.qpos_measured[:, 0]
    assert (states.sum(), len(states)) == (400, 400 + 134)
    np.testing.assert_array_equal(recording.qpos[states, 0], data["joint/hinge/qpos"])
    np.testing.assert_array_equal(recording.qvel[states, 0], data["joint/hinge/qvel"])
    np.testing.assert_allclose(recording.time[states] - EPOCH, data["time"], atol=1e-6)
    # what is commanded 1 ms after row 0, 3, … is held until the next command
    np.testing.assert_array_equal(recording.ctrl[states, 0][1:], np.repeat(data["actuator/motor/ctrl"][::3], 3)[:399])
    assert recording.valid[1:].all()
    assert not recording.valid[0]
    said = [str(finding) for finding in loaded.findings]
    assert any("actuator/motor/ctrl is not known in 1 rows" in line for line in said)
    assert any("unknown column 'joint/hinge/effort' is not used" in line for line in said)
    assert not any("NaN" in line for line in said)
    assert len(loaded.windows()) == 7
    between = np.interp(recording.time[~states], recording.time[states], recording.qpos[states, 0])
    np.testing.assert_allclose(recording.qpos[~states, 0], between)


def test_messages_out_of_order_are_an_error(tmp_path):
    data = columns(50)
    data["time"][[20, 21]] = data["time"][[21, 20]]
    write_json_mcap(tmp_path / "run.mcap", data)
    with pytest.raises(CaseError, match=r"run\.mcap: time runs backwards in message 22 of '/state', at 0\.2 s"):
        read_table(tmp_path / "run.mcap")


@pytest.mark.parametrize("cut", [0.1, 0.5, 0.9, 0.999])
def test_a_truncated_mcap_is_one_line(tmp_path, cut):
    path = tmp_path / "run.mcap"
    write_ros2_mcap(path, columns(200))
    path.write_bytes(path.read_bytes()[: int(path.stat().st_size * cut)])
    with pytest.raises(CaseError, match=r"run\.mcap: is damaged or not MCAP") as error:
        read_table(path)
    assert "\n" not in str(error.value)


def test_a_spoiled_mcap_is_one_line(tmp_path):
    rng = np.random.default_rng(0)
    path = tmp_path / "run.mcap"
    write_ros2_mcap(path, columns(200))
    whole = path.read_bytes()
    refused = 0
    for _ in range(40):
        bad = bytearray(whole)
        for at in rng.integers(0, len(bad), 20):
            bad[at] = rng.integers(256)
        path.write_bytes(bytes(bad))
        try:
            read_table(path)
        except CaseError as error:
            refused += 1
            assert "\n" not in str(error)
    assert refused > 10


def test_a_csv_with_a_mark_and_windows_line_ends(tmp_path):
    path = tmp_path / "run.csv"
    path.write_bytes(b"\xef\xbb\xbf" + csv_text(columns(20)).replace("\n", "\r\n").replace(",", " , ").encode())
    np.testing.assert_array_equal(read_table(path).columns["joint/hinge/qpos"], columns(20)["joint/hinge/qpos"])


def test_a_quoted_header(tmp_path):
    (tmp_path / "run.csv").write_text('"time","a, b"\n0,1\n1,2\n')
    assert read_table(tmp_path / "run.csv").names == ("time", "a, b")


def test_a_channel_is_scaled_and_shifted(tmp_path):
    data = columns()
    data["angle_deg"] = np.rad2deg(data.pop("joint/hinge/qpos")) + 10
    data["ms"] = data.pop("time") * 1000 + 5
    text = csv_text({"time": data["ms"], **data}).replace("time,", "first,", 1)
    case = CASE + '[channels."joint/hinge/qpos"]\ncolumn = "angle_deg"\nscale = 0.017453292519943295\n'
    case += "offset = -0.17453292519943295\n[channels.time]\ncolumn = 'ms'\nscale = 0.001\n"
    loaded = load_case(write_case(tmp_path, case=case, run1=text)).check()
    np.testing.assert_allclose(loaded.recordings[0].qpos[:, 0], columns()["joint/hinge/qpos"], atol=1e-12)
    np.testing.assert_allclose(loaded.recordings[0].time, columns()["time"] + 0.005, atol=1e-12)
    assert [finding.what for finding in loaded.findings] == ["unknown column 'first' is not used"]
    assert loaded.case.channels["time"] == ChannelSpec("ms", 0.001)


def test_a_missing_library_is_one_line(tmp_path, monkeypatch):
    from bayessim_jax.recordings.readers import table

    def absent(name):
        return SimpleNamespace(read=lambda path, wanted: (_ for _ in ()).throw(ImportError("no", name="pyarrow")))

    monkeypatch.setattr(table, "import_module", absent)
    (tmp_path / "run.csv").write_text("time\n0\n")
    with pytest.raises(CaseError, match=r"run\.csv: reading it needs pyarrow; install it with pip\."):
        read_table(tmp_path / "run.csv")
