"""The programs that reproduce the contact-rich experiments run from end to end at their smallest, and resume."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


def run(script, *words):
    words = [sys.executable, str(ROOT / "scripts" / script), *map(str, words)]
    return subprocess.run(words, capture_output=True, text=True, check=True, cwd=ROOT).stdout


@pytest.mark.slow
def test_rows_of_table_one_run_and_resume(tmp_path):
    words = ["--rows", "fetch_push", "--columns", "epsilon_free", "--runs", 1, "--rounds", 2, "--small"]
    said = run("reproduce_table1.py", *words, "--out", tmp_path / "t.jsonl")
    assert "fetch_push" in said
    assert "paper 2.09" in said
    assert len((tmp_path / "t.jsonl").read_text().splitlines()) == 1
    assert run("reproduce_table1.py", *words, "--out", tmp_path / "t.jsonl").split("\r")[-1] == said.split("\r")[-1]


@pytest.mark.slow
def test_figure_two_runs_and_draws(tmp_path):
    out, figure = tmp_path / "f.jsonl", tmp_path / "f.svg"
    words = ["--systems", "fetch_push", "--runs", 1, "--rounds", 2, "--episodes", 2, "--small"]
    said = run("reproduce_figure2.py", *words, "--out", out, "--figure", figure)
    assert all(scheme in said for scheme in ("online", "offline", "uniform"))
    lines = [json.loads(line) for line in out.read_text().splitlines()]
    assert [line["scheme"] for line in lines] == ["online", "offline", "uniform"]
    assert all(len(line["success"]) == 2 for line in lines)
    assert figure.stat().st_size > 1000
