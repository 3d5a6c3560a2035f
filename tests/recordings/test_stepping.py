"""`settle_step`: recordings of machines, which take no steps, and of simulators with other steps than the model's."""

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from bayessim_jax.effects import EFFECTS
from bayessim_jax.inference.direct import fit_direct
from bayessim_jax.recordings.diagnosing import diagnose_case
from bayessim_jax.recordings.evaluation import BEFORE
from bayessim_jax.recordings.loading import load_case
from bayessim_jax.recordings.shots import StepError, case_model, lagrange, predictor, split_windows
from bayessim_jax.recordings.stepping import RATIO, ratio_of_motion, settle_step
from benchmarks.worlds import STEP, make_case


@pytest.fixture(autouse=True)
def in_double_precision():
    jax.config.update("jax_enable_x64", True)
    yield
    jax.config.update("jax_enable_x64", False)


@pytest.fixture
def coasting(tmp_path):
    make_case(tmp_path / "case", "slide", recordings=2, seconds=2.0, noise=0.0)
    return case_model(load_case(tmp_path / "case").check())


def constant(windows, command):
    return dataclasses.replace(windows, ctrl=np.full_like(windows.ctrl, command))


def test_the_error_of_a_constant_push_is_the_one_in_closed_form(coasting):
    """Semi-implicit Euler under an acceleration a: q(t) = v t + a t² / 2 + a h t / 2, and the speed is exact."""
    finer = case_model(coasting.case, refined=4)
    z, command = jnp.array([0.3]), 2.0
    windows = constant(split_windows(coasting)[0], command)
    drift = StepError((coasting, finer), z).offset(coasting.shots(windows), 1)
    mass = float(coasting.margins.theta(z)[0])
    gear = float(coasting.compiled.actuator_gear[0, 0])
    damping = float(coasting.compiled.dof_damping[0])
    assert damping == 0.0
    time = windows.time if windows.time.ndim == 1 else windows.time[0]
    expected = -0.5 * command * gear / mass * float(STEP) * time
    np.testing.assert_allclose(drift[..., 0], np.broadcast_to(expected, drift.shape[:2]), rtol=2e-2, atol=1e-9)
    np.testing.assert_allclose(drift[..., 1], 0.0, atol=1e-9)


def test_recordings_are_freed_of_the_error_of_the_step_that_is_taken(coasting):
    finer = case_model(coasting.case, refined=4)
    windows = split_windows(coasting)[0]
    finest = case_model(coasting.case, refined=16)
    error = StepError((coasting, finer, finest), jnp.array([0.3]), ratio=0.1)
    limit = dataclasses.replace(error, ratio=0.0).offset(coasting.shots(windows), 1)
    raw = np.asarray(coasting.shots(windows).y)
    for model, own in ((coasting, 1.0), (finer, 0.25)):
        freed = dataclasses.replace(model, step_error=error).shots(windows)
        np.testing.assert_allclose(raw - np.asarray(freed.y), (own - 0.1) * limit, atol=1e-9)
    assert np.abs(limit).max() > 1e-6


def test_interpolation_is_exact_at_its_nodes_and_for_polynomials():
    nodes = (1.0, 0.25, 0.0625)
    np.testing.assert_allclose(np.stack([lagrange(nodes, s) for s in nodes]), np.eye(3), atol=1e-12)
    values = np.array([2 - 3 * s + 5 * s**2 for s in nodes])
    np.testing.assert_allclose(lagrange(nodes, 0.0) @ values, 2.0, rtol=1e-9)


@pytest.mark.parametrize("finer", [0.5, pytest.param(16.0, marks=pytest.mark.slow)])
def test_the_step_of_what_was_recorded_is_found_and_does_not_bend_parameters(tmp_path, finer):
    sealed = make_case(
        tmp_path / "case", "double", finer=finer, noise=0.1, rate=125.0, recordings=4, seconds=3.0, seed=2
    )
    model = case_model(load_case(tmp_path / "case").check())
    windows = split_windows(model)[0]
    settled = settle_step(jax.random.key(0), model, windows)
    sd = np.sqrt(np.diag(np.linalg.inv(np.asarray(settled.fit.precision))))
    truth = np.asarray(model.margins.standard(jnp.array(list(sealed["parameters"].values()))))
    assert abs(float(RATIO.value(settled.fit.z[-1])) - 0.25 / finer) < 4 * RATIO.b * sd[-1]
    assert RATIO.b * sd[-1] < 0.02
    assert settled.model.step_error.ratio == pytest.approx(0.25 / finer, abs=0.02)
    assert (np.abs(np.asarray(settled.fit.z[:-1]) - truth) < 4 * sd[:-1]).all()
    plain = fit_direct(jax.random.key(0), predictor(model), model.shots(windows), 2)
    assert (np.abs(np.asarray(plain.z) - truth) > 8 * sd[:-1]).any()


@pytest.mark.parametrize(
    ("rig", "finer"), [("slide", 0.5), ("slide", 16.0), pytest.param("double", 0.5, marks=pytest.mark.slow)]
)
def test_steps_of_euler_show_in_positions_alone_where_those_of_runge_and_kutta_are_believed(tmp_path, rig, finer):
    settings = {"noise": 0.1, "rate": 125.0, "recordings": 4, "seconds": 3.0, "velocities": False, "seed": 2}
    sealed = make_case(tmp_path / "case", rig, finer=finer, **settings)
    path = tmp_path / "case" / "model.xml"
    spec = mujoco.MjSpec.from_file(str(path))
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_RK4
    path.write_text(spec.to_xml())
    model = case_model(load_case(tmp_path / "case").check())
    settled = settle_step(jax.random.key(0), model, split_windows(model)[0])
    assert settled.model.step_error.nodes == (0.0, 1.0, 0.25)
    assert settled.model.nearest == settled.model.refined
    assert settled.model.step_error.ratio == pytest.approx(0.25 / finer, abs=0.03)
    sd = np.sqrt(np.diag(np.linalg.inv(np.asarray(settled.fit.precision))))
    truth = np.asarray(model.margins.standard(jnp.array(list(sealed["parameters"].values()))))
    assert (np.abs(np.asarray(settled.fit.z[:-1]) - truth) < 4 * sd[:-1]).all()


