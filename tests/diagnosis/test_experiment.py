"""Experiments that tell the members of a confusion set apart."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayessim_jax.diagnosis.bench import Bench, Candidate
from bayessim_jax.diagnosis.experiment import Motions, commands, design
from bayessim_jax.diagnosis.verdict import Entry
from bayessim_jax.effects import EFFECTS, Scales
from bayessim_jax.inference.shooting import solve
from bayessim_jax.recordings.loading import load_case
from bayessim_jax.recordings.shots import case_model
from benchmarks.worlds import make_case

DT = 0.004


@pytest.fixture(scope="module")
def rig(tmp_path_factory):
    jax.config.update("jax_enable_x64", True)
    folder = tmp_path_factory.mktemp("experiment") / "rig"
    make_case(folder, "pendulum", seed=3, recordings=1, seconds=2.0)
    model = case_model(load_case(folder).check(), before=0.04)
    pairs = [(EFFECTS["coulomb_friction"], "joint/hinge"), (EFFECTS["viscous_friction"], "joint/hinge")]
    scales = {"joint/hinge": Scales(timestep=0.002, period=DT)}
    shots = model.shots(model.windows([0]))
    yield Bench(model.system, model.margins, pairs, scales, shots), model.recordings[0]
    jax.config.update("jax_enable_x64", False)


def member(bench, k):
    x = bench.starts(Candidate((k,)), jnp.array([0.0]))[1]
    delta = jnp.zeros((bench.shots.y.shape[0], 2))
    given = (x, delta, jnp.array([0.01, 0.1]), jnp.zeros(x.size, bool))
    fit = solve(
        bench.simulator(Candidate((k,))), bench.setup(Candidate((k,))), *given, live=bench.used(Candidate((k,)))
    )
    fit = fit.replace(precision=1e4 * jnp.eye(x.size))
    return Entry(Candidate((k,)), [k], [bench.name(k)], fit, np.zeros(1), None)


def library(recording, rows=250):
    named = commands(recording.ctrl, ["actuator/motor"], rows, DT)
    starts = [np.repeat(x[:1], len(named), 0) for x in (recording.qpos, recording.qvel)]
    return Motions([name for name, _ in named], np.stack([signal for _, signal in named]), *starts)


def test_commands_stay_within_the_recorded_ones():
    recorded = np.random.default_rng(0).uniform([-1, 2], [3, 2.5], (100, 2))
    named = commands(recorded, ["actuator/a", "actuator/b"], 200, 0.01)
    assert len({name for name, _ in named}) == len(named)
    away = np.abs(recorded - recorded.mean(0)).max(0)
    for _, signal in named[1:]:
        assert signal.shape == (200, 2)
        assert np.all(np.abs(signal - recorded.mean(0)) <= away + 1e-9)
    alone = dict(named)["a chirp on actuator/b, 100% of the recorded commands"]
    assert np.ptp(alone[:, 0]) == 0 < np.ptp(alone[:, 1])


def test_different_frictions_are_told_apart_and_the_same_one_is_not(rig):
    bench, recording = rig
    coulomb, viscous = member(bench, 0), member(bench, 1)
    motions = library(recording)
    found = design(bench, [coulomb, viscous], motions, bench.shots, DT)
    assert found.nats > 10
    assert set(map(tuple, found.pair)) == {("coulomb_friction@joint/hinge",), ("viscous_friction@joint/hinge",)}
    assert found.name in motions.names
    assert design(bench, [coulomb, member(bench, 0)], motions, bench.shots, DT) is None


def test_motions_that_leave_the_recorded_range_are_not_proposed(rig):
    bench, recording = rig
    motions = library(recording)
    wild = Motions(motions.names, 1e3 * (motions.ctrl + 1), motions.qpos, motions.qvel)
    assert design(bench, [member(bench, 0), member(bench, 1)], wild, bench.shots, DT) is None
