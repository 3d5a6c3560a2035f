import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest

from bayessim_jax.inference.encoders import transition_features
from bayessim_jax.learning.fixed import RandomPolicy
from bayessim_jax.systems import CartPole, Pendulum
from benchmarks.data import as_recordings, draw_recordings, stack_rows
from benchmarks.timing import Parts, Spread

ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize("create", [CartPole.create, Pendulum.create])
def test_peers_read_what_our_encoders_read(create):
    system = create()
    thetas, recordings = draw_recordings(jax.random.key(0), system, RandomPolicy(system.actions), 7, 11)
    assert jax.vmap(system.parameters.contains)(thetas).all()
    np.testing.assert_array_equal(stack_rows(recordings), jax.vmap(transition_features)(recordings))


def test_a_peers_arrays_become_the_same_recordings():
    system = CartPole.create()
    _, made = draw_recordings(jax.random.key(1), system, RandomPolicy(system.actions), 3, 5)
    valid = np.ones((3, 5), bool)
    valid[1, 2:] = False
    again = as_recordings(system.dt, np.asarray(made.observations), np.asarray(made.actions), valid)
    np.testing.assert_array_equal(again.observations[0], made.observations[0])
    np.testing.assert_allclose(again.times[2], made.times[2])
    np.testing.assert_array_equal(again.valid, valid)
    assert not again.observations[1, 3:].any() and not again.diverged.any()


def test_a_spread_is_median_and_range():
    assert str(Spread.of([3.0, 1.0, 10.0])) == "3 (1 – 10)"
    assert Parts(1.0, 2.0, 3.5).total == 6.5
    with pytest.raises(ValueError, match="measure at least once"):
        Spread.of([])


def test_an_unknown_benchmark_is_refused_in_one_line():
    done = subprocess.run([sys.executable, "-m", "benchmarks", "onlin"], capture_output=True, text=True)
    assert done.returncode == 2 and "invalid choice" in done.stderr and "Traceback" not in done.stderr


def test_what_the_docs_say_of_concealed_effects_is_printed_from_the_records():
    command = [sys.executable, "-m", "benchmarks", "concealed", "--records"]
    records, docs = sorted((ROOT / "benchmarks/results").glob("concealed_*.jsonl")), (ROOT / "docs/benchmarks.md")
    text = docs.read_text()

    def run(*files):
        return subprocess.run([*command, *files], capture_output=True, text=True, check=True, cwd=ROOT).stdout.strip()

    # of every set a row, to which the docs add the commit
    assert [row for row in run(*records).splitlines()[2:] if f"{row} `" not in text] == []
    newest = max(records, key=lambda path: path.stem)
    assert run(newest) in text
    for strangers in sorted((ROOT / "benchmarks/results").glob("strangers_*.jsonl")):
        assert run(strangers) in text


def test_what_the_docs_say_of_recorded_answers_is_printed_from_the_records():
    records = sorted(map(str, (ROOT / "benchmarks/results").glob("concealed_[45]*.jsonl")))
    command = [sys.executable, "-m", "benchmarks", "thresholds", "--records", *records]
    printed = subprocess.run(command, capture_output=True, text=True, check=True, cwd=ROOT).stdout
    assert printed.strip() in (ROOT / "docs/diagnosis.md").read_text()
