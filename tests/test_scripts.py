"""The programs that reproduce experiments run from end to end at their smallest, and resume."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from bayessim_jax.cli.main import main

ROOT = Path(__file__).parents[1]


def run(script, *words):
    words = [sys.executable, str(ROOT / "scripts" / script), *map(str, words)]
    return subprocess.run(words, capture_output=True, text=True, check=True, cwd=ROOT).stdout


@pytest.mark.slow
def test_rows_of_table_one_run_and_resume(tmp_path):
    words = ["--rows", "fetch_push", "--columns", "epsilon_free", "--runs", 1, "--rounds", 2, "--small"]
    said = run("reproduce_table1.py", *words, "--out", tmp_path / "t.jsonl")
    assert "fetch_push" in said
    assert "| 2.10 |" in said
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


@pytest.mark.slow
def test_a_run_tells_how_well_its_recordings_are_read(tmp_path):
    """The run is left as it was; a system with no features of its own is read alike both ways."""
    folder = tmp_path / "run"
    words = ["online", "pendulum", "--target", "simulated", "--rounds", "1", "--simulations", "10", "--history", "1"]
    assert main([*words, "--calibrations", "10", "--steps", "20", "--quiet", "--out", str(folder)]) == 0
    before, two = sorted(path.relative_to(folder) for path in folder.rglob("*")), ("attention", "pooled_lstm")
    said = run(
        "read_recordings.py", folder, "--simulations", 20, 60, "--held-out", 100, "--encoders", *two
    ).splitlines()
    assert sorted(path.relative_to(folder) for path in folder.rglob("*")) == before
    assert said[0].startswith("prior: ")
    assert [line.split(":")[0] for line in said[1:]] == [
        f"{reading}, {name}, {n} simulations"
        for reading in ("plain", "of the system")
        for name in two
        for n in (20, 60)
    ]
    assert said[1].split("log q")[1] == said[5].split("log q")[1]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("script", "words"),
    [
        (
            "reproduce_table2",
            ["--samples", 32, "--steps", 20, "--episode", 20, "--simulations", 40, "--calibrations", 8],
        ),
        ("uses_of_theta", ["--systems", "pendulum", "--beliefs", "prior", "--budget", 32, "--steps", 5]),
        ("change_of_truth", ["--before", 1, "--after", 1, "--steps", 20, "--episode", 20]),
        ("change_of_truth", ["--change", "ice", "--before", 1, "--after", 1, "--steps", 20, "--episode", 20]),
    ],
)
def test_experiments_with_planners_run_and_resume(script, words, tmp_path):
    out = tmp_path / "t.jsonl"
    said = run(f"{script}.py", *words, "--runs", 2, "--out", out)
    assert len(out.read_text().splitlines()) == 2
    assert run(f"{script}.py", *words, "--runs", 2, "--out", out).split("\r")[-1] == said.split("\r")[-1]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("script", "words", "page"),
    [
        ("reproduce_table1", ["--kept", "--rows", "cartpole", "pendulum"], "benchmarks"),
        ("calibration", ["--kept", "--proposals", "corrected", "truncated", "paper"], "inference"),
        ("reproduce_table2", [], "control"),
        ("reproduce_table2", ["--use", "particles", "--particles", 4, "--samples", 128], "control"),
        ("reproduce_table2", ["--use", "sampled"], "control"),
        ("uses_of_theta", [], "control"),
        ("uses_of_theta", ["--systems", "cartpole", "--horizon", 40], "control"),
        (
            "uses_of_theta",
            ["--systems", "cartpole", "pendulum", "--beliefs", "posterior", "--budget", 8192],
            "control",
        ),
        ("change_of_truth", [], "control"),
        ("change_of_truth", ["--change", "ice"], "control"),
        ("warthog", [], "control"),
        ("real_cases", [], "identification"),
        ("made_up_vehicles", [], "real_recordings"),
    ],
)
def test_the_tables_of_the_docs_are_printed_from_the_records(script, words, page):
    """Nothing is simulated: the file of records stays as it is, and every row that is printed stands in the docs."""
    name = script.removeprefix("reproduce_")
    records = ROOT / "benchmarks" / "results" / f"{name}.jsonl"
    before = records.read_bytes()
    printed = run(f"{script}.py", *words, "--out", records)
    assert records.read_bytes() == before
    docs = (ROOT / "docs" / f"{page}.md").read_text()
    rows = [line for line in printed.replace("\r", "\n").splitlines() if line.startswith("| ")]
    assert len(rows) > 1
    assert [row for row in rows if row not in docs] == []


@pytest.mark.slow
def test_a_tutorial_writes_its_page_and_report(tmp_path):
    run("tutorials.py", "--only", "clean", "--docs", tmp_path)
    page = (tmp_path / "tutorials.md").read_text(encoding="utf-8")
    assert "| verdict | | `no_mismatch` |" in page
    assert "bayessim conceal docs/examples/pendulum/pendulum.xml --seed 1 --out clean" in page
    assert (tmp_path / "tutorials" / "clean.html").stat().st_size > 100_000


@pytest.mark.slow
def test_strikes_reach_farther_on_less_friction():
    said = run("slide_reach.py", "--frictions", 0.1, 1.5, "--tries", 16, "--generations", 1).splitlines()
    slippery, rough = (float(line.split("at most ")[1].split()[0]) for line in said)
    assert slippery > rough > 0.0
