import json
import shutil
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr

from bayessim_jax.recordings.checkpoints import Checkpoints
from bayessim_jax.recordings.journal import Journal
from bayessim_jax.recordings.posterior import read_history
from bayessim_jax.recordings.run_folder import RunFolder
from bayessim_jax.recordings.truths import Truths
from bayessim_jax.systems import CartPole, SkidSteer
from tests.recordings.synthetic import SETTINGS, STATE, stacked, state_after

SYSTEM = CartPole.create()
TRUTHS = np.array([[0.5, 0.4], [0.3, 0.7]], np.float32)


def journal(folder, seeds=(3, 4), truths=TRUTHS):
    return Journal(folder, SYSTEM, seeds, Truths.constant(truths), SETTINGS, {"title": "test"}, simulations=10)


def write(book, rounds, truths=TRUTHS, system=SYSTEM):
    for index in rounds:
        book.write(index, stacked(system, index, truths), state_after(index), seconds=2.0)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    folder = RunFolder(tmp_path_factory.mktemp("runs") / "whole").create()
    with journal(folder) as book:
        write(book, [1, 2, 3, 4])
    return folder


def groups(folder):
    with xr.open_datatree(folder.path / "posterior.nc", engine="h5netcdf") as tree:
        return {name: node.to_dataset().load() for name, node in tree.children.items()}


def test_a_line_for_every_round_and_seed(whole):
    lines = [json.loads(line) for line in (whole.path / "metrics.jsonl").read_text().splitlines()]
    assert [(line["round"], line["seed"]) for line in lines] == [(r, s) for r in (1, 2, 3, 4) for s in (3, 4)]
    assert all(line["simulations_per_second"] == 10 for line in lines)


def test_the_posterior_file_is_named_and_has_units(whole):
    data = groups(whole)
    assert set(data) == {"prior", "posterior", "posterior_rounds", "observed_data"}
    length = data["posterior"]["length"]
    assert length.dims == ("chain", "draw", "seed")
    assert length.attrs["units"] == "m"
    assert data["posterior"]["mass"].attrs["units"] == "kg"
    np.testing.assert_allclose(length.attrs["truth"], [0.5, 0.3])
    np.testing.assert_allclose([length.attrs["prior_low"], length.attrs["prior_high"]], [0.1, 1.0])
    assert data["posterior_rounds"]["length"].dims == ("round", "chain", "draw", "seed")
    np.testing.assert_array_equal(data["posterior_rounds"]["length"][-1], length)
    seen = data["observed_data"]
    assert seen["angle_dot"].attrs["units"] == "rad/s"
    assert seen["angle_dot"].dims == ("round", "seed", "recording", "row")
    assert seen["angle_dot"].shape == (4, 2, 2, 6)
    assert seen["action_push"].shape == (4, 2, 2, 5)
    np.testing.assert_allclose(seen["x"].sel(round=3, seed=4)[0], np.linspace(0, 3, 6), rtol=1e-6)
    prior = np.stack([data["prior"][name].values.ravel() for name in ("length", "mass")])
    assert prior.min() >= 0.1
    assert prior.max() <= 1.0
    assert prior.shape[1] >= 500


def test_draws_lie_where_the_posterior_is(whole):
    draws = groups(whole)["posterior_rounds"]["length"].sel(seed=4, round=4).values.ravel()
    # round 4 of the synthetic run: N(0.3 + 0.00225, 0.045²), cut to [0.1, 1]
    assert abs(draws.mean() - 0.30225) < 4 * 0.045 / np.sqrt(draws.size)
    assert abs(draws.std() - 0.045) < 0.005


def test_one_seed_has_no_seed_dimension_and_no_truth_where_it_is_unknown(tmp_path):
    unknown = np.full((1, 2), np.nan, np.float32)
    folder = RunFolder(tmp_path / "real").create()
    with journal(folder, [3], unknown) as book:
        write(book, [1], TRUTHS[:1])
    data = groups(folder)
    assert data["posterior"]["length"].dims == ("chain", "draw")
    assert "truth" not in data["posterior"]["length"].attrs
    assert data["observed_data"]["x"].dims == ("round", "recording", "row")
    assert folder.read_metrics()[0]["log_prob_true"] is None
    history = read_history(folder.path / "posterior.nc", SYSTEM.observations, SYSTEM.actions)
    assert history.observations.shape == (1, 1, 2, 6, 4)


