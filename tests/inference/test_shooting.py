"""Multiple shooting on simulators whose posterior has a closed form."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayessim_jax.beliefs.margins import Margins, normal
from bayessim_jax.inference import shooting
from bayessim_jax.inference.arrow import eliminate, normal_equations, stride
from bayessim_jax.inference.direct import fit_direct, noise_floor, sample_direct
from bayessim_jax.inference.shooting import Shots, expand, profile, ridge, robust_covariance, solve

WINDOWS, ROWS = 6, 12
FIELDS = ("inputs", "y", "measured")
SIGMA = 0.3


@pytest.fixture(autouse=True)
def in_double_precision():
    jax.config.update("jax_enable_x64", True)
    yield
    jax.config.update("jax_enable_x64", False)


def line(z, delta, window):
    """y_t = (x0 + δ) + z₀ t + z₁ t²: linear in everything."""
    t = jnp.linspace(0.0, 1.0, ROWS)
    return (window + delta[0] + z[0] * t + z[1] * t**2)[:, None]


def line_data(seed=0, sigma=SIGMA):
    rng = np.random.default_rng(seed)
    starts, z = rng.normal(size=WINDOWS), rng.normal(size=2)
    t = np.linspace(0.0, 1.0, ROWS)
    y = starts[:, None] + 0.2 * rng.normal(size=(WINDOWS, 1)) + z[0] * t + z[1] * t**2
    y = y[..., None] + sigma * rng.normal(size=(WINDOWS, ROWS, 1))
    measured = rng.uniform(size=y.shape) > 0.2
    return Shots(jnp.asarray(starts), jnp.asarray(y), jnp.asarray(measured), jnp.array([0.5])), z


def exact(shots, sigma):
    """Mean and covariance of z by writing the whole Gaussian down."""
    t = np.linspace(0.0, 1.0, ROWS)
    size = 2 + WINDOWS
    precision, right = np.eye(size), np.zeros(size)
    for k in range(WINDOWS):
        precision[2 + k, 2 + k] = 1 / 0.5**2
    for w in range(WINDOWS):
        for r in range(ROWS):
            if shots.measured[w, r, 0]:
                row = np.zeros(size)
                row[:2], row[2 + w] = [t[r], t[r] ** 2], 1.0
                precision += np.outer(row, row) / sigma**2
                right += row * float(shots.y[w, r, 0] - shots.inputs[w]) / sigma**2
    covariance = np.linalg.inv(precision)
    return (covariance @ right)[:2], covariance[:2, :2]


def solved(predict, shots, **options):
    sigma = jnp.array([SIGMA])
    return solve(predict, shots, jnp.zeros(2), jnp.zeros((WINDOWS, 1)), sigma, jnp.ones(2, bool), **options)


@pytest.mark.parametrize("step", [0.0, 1e-3])
def test_a_linear_simulator_has_the_posterior_that_algebra_gives(step):
    shots, _ = line_data()
    fit = solved(line, shots, step=step)
    mean, covariance = exact(shots, SIGMA)
    assert bool(fit.converged)
    np.testing.assert_allclose(fit.z, mean, atol=1e-6)
    np.testing.assert_allclose(jnp.linalg.inv(fit.precision), covariance, rtol=1e-5)


def test_the_profile_of_a_linear_simulator_is_its_log_posterior():
    shots, _ = line_data(1)
    around = ridge(solved(line, shots))
    mean, covariance = exact(shots, SIGMA)
    points = np.random.default_rng(0).normal(size=(5, 2)) + mean
    logs = np.array([profile(line, shots, around, jnp.asarray(p)) for p in points])
    wanted = np.array([-0.5 * (p - mean) @ np.linalg.solve(covariance, p - mean) for p in points])
    np.testing.assert_allclose(logs - logs[0], wanted - wanted[0], rtol=1e-6)


def test_draws_have_the_posteriors_moments_and_the_noise_is_found():
    shots, _ = line_data(2)
    margins = Margins.create(["a", "b"], [normal(0, 1), normal(0, 1)])
    fit = fit_direct(jax.random.key(0), line, shots, 2)
    assert float(fit.sigma[0]) == pytest.approx(SIGMA, rel=0.25)
    posterior = sample_direct(jax.random.key(1), line, shots, margins, fit)
    mean, covariance = exact(shots, float(fit.sigma[0]))
    assert posterior.efficiency is not None and posterior.efficiency > 0.7
    np.testing.assert_allclose(posterior.draws.mean(0), mean, atol=0.15 * np.sqrt(np.diag(covariance)).max())
    np.testing.assert_allclose(np.cov(posterior.draws, rowvar=False), covariance, rtol=0.35)


def banana(z, delta, window):
    """y = z₁ + 4 z₀²: a curved ridge that no Gaussian describes."""
    return jnp.full((ROWS, 1), z[1] + 4.0 * z[0] ** 2) + 0.0 * delta[0] + 0.0 * window


def test_a_bent_ridge_is_walked():
    shots = Shots(
        jnp.zeros(WINDOWS), jnp.full((WINDOWS, ROWS, 1), 1.0), jnp.ones((WINDOWS, ROWS, 1), bool), jnp.ones(1)
    )
    margins = Margins.create(["a", "b"], [normal(0, 1), normal(0, 1)])
    posterior = sample_direct(jax.random.key(0), banana, shots, margins, solved(banana, shots))
    assert "profile" in posterior.sampler
    level = posterior.z[:, 1] + 4 * posterior.z[:, 0] ** 2
    assert float(jnp.abs(level - 1).mean()) < 0.1
    grid = np.linspace(-3, 3, 4001)
    weight = np.exp(-0.5 * (grid**2 + (1 - 4 * grid**2) ** 2))
    assert float(posterior.z[:, 0].std()) == pytest.approx(np.sqrt((weight * grid**2).sum() / weight.sum()), rel=0.15)


def fragile(z, delta, window):
    """Not finite beyond z₀ = 0.5, as a simulation that diverges."""
    y = line(z, delta, window)
    return jnp.where(z[0] > 0.5, jnp.nan, y)


def test_a_step_into_a_divergence_is_refused():
    shots, _ = line_data(3)
    shots = shots.replace(y=shots.y + 3.0 * jnp.linspace(0, 1, ROWS)[:, None])
    fit = solved(fragile, shots)
    assert bool(jnp.isfinite(fit.cost))
    assert float(fit.z[0]) <= 0.5


def curved(z, delta, window):
    """The same parabola with coefficients in intervals, Φ(z) of their widths from the lower ends."""
    return line(8.0 * jax.scipy.special.ndtr(z) - 4.0, delta, window)


@pytest.mark.parametrize("edge", [-3.0, 3.0])
def test_a_step_back_from_the_edge_of_an_interval_is_no_obstacle(edge):
    """The interval ends abruptly and z does not: a step that z's slope makes 50 long holds the other coefficient up."""
    shots, _ = line_data(6, sigma=0.01)
    start, still, sigma, free = jnp.array([edge, 0.0]), jnp.zeros((WINDOWS, 1)), jnp.array([0.01]), jnp.ones(2, bool)
    ends = {steps: solve(curved, shots, start, still, sigma, free, steps=steps) for steps in (3, 60)}
    known = {
        steps: solve(curved, shots.replace(bounded=free), start, still, sigma, free, steps=steps) for steps in ends
    }
    assert known[60].converged
    np.testing.assert_allclose(known[60].z, ends[60].z, atol=1e-3)
    assert float(known[3].cost) < 0.01 * float(ends[3].cost)
    # within the interval, and where there is none, steps are as they were
    move = jnp.array([0.4, -30.0])
    for where, bounded in ((jnp.zeros(2), True), (start, False)):
        to, taken = stride(where, move, jnp.array([bounded, False]), 2.0)
        np.testing.assert_allclose(to - where, taken)
        np.testing.assert_allclose(jnp.abs(taken).max(), 2.0)


