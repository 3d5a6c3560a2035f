"""Recordings that judge are like those that are fitted, whatever the order they come in."""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest

from bayessim_jax.recordings.recording import CaseRecording
from bayessim_jax.recordings.splitting import choose_held_out, describe_inputs

TIME = np.arange(400) * 0.01
KINDS = {
    "sines": lambda rng: np.sin(2 * np.pi * rng.uniform(0.4, 0.6) * TIME),
    "chirp": lambda rng: np.sin(np.pi * rng.uniform(0.9, 1.1) * TIME**2),
    "steps": lambda rng: np.sign(np.sin(2 * np.pi * rng.uniform(0.4, 0.6) * TIME)),
    "none": lambda rng: np.zeros_like(TIME),
}


def record(kind, seed):
    rng = np.random.default_rng(seed)
    rows, seen = len(TIME), np.ones((len(TIME), 1), bool)
    return CaseRecording(
        kind,
        TIME,
        rng.uniform(0.6, 1.1) * KINDS[kind](rng)[:, None],
        rng.normal(size=(rows, 1)),
        rng.normal(size=(rows, 1)),
        np.zeros((rows, 0)),
        seen,
        seen,
        np.zeros((rows, 0), bool),
        np.ones(rows - 1, bool),
        np.ones(rows, bool),
    )


def energy(points, held):
    apart = np.linalg.norm(points[:, None] - points[None], axis=-1)
    parts = [apart[np.ix_(a, b)].mean() for a, b in ((held, ~held), (held, held), (~held, ~held))]
    return 2 * parts[0] - parts[1] - parts[2]


@pytest.mark.parametrize(
    "names", [("sines", "chirp", "steps") * 2, ("sines", "steps") * 4, ("sines",) * 4 + ("steps",) * 4]
)
@pytest.mark.parametrize("seed", range(5))
def test_no_kind_of_motion_is_kept_from_the_fit(names, seed):
    recordings = [record(name, 100 * seed + i) for i, name in enumerate(names)]
    held = choose_held_out(describe_inputs(recordings))
    assert held.sum() == 2
    assert {name for name, out in zip(names, held, strict=True) if not out} == set(names)
    assert len({name for name, out in zip(names, held, strict=True) if out}) == 2


@pytest.mark.parametrize("seed", range(8))
def test_groups_are_nearly_as_alike_as_any(seed):
    points = np.random.default_rng(seed).normal(size=(9, 2))
    held = choose_held_out(points)
    every = []
    for chosen in combinations(range(9), int(held.sum())):
        mask = np.zeros(9, bool)
        mask[list(chosen)] = True
        every.append(energy(points, mask))
    assert energy(points, held) <= np.quantile(every, 0.1)


def test_what_the_machine_did_decides_nothing():
    recordings = [record(name, i) for i, name in enumerate(("sines", "chirp", "steps", "none", "steps", "sines"))]
    other = [replace(r, qpos=r.qpos[::-1] * 7, qvel=r.qvel + 3) for r in recordings]
    np.testing.assert_array_equal(describe_inputs(recordings), describe_inputs(other))
    assert np.isfinite(describe_inputs(recordings)).all()


def test_recordings_without_commands_are_told_by_where_they_begin():
    begun = [
        replace(record("none", i), qpos=np.full((len(TIME), 1), x)) for i, x in enumerate((1.0, 1.0, 2.0, 2.0, 2.0))
    ]
    points = describe_inputs(begun)
    assert points[0, 0] == points[1, 0] < points[2, 0] == points[4, 0]


@pytest.mark.parametrize(("count", "kept"), [(0, 0), (1, 0), (2, 1), (3, 1), (6, 2), (40, 10)])
def test_about_a_quarter_is_held_out(count, kept):
    assert choose_held_out(np.zeros((count, 3))).sum() == kept
