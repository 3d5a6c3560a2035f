"""Where a misfit sits: regions of the state, stretches of time, shares of joints."""

import numpy as np
import pytest

from bayessim_jax.diagnosis.locate import find_regime, find_windows_of, shares_from_left
from bayessim_jax.effects import Scales


def motion(n=4000, seed=0):
    rng = np.random.default_rng(seed)
    return rng.uniform(-1, 1, n), rng.uniform(-3, 3, n), np.zeros(n), rng.uniform(0, 8, n)


def regime(force, position, velocity, drive, time):
    return find_regime(force, position, velocity, drive, time, Scales(speed=3.0, position=1.0))


def test_a_force_at_low_speed_is_found_there():
    q, v, u, t = motion()
    found = regime(np.exp(-((v / 0.3) ** 2)), q, v, u, t)
    assert found.startswith("|velocity| < ") and found.endswith("rad/s")
    assert 0.2 < float(found.split()[2]) < 1.2


def test_a_force_that_starts_at_some_time_is_found_in_time():
    q, v, u, t = motion()
    found = regime(np.where(t > 5.0, 1.0, 0.02), q, v, u, t)
    assert found.startswith("time > ") and abs(float(found.split()[2]) - 5.0) < 1.1


def test_a_force_in_one_direction_is_found_in_that_direction():
    q, v, u, t = motion()
    assert regime(np.where(v > 0, 1.0, 0.05), q, v, u, t) == "velocity > 0"


def test_a_force_of_one_size_is_everywhere():
    q, v, u, t = motion()
    assert regime(-np.sign(v), q, v, u, t) == "everywhere"
    assert regime(np.zeros_like(v), q, v, u, t) == "everywhere"


def test_windows_next_to_each_other_are_joined_the_strongest_first():
    excess = np.array([0.0, 5.0, 7.0, 0.1, 9.0, 0.0])
    names = ["a"] * 4 + ["b"] * 2
    start = np.array([0.0, 0.5, 1.0, 1.5, 0.0, 0.5])
    assert find_windows_of(excess, names, start, 0.5) == [("a", 0.5, 1.5), ("b", 0.0, 0.5)]
    assert find_windows_of(np.zeros(6), names, start, 0.5) == []


def test_shares_sum_to_one_and_favour_what_leaves_least():
    shares = shares_from_left([0.01, 0.6])
    assert shares.sum() == pytest.approx(1.0)
    assert shares[0] > 0.95
