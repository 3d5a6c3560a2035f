import json
from pathlib import Path

import numpy as np
import pytest

from benchmarks.compilation import Compilation
from benchmarks.identification import MODELS, compare_methods, draw_clean, ranks, summarize
from benchmarks.worlds import RIGS, make_case

ROOT = Path(__file__).parents[2]


def records(name, method):
    lines = (ROOT / "benchmarks" / "results" / name).read_text(encoding="utf-8").splitlines()
    return [{"method": method, **json.loads(line)} for line in lines]


def test_the_table_of_the_docs_is_printed_from_the_records():
    rows = records("identification.jsonl", "direct")
    assert [row["case"] for row in rows] == draw_clean(list(MODELS), len(rows), 0, finer=4)
    docs = (ROOT / "docs" / "identification.md").read_text(encoding="utf-8")
    printed = summarize(rows).splitlines()
    assert len(printed) == 2 + len(MODELS) + 1
    assert [line for line in printed if line not in docs] == []


def test_the_table_of_methods_is_printed_from_the_records_of_the_same_cases():
    direct, networks = records("identification.jsonl", "direct"), records("identification_amortised.jsonl", "amortised")
    assert {row["method"] for row in networks} == {"amortised"} and len(networks) >= 15
    assert [row["case"] for row in networks] == [row["case"] for row in direct[: len(networks)]]
    docs = (ROOT / "docs" / "identification.md").read_text(encoding="utf-8")
    printed = compare_methods(networks, direct).splitlines()
    assert len(printed) == 4
    assert [line for line in printed if line not in docs] == []


def test_methods_are_compared_on_the_same_cases_alone():
    direct = records("identification.jsonl", "direct")
    other = [row | {"case": row["case"] | {"noise": 3.0}} for row in direct]
    with pytest.raises(SystemExit, match="not of the same cases"):
        compare_methods(other, direct)
    assert "| 1.00 (1.00 – 1.00) |" in compare_methods([row | {"method": "again"} for row in direct[:4]], direct)


def test_cases_of_any_number_are_spread_over_the_machines():
    rigs = [case["rig"] for case in draw_clean(list(MODELS), 13, 2)]
    counts = [rigs.count(rig) for rig in MODELS]
    assert max(counts) - min(counts) <= 1


def test_ranks_of_a_truth_from_the_posterior_itself_are_uniform():
    rng = np.random.default_rng(0)
    shape = np.array([[1.0, 0.9], [0.0, 0.1]])
    found = [ranks(rng.standard_normal((400, 2)) @ shape, rng.standard_normal(2) @ shape) for _ in range(400)]
    joint, below = np.array([f[0] for f in found]), np.array([f[1] for f in found])
    for values in (joint, below[:, 0], below[:, 1]):
        assert (values <= 0.5).mean() == pytest.approx(0.5, abs=0.1)
        assert (values <= 0.9).mean() == pytest.approx(0.9, abs=0.06)


def test_a_truth_off_the_ridge_is_outside_though_each_parameter_holds_it():
    ridge = np.random.default_rng(1).standard_normal((500, 2)) @ np.array([[1.0, 0.99], [0.0, 0.1]])
    joint, below = ranks(ridge, np.array([0.5, -0.5]))
    assert joint > 0.99
    assert (np.abs(below - 0.5) < 0.45).all()


def test_what_is_traced_within_what_is_traced_counts_once():
    watched = Compilation()
    watched.spans = [(3.0, 4.0), (0.0, 2.0), (0.5, 1.0), (1.5, 2.5)]
    assert watched.seconds == 3.5
    watched.listen("/jax/compilation_cache/compile_time_saved_sec", 9.0)
    assert watched.seconds == 3.5


def test_a_machine_of_a_finer_step_is_the_same_to_whoever_identifies_it(tmp_path):
    """The model and the rows are the rig's own; only the motion differs, by the integration error."""
    coarse, fine = (make_case(tmp_path / str(k), "slide", None, finer=k, noise=0.0, seconds=1.0) for k in (1, 4))
    assert coarse["parameters"] == fine["parameters"]
    tables = [np.loadtxt(tmp_path / k / "recordings" / "run1.csv", delimiter=",", skiprows=1) for k in "14"]
    assert (tmp_path / "1" / "model.xml").read_text() == (tmp_path / "4" / "model.xml").read_text()
    np.testing.assert_allclose(tables[0][:, 0], tables[1][:, 0], atol=1e-9)
    assert 0 < np.abs(tables[0][:, 1] - tables[1][:, 1]).max() < 0.05 * np.ptp(tables[0][:, 1])


def test_the_peer_finds_masses_without_noise(tmp_path):
    pytest.importorskip("tabulate")
    pytest.importorskip("colorama")
    from bayessim_jax.recordings.loading import load_case
    from bayessim_jax.recordings.shots import case_model, split_windows
    from benchmarks.peers.mujoco_sysid import identify

    sealed = make_case(tmp_path / "case", "double", None, seed=1, noise=0.0, recordings=2, seconds=2.0)
    model = case_model(load_case(tmp_path / "case").check(), refined=4)  # the step that the machine is simulated with
    found, seconds = identify(model, split_windows(model)[0])
    assert [p.name for p in model.case.parameters] == list(sealed["parameters"])
    np.testing.assert_allclose(found, list(sealed["parameters"].values()), rtol=1e-6)
    assert seconds > 0
    assert RIGS["double"].parameters == tuple(str(p.targets[0]) for p in model.case.parameters)
