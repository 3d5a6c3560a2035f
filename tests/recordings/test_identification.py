"""`infer_case` on made-up machines whose parameters are known."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayessim_jax.recordings.identification import infer_case
from bayessim_jax.recordings.loading import load_case
from bayessim_jax.recordings.shots import case_model, split_windows
from bayessim_jax.report.infer import worries
from bayessim_jax.systems.skid_steer import SkidSteer
from benchmarks.compilation import watch_compilation
from benchmarks.worlds import make_case


@pytest.fixture(autouse=True)
def in_double_precision():
    jax.config.update("jax_enable_x64", True)
    yield
    jax.config.update("jax_enable_x64", False)


def inferred(folder, seed=0, method="direct", **options):
    return infer_case(jax.random.key(seed), case_model(load_case(folder).check(), **options), method=method)


def test_an_unknown_method_is_answered_with_the_near_miss(tmp_path):
    make_case(tmp_path / "rig", "slide", seed=3, recordings=2, seconds=1.0)
    with pytest.raises(ValueError, match="unknown method 'amortized': did you mean 'amortised'"):
        inferred(tmp_path / "rig", method="amortized")


def test_parameters_noise_and_predictions_of_a_pendulum(tmp_path):
    sealed = make_case(tmp_path / "rig", "pendulum", seed=3)
    result = inferred(tmp_path / "rig")
    draws = np.asarray(result.posterior.draws)
    assert abs(draws.mean() - sealed["parameters"]["rod_mass"]) < 5 * draws.std() + 2e-4
    assert draws.std() < 1e-3
    noise = dict(zip(result.model.channels, np.asarray(result.posterior.fit.sigma), strict=True))
    assert noise["joint/hinge/qpos"] == pytest.approx(1e-3, rel=0.15)
    assert noise["joint/hinge/qvel"] == pytest.approx(1e-2, rel=0.15)
    assert result.scores["posterior"].nrmse < 1.3 * result.noise_floor
    assert result.scores["posterior"].nrmse < result.scores["baseline"].nrmse
    assert set(result.fitted.recording) & set(result.held_out.recording) == set()
    assert worries(result) == []
    assert result.identifiability.not_informed == []


def test_predictions_that_miss_by_more_than_noise_are_a_worry(tmp_path):
    """The fit counts all that friction does as noise; the sensors' own is what differs from row to row."""
    make_case(tmp_path / "rig", "pendulum", ["coulomb_friction"], strength=0.3, seed=3)
    result = inferred(tmp_path / "rig")
    assert np.asarray(result.posterior.fit.sigma)[0] > 3e-3
    assert result.scores["posterior"].nrmse > 2 * result.noise_floor
    assert any("something is missing in the simulator" in worry for worry in worries(result))


def test_without_measured_velocities(tmp_path):
    sealed = make_case(tmp_path / "rig", "pendulum", seed=4, velocities=False)
    result = inferred(tmp_path / "rig")
    draws = np.asarray(result.posterior.draws)
    assert result.model.channels == ("joint/hinge/qpos",)
    assert abs(draws.mean() - sealed["parameters"]["rod_mass"]) < 5 * draws.std() + 2e-4


def test_one_recording_is_split_by_windows(tmp_path):
    make_case(tmp_path / "rig", "slide", seed=5, recordings=1, seconds=6.0)
    fitted, held = split_windows(case_model(load_case(tmp_path / "rig").check()))
    assert len(held) >= 2
    assert set(np.round(fitted.start, 6)) & set(np.round(held.start, 6)) == set()


@pytest.fixture
def with_lift(tmp_path):
    """A slide with a parameter that nothing depends on."""
    folder = tmp_path / "rig"
    make_case(folder, "slide", seed=6)
    text = (folder / "case.toml").read_text()
    text += '\n[[parameters]]\nname = "lift"\ntargets = ["body/carriage/ipos/2"]\n'
    text += 'prior = { distribution = "uniform", low = -0.1, high = 0.1 }\n'
    (folder / "case.toml").write_text(text)
    return folder


def test_a_parameter_that_nothing_depends_on_is_named(with_lift):
    found = inferred(with_lift).identifiability
    assert found.not_informed == ["lift"]


def test_two_that_trade_off_are_a_ridge(tmp_path):
    folder = tmp_path / "rig"
    make_case(folder, "slide", seed=7)
    text = (folder / "case.toml").read_text()
    text += '\n[[parameters]]\nname = "gear"\ntargets = ["actuator/motor/gear"]\n'
    text += 'prior = { distribution = "uniform", low = 0.5, high = 1.6 }\n'
    (folder / "case.toml").write_text(text)
    result = inferred(folder)
    assert [set(r[:2]) for r in result.identifiability.ridges] == [{"carriage_mass", "gear"}]