def counted(monkeypatch):
    """Whether each point that the solver simulates from here on is simulated alone."""
    alone, look = [], shooting._look

    def noted(*given):
        alone.append(bool(given[-1]))
        return look(*given)

    monkeypatch.setattr(shooting, "_look", noted)
    return alone


@pytest.mark.parametrize(("windows", "step"), [(WINDOWS, 0.0), (shooting.MANY, 0.0), (WINDOWS, 1e-3)])
def test_a_point_alone_has_the_residuals_that_it_has_among_others(windows, step):
    few, _ = line_data(7)
    many = {name: jnp.resize(x, (windows, *x.shape[1:])) for name in FIELDS for x in [getattr(few, name)]}
    shots = few.replace(**many)
    given = line, shots, jnp.array([0.3, -0.1]), jnp.full((windows, 1), 0.1), jnp.array([SIGMA])
    whole, alone = (shooting._look(*given, step, None, np.asarray(flag)) for flag in (False, True))
    np.testing.assert_allclose(alone[0], whole[0], rtol=1e-12)
    # derivatives cost nothing where they are not asked for
    assert (np.abs(alone[1] - whole[1]).max() > 1.0) == (windows >= shooting.MANY or step > 0.0)
    slopes = [jax.jacfwd(lambda z: line(z, jnp.zeros(1), 0.0))(given[2])[:, 0, i] / SIGMA for i in range(2)]
    there = np.asarray(shots.measured)[..., 0]
    for i in range(2):
        np.testing.assert_allclose(whole[1][:, i], np.where(there, slopes[i], 0.0), atol=1e-6)


