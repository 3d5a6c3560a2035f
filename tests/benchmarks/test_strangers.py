"""Machines simulated as a stranger would are cases, and hide what they say they hide."""

import re

import numpy as np
import pytest

from bayessim_jax.effects import EFFECTS
from bayessim_jax.recordings.loading import load_case
from benchmarks.strangers import READINGS, UNKNOWN, draw_strangers, make_stranger
from benchmarks.textbook import COMMANDS, EDITS, FORCES

COUNTS = {"single": 1, "pair": 2, "unknown": 1, "clean": 0}
SHORT = {
    "seconds": 1.0,
    "recordings": 1,
    "rate": 100,
    "noise": 1e-9,
    "jitter": 0.0,
    "velocities": True,
    "damped": False,
    "filter": 0.0,
}


def of(case, **settings):
    return case | SHORT | settings


def test_a_set_is_drawn_again_and_holds_every_group():
    drawn = draw_strangers(60, 3)
    assert drawn == draw_strangers(60, 3) and drawn != draw_strangers(60, 4)
    assert {case["group"] for case in drawn} == set(COUNTS)
    assert all(len(set(case["effects"])) == COUNTS[case["group"]] for case in drawn)


@pytest.mark.parametrize("name", [*EDITS, *COMMANDS, *READINGS, *FORCES])
def test_every_effect_is_at_a_place_of_the_library_and_seen_in_what_is_recorded(tmp_path, name):
    case = of(draw_strangers(1, 5)[0], rig="arm", motion="sines", feedback=False, effects=[name])
    sealed = make_stranger(tmp_path / "with", case)
    make_stranger(tmp_path / "without", case | {"effects": []})
    found, plain = (load_case(tmp_path / which).check() for which in ("with", "without"))
    (hidden,) = sealed["effects"]
    if not name.startswith(UNKNOWN):
        assert hidden["at"] in [place.partition("#")[0] for place in EFFECTS[name].places(found.model)]
    columns = [np.concatenate([r.qpos, r.qvel], 1) for each in (found, plain) for r in each.recordings]
    assert np.isfinite(columns[0]).all()
    assert sealed["parameters"] and not np.allclose(columns[0], columns[1], atol=1e-4)


def test_filtered_velocities_are_late_by_the_filter(tmp_path):
    settings = {"seconds": 8.0, "recordings": 2, "rate": 200}
    case = of(draw_strangers(1, 5)[0], rig="arm", motion="sines", feedback=False, effects=[], **settings)
    make_stranger(tmp_path / "case", case | {"filter": 0.005})
    loaded = load_case(tmp_path / "case")
    assert loaded.lateness.channels == loaded.layout.qvel
    lags = [float(re.search(r"is ([\d.]+) ms later", f.what)[1]) for f in loaded.findings if "later" in f.what]
    np.testing.assert_allclose(lags, 5.0, rtol=0.1)