def test_engines_agree_on_the_posterior(tmp_path):
    make_case(tmp_path / "rig", "pendulum", seed=8, recordings=2, seconds=2.0)
    tree, c = (np.asarray(inferred(tmp_path / "rig", engine=e).posterior.draws) for e in ("tree", "mujoco"))
    assert tree.mean() == pytest.approx(c.mean(), abs=0.2 * tree.std())
    assert tree.std() == pytest.approx(c.std(), rel=0.2)


def test_a_registered_system_is_restarted_from_its_observations(tmp_path):
    """The skid-steer robot, simulated here with known parameters and recorded with noise."""
    system = SkidSteer.create()
    truth = jnp.array([0.07, 0.5, 0.1])
    rng = np.random.default_rng(0)
    (tmp_path / "recordings").mkdir()
    for k in range(4):
        state, rows = system.restart(truth, jnp.zeros(3)), []
        ctrl = np.cumsum(rng.normal(size=(80, 2)), axis=0)
        for t in range(80):
            pose = np.asarray(system.observe(truth, state)) + 1e-3 * rng.normal(size=3)
            rows.append([t * system.dt, *pose, *ctrl[t]])
            state = system.step(truth, state, jnp.asarray(ctrl[t]))
        header = "time,base/x,base/y,base/yaw,input/left,input/right"
        np.savetxt(tmp_path / "recordings" / f"{k}.csv", rows, delimiter=",", header=header, comments="")
    names = {"wheel_radius": (0.04, 0.1), "axial_distance": (0.3, 0.7), "icr_offset": (-0.3, 0.3)}
    text = 'schema = 1\nsystem = "skid_steer"\nrecordings = "recordings/*.csv"\nhorizon = 1.0\n'
    for name, (low, high) in names.items():
        text += f'[[parameters]]\nname = "{name}"\ntargets = ["{name}"]\n'
        text += f'prior = {{ distribution = "uniform", low = {low}, high = {high} }}\n'
    (tmp_path / "case.toml").write_text(text)
    result = inferred(tmp_path)
    draws = np.asarray(result.posterior.draws)
    assert (np.abs(draws.mean(0) - truth) < 5 * draws.std(0)).all()
    assert (draws.std(0) < 0.1 * np.abs(truth)).all()
    assert result.scores["posterior"].nrmse < 1.3 * result.noise_floor


@pytest.mark.slow
@pytest.mark.parametrize(("method", "worlds"), [("direct", 30), ("amortised", 15)])
def test_credible_sets_of_many_worlds_hold_the_truth_as_often_as_they_say(tmp_path, method, worlds):
    levels = []
    for seed in range(worlds):
        folder = tmp_path / f"rig{seed}"
        sealed = make_case(folder, "slide", seed=seed, recordings=2, seconds=2.0)
        draws = np.asarray(inferred(folder, seed, method).posterior.draws)[:, 0]
        levels.append((draws < sealed["parameters"]["carriage_mass"]).mean())
        jax.clear_caches()  # every world compiles programs of its own
    central = np.abs(2 * np.array(levels) - 1)
    assert 0.25 <= (central < 0.5).mean() <= 0.75, sorted(central)
    assert (central < 0.9).mean() >= 0.75, sorted(central)


@pytest.mark.slow
def test_networks_name_what_the_recordings_do_not_inform(with_lift):
    found = inferred(with_lift, method="amortised")
    assert found.identifiability.not_informed == ["lift"]
    assert found.posterior.z[:, 1].std() == pytest.approx(1.0, abs=0.2)


def test_a_machine_that_is_identified_again_is_not_compiled_again(tmp_path):
    """Loaded anew, from other recordings: programs know the model by what it is made of."""
    for seed in (3, 4):
        make_case(tmp_path / str(seed), "slide", seed=seed, recordings=2, seconds=2.0)
    inferred(tmp_path / "3")
    with watch_compilation() as again:
        inferred(tmp_path / "4")
    assert again.spans == []
    text = (tmp_path / "4" / "model.xml").read_text()
    (tmp_path / "4" / "model.xml").write_text(text.replace('timestep="0.002"', 'timestep="0.001"'))
    assert 'timestep="0.001"' in (tmp_path / "4" / "model.xml").read_text()
    with watch_compilation() as other:
        inferred(tmp_path / "4")
    assert other.spans != []