def test_derivatives_are_computed_where_a_step_was_accepted_only(monkeypatch):
    """On a winding way steps are too long and refused; a linear simulator's never are."""

    def winding(z, delta, window):
        return line(z + 0.18 * jnp.sin(5.0 * z), delta, window)

    shots, _ = line_data(6, sigma=0.01)
    given = jnp.zeros((WINDOWS, 1)), jnp.array([0.01]), jnp.ones(2, bool)
    alone = counted(monkeypatch)
    solve(line, shots, jnp.array([0.3, -0.2]), *given)
    assert alone == [False, *[True, False] * (len(alone) // 2)]
    alone.clear()
    fit = solve(winding, shots, jnp.array([3.0, -2.0]), *given, damping=1e-9)
    refused = alone.count(True) - (alone.count(False) - 1)
    assert refused > 0 and fit.converged and fit.steps == alone.count(True) + 1


def test_a_fit_that_is_known_is_not_simulated_again(monkeypatch):
    shots, _ = line_data(8)
    first = solved(line, shots)
    alone = counted(monkeypatch)
    same = solve(line, shots, first.z, first.delta, first.sigma, np.ones(2, bool), known=first)
    assert not alone and same.converged
    np.testing.assert_allclose(same.z, first.z, atol=1e-9)
    # at another noise the prior weighs more: one linear step, which is not simulated where it is short
    other = solve(line, shots, first.z, first.delta, 2.0 * first.sigma, np.ones(2, bool), known=first)
    assert alone.count(False) == alone.count(True) > 0
    np.testing.assert_allclose(other.z, exact(shots, 2.0 * SIGMA)[0], atol=1e-6)


def test_a_point_beside_which_simulations_fail_is_refused():
    """Where the first step leads the simulation ends well, and a little further on it does not."""
    shots, _ = line_data(9)
    given = jnp.zeros(2), jnp.zeros((WINDOWS, 1)), jnp.array([SIGMA]), np.ones(2, bool)
    led = float(solve(line, shots, *given, steps=2, damping=1.0).z[0])

    def broken(z, delta, window):
        return jnp.where(z[0] > led + 1e-7, jnp.nan, line(z, delta, window))

    assert led > 0.0
    fit = solve(broken, shots, *given, damping=1.0)
    assert np.isfinite(fit.cost) and np.isfinite(fit.precision).all() and 0.0 < fit.z[0] < led
    nowhere = solve(broken, shots, jnp.array([led + 1.0, 0.0]), *given[1:])
    assert not np.isfinite(nowhere.cost) and not nowhere.converged


def test_parameters_that_are_not_free_stay():
    shots, _ = line_data(4)
    start = jnp.array([0.3, -0.2])
    free = jnp.array([True, False])
    fit = solve(line, shots, start, jnp.zeros((WINDOWS, 1)), jnp.array([SIGMA]), free)
    assert float(fit.z[1]) == -0.2
    assert float(fit.z[0]) != 0.3


def test_elimination_leaves_the_same_answer_as_the_whole_system():
    shots, _ = line_data(5)
    z, delta = jnp.array([0.1, 0.2]), jnp.zeros((WINDOWS, 1))
    r, slopes = map(np.asarray, expand(line, shots, z, delta, jnp.array([SIGMA])))
    c = normal_equations(r, slopes, np.asarray(z), np.asarray(delta))
    precision, gradient, _, _ = eliminate(c)
    whole = np.zeros((2 + WINDOWS, 2 + WINDOWS))
    whole[:2, :2] = c.hessian
    for w in range(WINDOWS):
        whole[2 + w, 2 + w] = c.own[w, 0, 0]
        whole[2 + w, :2] = whole[:2, 2 + w] = c.cross[w, 0]
    right = np.concatenate([c.gradient, c.own_gradient[:, 0]])
    np.testing.assert_allclose(np.linalg.solve(precision, gradient), np.linalg.solve(whole, right)[:2], rtol=1e-8)
    np.testing.assert_allclose(np.linalg.inv(precision), np.linalg.inv(whole)[:2, :2], rtol=1e-8)


def test_the_floor_of_the_noise_is_what_the_sensor_resolves():
    values = np.round(np.random.default_rng(0).normal(size=(4, ROWS, 1)), 1)
    shots = Shots(jnp.zeros(4), jnp.asarray(values), jnp.ones(values.shape, bool), jnp.ones(1))
    assert 1e-4 <= float(noise_floor(shots)[0]) <= 0.1 / np.sqrt(12) + 1e-9


@pytest.mark.parametrize("wrong", [0.0, 2.0])
def test_windows_that_disagree_widen_the_covariance(wrong):
    """Every window has a slope of its own, which the model knows nothing of; without, Laplace's covariance is right."""
    rng, windows, off, laplace, robust = np.random.default_rng(0), 60, [], [], []
    t = np.linspace(0.0, 1.0, ROWS)
    for _ in range(60):
        y = 0.7 * t + 0.4 * t**2 + wrong * rng.normal(size=(windows, 1)) * t + SIGMA * rng.normal(size=(windows, ROWS))
        shots = Shots(
            jnp.zeros(windows), jnp.asarray(y[..., None]), jnp.ones((windows, ROWS, 1), bool), jnp.array([0.5])
        )
        zero = (jnp.zeros(2), jnp.zeros((windows, 1)), jnp.array([SIGMA]), jnp.ones(2, bool))
        fit = solve(line, shots, *zero)
        off.append(np.asarray(fit.z) - [0.7, 0.4])
        laplace.append(np.linalg.inv(fit.precision))
        robust.append(np.asarray(robust_covariance(fit)))
    spread = np.cov(np.array(off).T)
    sds = [np.sqrt(np.diag(np.mean(c, 0)) / np.diag(spread)) for c in (laplace, robust)]
    np.testing.assert_allclose(sds[1], 1.0, atol=0.3)
    assert (sds[0][0] < 0.6) == (wrong > 0)
