"""Races of points that a candidate is begun from, on a curve with many minima."""

from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest

from bayessim_jax.diagnosis.bench import Candidate
from bayessim_jax.diagnosis.screen import March, Screen, Screened
from bayessim_jax.inference.arrow import Curvature

DEEPEST = 1.3
"""The lowest of the minima, one of them every 1.2 or so."""
ROWS = 30


class Waves:
    """A scene of one window in which a number x is fitted: r = [2 sin(5 (x − x*)), x − x*]; NaN beyond 2.5."""

    d, slots = 0, 1
    pairs = (SimpleNamespace(name="waves"),)
    parameters = ((SimpleNamespace(scan=0, unit="", low=-3.0),),)
    margins = SimpleNamespace(size=0, bounded=np.zeros(0, bool))
    margin = None

    def __init__(self):
        measured = np.ones((1, ROWS, 1), bool)
        y = np.zeros((1, ROWS, 1))
        self.shots = SimpleNamespace(measured=measured, y=jnp.asarray(y), spread=jnp.ones(1))
        self.points = []

    def name(self, candidate):
        return "waves"

    def takes(self, candidate):
        return True

    def offsets(self, candidate):
        return [(k, slice(0, 1)) for k in candidate.effects]

    def count(self, candidate):
        return len(candidate.effects)

    def assess(self, candidate, p, delta, sigma):
        x = float(p[0])
        self.points.append(x)
        r = np.zeros(ROWS)
        r[:2] = 2.0 * np.sin(5.0 * (x - DEEPEST)), x - DEEPEST
        slope = np.array([10.0 * np.cos(5.0 * (x - DEEPEST)), 1.0])
        cost = 0.5 * (r @ r) if x < 2.5 else np.nan
        one = np.ones((1, 1, 1))
        found = Curvature(
            cost=jnp.asarray(cost),
            hessian=jnp.asarray([[slope @ slope]]),
            gradient=jnp.asarray([-slope @ r[:2]]),
            own=jnp.asarray(one),
            cross=jnp.zeros((1, 1, 1)),
            own_gradient=jnp.zeros((1, 1)),
            pulls=jnp.zeros((1, 1)),
        )
        return found, jnp.asarray(r.reshape(1, ROWS, 1))


@pytest.fixture
def screen(monkeypatch):
    monkeypatch.setattr("bayessim_jax.diagnosis.screen.noise_floor", lambda shots: np.full(1, 1e-9))
    return Screen(Waves())


def race(screen, starts, races=((3, True, 4), (4, True, 2))):
    known = Screened(Candidate(), jnp.zeros(1), jnp.zeros((1, 1)), jnp.ones(1), np.inf, 0.0)
    ends = [(np.array([x]), jnp.zeros((1, 1))) for x in starts]
    return screen._race(Candidate((0,)), known, ends, races)


def test_a_race_from_many_points_finds_the_deepest_minimum_with_half_of_the_steps(screen):
    starts = np.linspace(-3.0, 2.4, 40)
    begun = race(screen, starts)
    assert begun.ends[0][0][0] == pytest.approx(DEEPEST, abs=1e-3)
    # 40 points once, 20 and 10 of them once more, then at most 4 of these
    assert len(screen.scene.points) <= 40 + 20 + 10 + 4 * 4


def test_few_points_are_all_taken_to_the_end_of_a_race(screen):
    race(screen, np.linspace(-3.0, 2.4, 8), ((3, True, 4),))
    assert len(screen.scene.points) == 8 * 3


def test_points_that_diverge_are_left_behind(screen):
    begun = race(screen, [2.6, 2.7, 2.8, 1.2])
    assert begun.ends[0][0][0] == pytest.approx(DEEPEST, abs=1e-3)
    assert race(screen, [2.6, 2.7, 2.8]) is None
    assert screen.fit(Candidate((0,)), np.array([2.7]), jnp.zeros((1, 1)), jnp.ones(1))[2] is None


def test_points_that_came_together_go_on_as_one(screen):
    begun = race(screen, [1.25, 1.28, 1.31, 1.35, 0.05], ((9, True, 4),))
    found = sorted(float(p[0]) for p, _ in begun.ends)
    assert len(found) == 2
    assert found == pytest.approx([DEEPEST - 2 * np.pi / 5, DEEPEST], abs=0.05)


def test_a_glance_costs_a_point_one_evaluation_and_goes_on_from_there(screen):
    screen.scene.begin_around = lambda candidate, p: None
    known = Screened(Candidate(), jnp.zeros(1), jnp.zeros((1, 1)), jnp.ones(1), np.inf, 0.0)

    def marches():
        return [March((np.array([x]), jnp.zeros((1, 1)))) for x in (-2.0, 0.5, 1.2, 2.6)]

    first = screen.glance(Candidate((0,)), known, marches(), 1)
    assert len(screen.scene.points) == 4
    assert [march.promised for march in first] == sorted(march.promised for march in first)
    assert len(first) == 3  # one began where nothing can be said
    gone_on = screen.glance(Candidate((0,)), known, first, 7)
    in_one_go = screen.glance(Candidate((0,)), known, marches(), 7)
    for one, other in zip(gone_on, in_one_go, strict=True):
        assert one.cost == other.cost
    assert gone_on[0].here[0][0] == pytest.approx(DEEPEST, abs=1e-3)