def test_channels_with_a_slash_are_variables_with_a_dot(tmp_path):
    system, truths = SkidSteer.create(), np.array([[0.06, 0.5, 0.1]], np.float32)
    folder = RunFolder(tmp_path / "robot").create()
    with Journal(folder, system, [3], Truths.constant(truths), SETTINGS, {"title": "test"}, simulations=10) as book:
        write(book, [1, 2], truths, system)
    seen = groups(folder)["observed_data"]
    assert seen["base.yaw"].attrs["units"] == "rad"
    assert seen["action_input.left"].dims == ("round", "recording", "step")
    history = read_history(folder.path / "posterior.nc", system.observations, system.actions)
    assert (history.observations.shape, history.actions.shape) == ((2, 1, 2, 6, 3), (2, 1, 2, 5, 2))


def test_resumed_equals_whole(whole, tmp_path):
    """Killed after the metrics of round 3 and before its checkpoint: round 3 is dropped and done again."""
    folder = RunFolder(tmp_path / "cut").create()
    with journal(folder) as book:
        write(book, [1, 2])
    folder.write_metrics([*folder.read_metrics(), {"round": 3, "seed": 3, "log_prob_true": 99.0}])
    with journal(folder) as book:
        done, state = book.resume(STATE)
        assert done == 2
        assert jax.tree.all(jax.tree.map(jnp.array_equal, state, state_after(2)))
        # tied to a device, or weakly typed, they would ask for another program than those of a new run
        assert not any(leaf.committed or leaf.weak_type for leaf in jax.tree.leaves(state))
        assert [line["round"] for line in folder.read_metrics()] == [1, 1, 2, 2]
        write(book, [3, 4])
    assert (folder.path / "metrics.jsonl").read_bytes() == (whole.path / "metrics.jsonl").read_bytes()
    for name, data in groups(whole).items():
        xr.testing.assert_identical(data, groups(folder)[name])


def test_only_the_last_two_checkpoints_are_kept(whole):
    kept = {p.name for p in (whole.path / "checkpoints").iterdir() if p.name.isdigit()}
    assert kept == {"3", "4"}


def test_empty_arrays_of_a_state_come_back(tmp_path):
    """A posterior of one parameter has nothing below the diagonal."""
    state = {"below": jnp.zeros((5, 0)), "weights": [jnp.arange(3.0)]}
    checkpoints = Checkpoints(tmp_path / "checkpoints")
    checkpoints.save(1, state, {})
    back = checkpoints.restore(state)
    checkpoints.close()
    assert back["below"].shape == (5, 0)
    np.testing.assert_array_equal(back["weights"][0], state["weights"][0])


def test_a_checkpoint_knows_its_settings(whole):
    checkpoints = Checkpoints(whole.path / "checkpoints")
    assert checkpoints.settings() == SETTINGS
    checkpoints.close()


@pytest.mark.parametrize("like", [{"weights": jnp.zeros(4)}, {"weights": jnp.zeros(7), "round": jnp.array(0)}])
def test_a_state_of_another_shape_is_refused(whole, like):
    checkpoints = Checkpoints(whole.path / "checkpoints")
    with pytest.raises(ValueError, match=r"checkpoint .*4 holds another state: \['(weights|round)'\] is"):
        checkpoints.restore(like)
    checkpoints.close()


def test_a_damaged_checkpoint_is_named_and_the_one_before_can_be_used(tmp_path):
    checkpoints = Checkpoints(tmp_path / "checkpoints")
    for index in (1, 2):
        checkpoints.save(index, state_after(index), SETTINGS)
    for file in (tmp_path / "checkpoints" / "2" / "state").rglob("*"):
        if file.is_file():
            file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    checkpoints.close()
    checkpoints = Checkpoints(tmp_path / "checkpoints")
    with pytest.raises(ValueError, match=r"checkpoint .*2 is damaged .* delete that folder"):
        checkpoints.restore(STATE)
    checkpoints.close()
    shutil.rmtree(tmp_path / "checkpoints" / "2")
    checkpoints = Checkpoints(tmp_path / "checkpoints")
    assert checkpoints.latest == 1
    assert jnp.array_equal(checkpoints.restore(STATE)["weights"], state_after(1)["weights"])
    checkpoints.close()


def test_a_damaged_posterior_is_named(tmp_path):
    path = tmp_path / "posterior.nc"
    path.write_bytes(b"not netCDF")
    with pytest.raises(ValueError, match=r"posterior\.nc is missing or damaged"):
        read_history(path, SYSTEM.observations, SYSTEM.actions)


def test_the_tensorboard_logs_hold_the_numbers(whole):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        accumulator = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    events = accumulator.EventAccumulator(str(whole.path / "tensorboard" / "seed4")).Reload()
    assert [e.step for e in events.Scalars("log_prob_true")] == [1, 2, 3, 4]
    lines = [line for line in whole.read_metrics() if line["seed"] == 4]
    np.testing.assert_allclose(
        [e.value for e in events.Scalars("mean/length")], [line["mean"]["length"] for line in lines], rtol=1e-5
    )
