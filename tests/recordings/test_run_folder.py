import json
import math

import pytest

from bayessim_jax.recordings.files import replace_file, to_json
from bayessim_jax.recordings.run_folder import RunFolder


def test_what_is_written_is_read_back(tmp_path):
    folder = RunFolder(tmp_path / "a" / "b").create()
    settings = {"system": "cartpole", "rounds": 3, "prior": {"length": [0.1, 1.0]}, "truth": {}}
    folder.write_config(settings)
    folder.write_run({"status": "running", "truth": {"length": 0.5}})
    folder.write_metrics([{"round": 1, "log_prob_true": 2.5}, {"round": 2, "log_prob_true": -math.inf}])
    again = RunFolder.open(tmp_path / "a" / "b")
    assert again.read_config() == settings
    assert again.read_run() == {"status": "running", "truth": {"length": 0.5}}
    assert again.read_metrics() == [{"round": 1, "log_prob_true": 2.5}, {"round": 2, "log_prob_true": None}]
    assert again.read_metrics(1) == [{"round": 1, "log_prob_true": 2.5}]


def test_json_has_no_nan():
    text = to_json({"a": [math.nan, 1.5, {"b": math.inf}], "c": -math.inf, "d": True})
    assert json.loads(text, parse_constant=pytest.fail) == {"a": [None, 1.5, {"b": None}], "c": None, "d": True}


def test_a_write_that_fails_leaves_the_old_file_and_no_litter(tmp_path):
    path = tmp_path / "x.json"
    path.write_text("old")

    def fail(temporary):
        temporary.write_text("half")
        raise RuntimeError("disk full")

    with pytest.raises(RuntimeError):
        replace_file(path, fail)
    assert path.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["x.json"]


def test_a_used_folder_is_refused_and_untouched(tmp_path):
    (tmp_path / "note.txt").write_text("mine")
    with pytest.raises(ValueError, match=r"already used; choose another --out"):
        RunFolder(tmp_path).create()
    with pytest.raises(ValueError, match=r"already used; continue with --resume or choose another --out"):
        RunFolder(tmp_path).check_free(resumable=True)
    assert [p.name for p in tmp_path.iterdir()] == ["note.txt"]


def test_an_unwritable_place_is_refused(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(ValueError, match="is a file"):
        RunFolder(tmp_path / "file").create()
    with pytest.raises(ValueError, match=r"cannot write.*Not a directory"):
        RunFolder(tmp_path / "file" / "below").create()


@pytest.mark.parametrize("name", ["config.toml", "run.json", "metrics.jsonl"])
@pytest.mark.parametrize("damage", ["{ half", None])
def test_a_damaged_file_is_named(tmp_path, name, damage):
    folder = RunFolder(tmp_path)
    if damage is not None:
        (tmp_path / name).write_text(damage)
    read = {"config.toml": folder.read_config, "run.json": folder.read_run, "metrics.jsonl": folder.read_metrics}
    with pytest.raises(ValueError, match=f"{name} is missing or damaged"):
        read[name]()


def test_a_folder_without_a_run_is_told(tmp_path):
    with pytest.raises(ValueError, match="no run in"):
        RunFolder.open(tmp_path)
