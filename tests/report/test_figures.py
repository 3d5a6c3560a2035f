import re
import xml.etree.ElementTree as ET
from types import SimpleNamespace

import numpy as np
import pytest

from bayessim_jax.effects import EFFECTS, Scales
from bayessim_jax.report.curves import estimates_plot, log_density_plot, return_plot
from bayessim_jax.report.density import credible_levels, density1d, density2d
from bayessim_jax.report.laws import DRAWS, _curves, state_plot
from bayessim_jax.report.pairs import pair_plot
from bayessim_jax.report.trust import coverage_plot, rank_plot, truth_coverage_plot

RNG = np.random.default_rng(0)
NAN = np.full((1, 4), np.nan)


def words(svg):
    return [e.text.strip() for e in ET.fromstring(svg).iter() if e.tag.endswith("}text") and e.text]


def test_a_law_is_shown_as_it_is_and_where_its_numbers_put_it():
    scales = Scales(force=2.0, speed=3.0, inertia=0.1)
    bench = SimpleNamespace(pairs=[(EFFECTS["coulomb_friction"], "joint/a")], scales={"joint/a": scales})
    x, levels = np.array([-3.0, -0.1, 0.1, 3.0]), np.linspace(0.2, 0.4, DRAWS + 1)[:, None]
    curves = _curves(SimpleNamespace(bench=bench), 0, {"coulomb": levels}, x)
    np.testing.assert_allclose(curves, -levels * np.sign(x))


def test_a_map_of_forces_over_states_names_joints_and_units():
    forces = {"joint/a": tuple(RNG.normal(size=(5, 400)))}
    shown = words(state_plot(forces, {"joint/a": ("rad", "N m")}))
    assert {"joint/a", "position [rad]", "velocity [rad/s]", "force [N m]"} <= set(shown)


def test_a_density_holds_all_mass_at_a_bound_and_peaks_where_the_law_does():
    x = np.abs(RNG.normal(size=20_000)) * 0.1  # half-normal: densest at its lower bound
    grid, density = density1d(x, 0.0, 1.0)
    assert np.sum(density) * (grid[1] - grid[0]) == pytest.approx(1.0)
    assert density[0] == pytest.approx(2 / (0.1 * np.sqrt(2 * np.pi)), rel=0.08)
    assert grid.min() > 0


def test_credible_sets_of_a_gaussian_hold_their_mass():
    xy = RNG.normal(size=(40_000, 2)) * [0.02, 0.1] + 0.5
    x, y, density = density2d(xy, np.zeros(2), np.ones(2))
    area = (x[1] - x[0]) * (y[1] - y[0])
    low90, low50 = credible_levels(density, (0.9, 0.5))
    # a highest-density set of mass α of a Gaussian is an ellipse of area −2π σ₁ σ₂ log(1 − α)
    for level, mass in ((low90, 0.9), (low50, 0.5)):
        exact = -2 * np.pi * 0.02 * 0.1 * np.log(1 - mass)
        assert (density >= level).sum() * area == pytest.approx(exact, rel=0.12)
    assert density.shape == (y.size, x.size)
    assert np.unravel_index(density.argmax(), density.shape)[0] == pytest.approx(np.abs(y - 0.5).argmin(), abs=8)


@pytest.mark.parametrize("d", [1, 2, 6])
@pytest.mark.parametrize("magnify", [False, True])
def test_pair_plots_name_every_axis_with_its_unit(d, magnify):
    names, units = [f"p{i}" for i in range(d)], ["m"] * (d - 1) + [""]
    draws = 0.5 + 0.01 * RNG.normal(size=(300, d))
    svg = pair_plot(draws, names, units, np.zeros(d), np.ones(d), np.full(d, 0.52), "x", magnify=magnify)
    seen = words(svg)
    for i, (name, unit) in enumerate(zip(names, units, strict=True)):
        label = f"{name} [{unit}]" if unit else name
        # once under its column, and once beside its row unless it is the first
        assert seen.count(label) == (1 if i == 0 else 2)
    assert "#e2711d" in svg


def test_without_a_truth_nothing_is_orange():
    draws = 0.5 + 0.01 * RNG.normal(size=(300, 2))
    svg = pair_plot(draws, ["a", "b"], ["m", "m"], np.zeros(2), np.ones(2), None, "x")
    assert "#e2711d" not in svg


def test_tick_labels_keep_their_digits():
    draws = 0.6375 + 0.004 * RNG.normal(size=(500, 1))
    svg = pair_plot(draws, ["a"], ["m"], np.zeros(1), np.ones(1), None, "x", magnify=True)
    ticks = [float(w) for w in words(svg) if re.fullmatch(r"0\.\d+", w)]
    assert np.ptp(np.diff(sorted(ticks))) < 1e-6  # evenly spaced, so none was cut short


def test_degenerate_draws_still_draw():
    same = np.tile([0.5, 0.5], (50, 1))
    assert "<svg" in pair_plot(same, ["a", "b"], ["", ""], np.zeros(2), np.ones(2), np.array([0.5, 0.5]), "x")


def test_curves_survive_missing_numbers():
    one = np.array([[1.0, np.nan, 3.0, -np.inf]])
    many = np.array([[1.0, np.nan, 3.0, 2.0], [2.0, np.nan, np.nan, 1.0]])
    for values in (one, many):
        assert "prior" in words(log_density_plot(values, 0.2))
        assert "round" in words(return_plot(values, values))
    flags = np.zeros((1, 4), bool)
    assert "<svg" in coverage_plot(NAN, NAN, NAN, flags, flags)


@pytest.mark.parametrize("seeds", [1, 3])
@pytest.mark.parametrize("known", [True, False])
def test_estimates_name_parameters_and_the_truth(seeds, known):
    mean = RNG.uniform(size=(seeds, 4, 3))
    truth = np.full((seeds, 3), 0.5) if known else None
    over_rounds = None if truth is None else np.repeat(truth[:, None], mean.shape[1], 1)
    svg = estimates_plot(mean, mean / 10, ["a", "b", "c"], ["m", "", "kg"], np.zeros(3), np.ones(3), over_rounds)
    seen = " ".join(words(svg))
    assert "a [m]" in seen
    assert "c [kg]" in seen
    assert ("truth" in seen) == known


def test_flags_are_marked_in_words():
    flags = np.array([[False, True, False]])
    values = np.array([[0.9, 0.5, 0.9]])
    seen = words(coverage_plot(values, values, values, flags, flags))
    assert "over-confident" in seen
    assert "over-fitted" in seen
    none = words(coverage_plot(values, values, values, ~flags & flags, ~flags & flags))
    assert "over-confident" not in none


def test_calibration_over_seeds_counts_seeds():
    levels = RNG.uniform(size=(20, 5))
    assert "share of 20 seeds that hold the truth" in words(truth_coverage_plot(levels))
    assert "rank of the true b" in words(rank_plot(RNG.uniform(size=(20, 2)), ["a", "b"]))
