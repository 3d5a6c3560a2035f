"""What is believed of a finding: no narrower than its law is known, and of all that tie."""

from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import least_squares

from bayessim_jax.beliefs.margins import Margins, uniform
from bayessim_jax.diagnosis.belief import covariance_of, moments_of_effects, moments_of_theta
from bayessim_jax.diagnosis.bench import Candidate, margin_of_effect
from bayessim_jax.effects import EFFECTS, Scales
from bayessim_jax.inference.shooting import Fit


class Bench:
    """One parameter of the system, uniform between 0 and 1, and one effect."""

    d = 1

    def __init__(self, effect="coulomb_friction"):
        self.parameters = EFFECTS[effect].parameters("joint/hinge", Scales(timestep=0.002, period=0.004))
        self.first = [0, len(self.parameters)]
        self.each = [margin_of_effect(p) for p in self.parameters]
        self.margins = Margins.create(["theta"], [uniform(0.0, 1.0)])

    def columns(self, candidate):
        return list(range(len(self.parameters))) if candidate.effects else []

    def values(self, candidate, z):
        pairs = zip(self.parameters, self.each, strict=True)
        return {p.name: float(m.value(z[1 + k])) for k, (p, m) in enumerate(pairs)}


def entry(z, precision):
    size = len(z)
    fit = Fit(
        z=jnp.asarray(z, float),
        delta=jnp.zeros((1, 2)),
        sigma=jnp.ones(1),
        precision=precision * jnp.eye(size),
        pulls=jnp.zeros((1, size)),
        r=jnp.zeros((1, 1, 1)),
        slopes=jnp.zeros((1, size + 2, 1)),
        cost=jnp.zeros(()),
        steps=jnp.zeros((), int),
        converged=jnp.ones((), bool),
    )
    return SimpleNamespace(candidate=Candidate((0,)), fit=fit)


@pytest.mark.parametrize("precision", [1e2, 1e12])
def test_a_number_is_no_better_known_than_the_form_of_its_law(precision):
    """The variance of recordings and that of the form add up: what is left of either alone is the other."""
    bench, found = Bench(), entry([0.1, -0.5], precision)
    means, sds = moments_of_effects(bench, found)
    own = 1.0 / np.sqrt(precision)
    step = 1e-3
    slope = (bench.each[0].value(-0.5 + step) - bench.each[0].value(-0.5 - step)) / (2 * step)
    expected = np.hypot(own * slope, bench.parameters[0].form * means["coulomb"])
    assert sds["coulomb"] == pytest.approx(expected, rel=1e-3)
    assert covariance_of(bench, found)[0, 0] == pytest.approx(1.0 / precision)  # the system's own have no form


def test_a_pushs_beginning_and_end_are_as_well_known_as_it_is_short():
    """Not by when it came."""
    bench = Bench("disturbance_event")
    start, end = bench.parameters[:2]
    times = [bench.each[0].standard(0.7), bench.each[1].standard(0.9)]
    means, sds = moments_of_effects(bench, entry([0.1, *times, 0.0], 1e12))
    assert means["end"] - means["start"] == pytest.approx(0.2)
    assert sds["start"] == pytest.approx(0.2 * start.form, rel=1e-3)
    assert sds["end"] == pytest.approx(0.2 * end.form, rel=1e-3)


def test_the_systems_parameters_follow_an_effect_whose_law_may_have_another_form():
    """Where recordings fix x − z and little else of an effect's x and θ's z, errors of both are one."""
    bench, found = Bench(), entry([0.1, -0.5], 1.0)
    found.fit = found.fit.replace(precision=jnp.array([[1e8, -1e8], [-1e8, 1.01e8]]))
    plain = np.linalg.inv(np.asarray(found.fit.precision))
    wide = covariance_of(bench, found)
    assert wide[1, 1] > 4.0 * plain[1, 1]
    np.testing.assert_allclose(wide - plain, wide[1, 1] - plain[1, 1], rtol=1e-5)


def test_parameters_of_candidates_that_tie_cannot_all_be_right():
    bench = Bench()
    first, second = entry([0.0, 0.0], 1e10), entry([1.0, 0.0], 1e10)
    mean, sd = moments_of_theta(bench, [first, second], [0.6, 0.2])
    other, _ = moments_of_theta(bench, [second], [1.0])
    assert mean == pytest.approx(0.5)
    assert sd == pytest.approx(np.sqrt(0.25) * (other - mean), rel=1e-3)


def misfit_of(law, of, start):
    """Numbers of one law that come nearest to another law of the same kind, over their own."""
    found = least_squares(lambda x: law(x) - of, start, x_scale=np.abs(start))
    return found.x / np.asarray(start) - 1.0


def test_a_stribeck_curve_is_known_as_well_as_its_two_usual_forms_agree():
    """exp(−(v/v_s)²) or 1/(1 + (v/v_s)²): what one makes of the other is within twice what is said, not far below."""
    velocity = np.linspace(0.0, 1.0, 400)
    truth = np.array([1.0, 1.8, 0.12])  # coulomb, static, velocity

    def gaussian(x):
        return x[0] + (x[1] - x[0]) * np.exp(-((velocity / x[2]) ** 2))

    lorentzian = truth[0] + (truth[1] - truth[0]) / (1.0 + (velocity / truth[2]) ** 2)
    moved = np.abs(misfit_of(gaussian, lorentzian, truth))
    said = np.array([p.form for p in Bench("stribeck_friction").parameters])
    assert (moved < 2.0 * said).all()
    assert (moved > 0.2 * said).all()


def test_a_drift_is_known_as_well_as_a_straight_line_and_one_that_settles_agree():
    time = np.linspace(0.0, 1.0, 400)
    settling = 5.0 * -np.expm1(-time / 5.0)
    moved = abs(misfit_of(lambda x: x[0] * time, settling, [1.0])[0])
    said = Bench("gain_drift").parameters[0].form
    assert 0.2 * said < moved < 2.0 * said


def test_the_damping_of_a_stop_is_known_as_well_as_two_ways_to_damp_agree():
    """d ẋ from the first touch, or growing with the depth (Hunt and Crossley): one bounce, as in half a period."""
    phase = np.linspace(0.0, np.pi, 400)
    depth, speed = np.sin(phase), np.cos(phase)
    truth = np.array([1.0, 0.1])
    growing = np.maximum(truth[0] * depth + truth[1] * depth * speed, 0.0)
    moved = np.abs(misfit_of(lambda x: np.maximum(x[0] * depth + x[1] * speed, 0.0), growing, truth))
    said = [p.form for p in Bench("soft_stop").parameters][1:]
    assert moved[1] < 2.0 * said[1]
    assert moved[1] > 0.2 * said[1]
