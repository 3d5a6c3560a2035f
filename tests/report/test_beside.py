"""Target and simulator side by side: what is replayed, and what is drawn of it."""

import functools
import json
import re
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayessim_jax.cli.beside import replay
from bayessim_jax.learning import RandomPolicy
from bayessim_jax.recordings.history import History
from bayessim_jax.report.beside import Beside, beside_animation, deviation
from bayessim_jax.report.online import render
from bayessim_jax.rollout import rollout
from bayessim_jax.systems import lookup
from tests.browser import CHROMIUM, open_in_chromium
from tests.report.made_up import made_up

STEPS = 12


@functools.cache
def history(name, friction, idle_rounds=1):
    """Random actions on a target of this friction, in the second of three rounds; the others recorded nothing."""
    system = lookup(name).system(noise=0.0)
    play = lambda key: rollout(key, system, jnp.array([friction]), RandomPolicy(system.actions), STEPS)  # noqa: E731
    seen = jax.jit(play)(jax.random.key(1))

    def among_rounds(leaf):
        leaf = np.asarray(leaf)[None, None, None]
        return np.concatenate([np.zeros_like(leaf)] * idle_rounds + [leaf, np.zeros_like(leaf)])

    rest = {k: among_rounds(getattr(seen, k)) for k in ("times", "observations", "actions", "rewards", "valid")}
    return system, History(draws=np.full((idle_rounds + 2, 1, 5, 1), friction), **rest)


@pytest.mark.parametrize("name", ["fetch_push", "fetch_slide", pytest.param("hopper", marks=pytest.mark.slow)])
def test_at_the_true_parameters_both_are_the_same(name):
    system, seen = history(name, 0.4)
    beside = replay(name, system, seen, seen.draws[:, 0])
    assert beside.round == 2
    assert beside.target.shape == beside.simulated.shape == (STEPS + 1, system.observations.size)
    np.testing.assert_allclose(beside.simulated, beside.target, atol=2e-3 if name == "hopper" else 1e-5)
    assert deviation(beside)[1] < 1e-4


def test_another_friction_stops_a_pushed_object_elsewhere():
    system, seen = history("fetch_push", 0.4)
    beside = replay("fetch_push", system, seen, seen.draws[:, 0])
    moved = replace(beside, simulated=beside.simulated + np.where(np.array(beside.channels) == "object_y", 0.03, 0.0))
    assert deviation(moved) == ("objects", pytest.approx(0.03, abs=1e-4))
    assert "the two objects are 3 cm apart" in beside_animation(moved)


def test_where_nothing_was_recorded_nothing_is_shown():
    system, seen = history("fetch_push", 0.4)
    assert replay("fetch_push", system, replace(seen, valid=np.zeros_like(seen.valid)), seen.draws[:, 0]) is None


def standing():
    """A hopper that glides upright at 1 m/s, on either side."""
    system = lookup("hopper").system()
    seen = np.tile(np.eye(11)[0] * 1.25 + np.eye(11)[5], (STEPS + 1, 1))
    names, time = tuple(system.observations.names), system.dt * np.arange(STEPS + 1)
    return Beside("hopper", time, seen, seen, names, np.array([0.3]), system.model, 1)


def pushing():
    system, seen = history("fetch_push", 0.4)
    return replay("fetch_push", system, seen, seen.draws[:, 0])


@pytest.mark.parametrize("make", [pushing, standing])
def test_both_are_drawn_alike_and_beside_each_other(make):
    figure = beside_animation(make())
    data = json.loads(re.search(r"<script[^>]*>(.*)</script>", figure).group(1))
    (left, middle, _), (right, other, _) = data["labels"]
    assert (left, right) == ("target", "simulator")
    for body in data["bodies"]:
        frames = np.array(body["frames"])
        assert len(frames) in (1, STEPS + 1)
        here, there = np.split(frames, 2, axis=1)
        np.testing.assert_allclose(there - here, np.broadcast_to([other - middle, 0.0] * 2, here.shape), atol=2e-3)


@pytest.mark.skipif(CHROMIUM is None, reason="Chromium is not installed")
def test_the_page_with_both_runs_in_chromium(tmp_path):
    page = render(replace(made_up(rounds=2, d=1), beside=pushing()))
    dom, errors = open_in_chromium(page, tmp_path)
    assert errors == []
    assert f'max="{STEPS}"' in dom
    assert "Target and simulator" in dom