@pytest.mark.parametrize("rig", ["slide", pytest.param("double", marks=pytest.mark.slow)])
@pytest.mark.parametrize("finer", [0.25, 1.0, pytest.param(16.0, marks=pytest.mark.slow)])
def test_positions_and_velocities_tell_the_step_whatever_moves_the_machine(tmp_path, rig, finer):
    settings = {"strength": 0.3, "recordings": 4, "seconds": 3.0, "rate": 125.0, "seed": 2}
    make_case(tmp_path / "case", rig, "viscous_friction", finer=finer, **settings)
    model = case_model(load_case(tmp_path / "case").check())
    s, sd = ratio_of_motion(model, split_windows(model)[0])
    assert sd < 0.2
    assert s == pytest.approx(0.25 / finer, abs=2.5 * sd)


def test_without_velocities_the_step_is_what_is_believed_of_any(tmp_path):
    make_case(tmp_path / "case", "slide", noise=1.0, recordings=2, seconds=2.0, velocities=False)
    model = case_model(load_case(tmp_path / "case").check())
    assert ratio_of_motion(model, split_windows(model)[0]) == pytest.approx((RATIO.a, RATIO.b))


@pytest.mark.slow
def test_missing_physics_are_not_taken_for_a_step(tmp_path):
    """Fitted, s would be six: a viscous friction that the simulator lacks."""
    sealed = {"strength": 0.072, "noise": 3.0, "finer": 4, "seed": 5300029}
    make_case(tmp_path / "case", "slide", "viscous_friction", **sealed)
    model = case_model(load_case(tmp_path / "case").check())
    settled = settle_step(jax.random.key(0), model, split_windows(model)[0])
    assert float(RATIO.value(settled.fit.z[-1])) > 2.0
    assert settled.model.step_error.ratio < 0.6


def test_the_fit_of_some_parameters_is_the_margin_of_that_of_all(tmp_path):
    make_case(tmp_path / "case", "double", noise=1.0, recordings=2, seconds=2.0)
    model = case_model(load_case(tmp_path / "case").check())
    fit = fit_direct(jax.random.key(0), predictor(model), model.shots(split_windows(model)[0]), 2)
    one = fit.marginal(1)
    covariance = np.linalg.inv(np.asarray(fit.precision))
    np.testing.assert_allclose(1 / float(one.precision[0, 0]), covariance[0, 0], rtol=1e-9)
    assert one.slopes.shape[1] == fit.slopes.shape[1] - 1
    np.testing.assert_array_equal(one.along_states, fit.along_states)
    # where the second parameter is at its best, so is the first of the margin
    np.testing.assert_allclose(one.pulls.sum(0) - one.z, 0.0, atol=1e-3 * np.sqrt(float(one.precision[0, 0])))


def test_what_steps_do_is_computed_where_the_fit_to_recordings_without_it_ends(tmp_path):
    """A servo damps much within a step: where the masses of a first fit are a little off, so is the step."""
    sealed = make_case(tmp_path / "case", "servo", finer=4, noise=0.3, recordings=6, seconds=3.0, seed=8000059)
    model = case_model(load_case(tmp_path / "case").check())
    settled = settle_step(jax.random.key(0), model, split_windows(model)[0])
    assert settled.model.step_error.ratio == pytest.approx(1 / 16, abs=2e-3)
    truth = np.asarray(model.margins.standard(jnp.array(list(sealed["parameters"].values()))))
    sd = np.sqrt(np.diag(np.linalg.inv(np.asarray(settled.fit.precision))))[:-1]
    assert (np.abs(np.asarray(settled.fit.z[:-1]) - truth) < 3 * sd).all()


@pytest.fixture
def coupled(tmp_path):
    """A diagnosis of a cart whose pole drags it along more than the simulator knows, and the truth."""
    sealed = make_case(tmp_path / "case", "cart", "joint_coupling", strength=0.5, finer=4, noise=0.3, seed=8000092)
    model = case_model(load_case(tmp_path / "case").check(), before=BEFORE)
    return diagnose_case(jax.random.key(0), model, effects=[EFFECTS["joint_coupling"]]), sealed


@pytest.mark.slow
def test_the_answer_finds_the_step_that_its_simulator_without_it_could_not(coupled):
    found, sealed = coupled
    assert found.result.verdict == "explained"
    error = found.model.step_error
    assert error.ratio == pytest.approx(1 / 16, abs=5e-3)
    (mean, sd), truth = found.theta["augmented"], np.array(list(sealed["parameters"].values()))
    assert (np.abs(mean - truth) < 3 * sd).all()
    # with the simulator as it is at the same masses the error is another one
    plain = dataclasses.replace(error, z=error.z[:2], answer=None)
    shots = dataclasses.replace(found.model, step_error=None).shots(found.windows)
    own, other = (e.offset(shots, found.model.refined) for e in (error, plain))
    assert np.abs(own - other).max() > 0.05 * np.abs(own).max()
