"""The simulator of a diagnosis as a system with a task."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayessim_jax.contracts import Restartable, System, Task
from bayessim_jax.effects import EFFECTS, Scales, with_effects
from bayessim_jax.recordings.repaired import load_repaired
from bayessim_jax.systems.mjcf import Unknown, mjcf_system
from tests.recordings.diagnosed import RIG, write_diagnosis
from tests.recordings.made_up_case import columns

MASS = Unknown("bob_mass", ("body/bob/mass",), 0.15, 0.6, "kg")


@pytest.fixture(scope="module")
def repaired(tmp_path_factory):
    return load_repaired(write_diagnosis(tmp_path_factory.mktemp("repaired")))


def test_the_prior_is_the_diagnosis_posterior_cut_to_what_is_possible(tmp_path):
    wide = write_diagnosis(tmp_path, effects=[("coulomb_friction", {"coulomb": (0.05, 0.03)})], mass=(0.3, 0.002))
    repaired = load_repaired(wide)
    box = repaired.posterior_box()
    assert box.names == ("bob_mass", "coulomb_friction@joint/hinge/coulomb")
    assert box.units == ("kg", "N m")
    # 0.3 ± 3 · 0.002; 0.05 ± 3 · 0.03, of which friction has only what is above zero
    np.testing.assert_allclose(box.low, [0.294, 0.0], atol=1e-6)
    np.testing.assert_allclose(box.high, [0.306, 0.14], atol=1e-6)
    system = repaired.system(noise=0.02, bob_mass=(0.2, 0.5))
    np.testing.assert_allclose(system.parameters.low, [0.2, 0.0], atol=1e-6)
    np.testing.assert_allclose(system.noise, np.hypot([0.001, 0.02], 0.02), rtol=1e-5)


def test_a_posterior_that_is_certain_or_unknown_still_is_a_box(tmp_path):
    sure = load_repaired(write_diagnosis(tmp_path / "a", mass=(0.6, 0.0))).posterior_box()
    assert 0.599 < sure.low[0] < sure.high[0] <= 0.6
    unknown = load_repaired(write_diagnosis(tmp_path / "b", mass=(0.3, float("nan")))).posterior_box()
    np.testing.assert_allclose([unknown.low[0], unknown.high[0]], [0.15, 0.6], rtol=1e-5)


def test_the_system_keeps_the_contract_and_steps_as_its_simulator_does(repaired):
    system = repaired.system()
    assert isinstance(system, System) and isinstance(system, Restartable)
    assert (system.rows, system.dt) == (2, pytest.approx(0.02))
    theta = jnp.asarray(repaired.mean, float)
    state = system.reset(jax.random.key(0), theta)
    action = jnp.array([0.7])
    after = jax.jit(system.step)(theta, state, action)
    assert jax.eval_shape(lambda: after) == jax.eval_shape(lambda: state)
    twice = state
    for _ in range(2):
        twice = repaired.simulator.step(theta, twice, action)
    np.testing.assert_allclose(system.observe(theta, after), system.observe(theta, twice), rtol=1e-5)


def test_episodes_begin_beside_recorded_states(repaired):
    system, theta = repaired.system(), jnp.asarray(repaired.mean, float)
    draw = jax.jit(jax.vmap(lambda key: system.observe(theta, system.reset(key, theta))))
    begun = np.asarray(draw(jax.random.split(jax.random.key(0), 200)))
    starts = np.concatenate([system.starts.qpos, system.starts.qvel], 1)
    assert len(starts) == 7  # 399 steps of 10 ms in windows of 0.5 s
    gaps = np.abs(begun[:, None] - starts[None])
    near = (gaps <= system.scatter + 1e-5).all(-1)
    assert near.any(1).all() and near.any(0).all()
    assert begun.std(0).min() > 0.1


def test_without_a_named_effect_the_simulator_is_the_baseline(tmp_path):
    for verdict in ("unexplained", "no_mismatch"):
        repaired = load_repaired(write_diagnosis(tmp_path / verdict, verdict=verdict))
        assert repaired.effects == () and repaired.simulator.parameters.names == ("bob_mass",)
        np.testing.assert_allclose(repaired.mean, [0.4])
        told = repaired.sentences(repaired.task({}))
        assert told[0].startswith("the simulator of rig as it is") and verdict in told[0]
    sets = [["coulomb_friction@joint/hinge"], ["back_emf@joint/hinge", "armature@joint/hinge"]]
    unsure = load_repaired(write_diagnosis(tmp_path / "ambiguous", verdict="ambiguous", confusion=sets))
    told = unsure.sentences(unsure.task({}))[0]
    assert told.endswith("cannot tell this from back_emf@joint/hinge and armature@joint/hinge")


def test_actions_are_those_of_the_model_or_of_the_recordings(tmp_path, repaired):
    np.testing.assert_allclose([repaired.actions.low[0], repaired.actions.high[0]], [-2, 2])
    free = RIG.replace(' ctrlrange="-2 2"', "")
    box = load_repaired(write_diagnosis(tmp_path / "free", model=free)).actions
    np.testing.assert_allclose([box.low[0], box.high[0]], [-0.4, 0.4], atol=1e-3)
    idle = columns()
    idle["actuator/motor/ctrl"][:] = 0.0
    still = load_repaired(write_diagnosis(tmp_path / "idle", model=free, run1=idle))
    with pytest.raises(ValueError, match="actuator/motor/ctrl has no range in the model"):
        still.system()


def test_the_task_is_to_hold_a_pose(repaired):
    task, theta = repaired.task({"joint/hinge": 0.3}), jnp.asarray(repaired.mean, float)
    assert isinstance(task, Task)
    begin = lambda q, v=0.0: repaired.simulator.begin(theta, jnp.array([q]), jnp.array([v]))  # noqa: E731
    pay = lambda state, u=0.0: float(task.reward(begin(0.0), jnp.array([u]), state))  # noqa: E731
    assert pay(begin(0.3)) == pytest.approx(0.0, abs=1e-9)
    # the joint turns freely: a turn more changes nothing, and half a turn is as far as it goes
    assert pay(begin(0.3 + 2 * np.pi)) == pytest.approx(0.0, abs=1e-9)
    reach = np.ptp(columns()["joint/hinge/qpos"])
    assert pay(begin(0.3 + np.pi / 2)) == pytest.approx(-((np.pi / 2 / reach) ** 2), rel=1e-3)
    assert pay(begin(0.3, 1.0)) == pytest.approx(-task.motion_cost / float(task.fast[0]) ** 2, rel=1e-3)
    assert pay(begin(0.3), 2.0) == pytest.approx(-task.command_cost, rel=1e-3)
    assert float(repaired.task({}).goal[0]) == pytest.approx(np.median(columns()["joint/hinge/qpos"]), rel=1e-4)


def test_a_limited_joint_keeps_its_turns_and_its_range(tmp_path):
    limited = RIG.replace('axis="0 1 0" damping', 'axis="0 1 0" range="-115 115" limited="true" damping')
    repaired = load_repaired(write_diagnosis(tmp_path, model=limited))
    assert repaired.task({}).turns == (False,)
    with pytest.raises(ValueError, match=r"goal joint/hinge=3 lies outside the joint's range, -2.00713 to 2.00713"):
        repaired.task({"joint/hinge": 3.0})
    with pytest.raises(ValueError, match="unknown joint 'joint/hing': did you mean 'joint/hinge'"):
        repaired.task({"joint/hing": 0.0})
    told = repaired.sentences(repaired.task({"joint/hinge": -1.9}))
    assert told[1] == "goal: joint/hinge at -1.9 rad"
    assert "outside of the recorded positions" in told[2]


@pytest.mark.parametrize("effects", [(), ("coulomb_friction@joint/hinge", "sensor_offset@joint/hinge/qpos")])
def test_a_model_restarts_from_what_it_shows(effects):
    plain = mjcf_system(RIG, [MASS])
    pairs = [(EFFECTS[name], place) for name, place in (e.split("@") for e in effects)]
    system = with_effects(plain, pairs, Scales()) if pairs else plain
    theta = (system.parameters.low + 2 * system.parameters.high) / 3
    seen = jnp.array([0.4, -1.1])
    np.testing.assert_allclose(system.observe(theta, system.restart(theta, seen)), seen, atol=1e-6)


def test_a_model_whose_velocity_is_not_seen_cannot_restart():
    system = mjcf_system(RIG, [MASS], observe=["joint/hinge/qpos"])
    with pytest.raises(ValueError, match="joint/hinge/qvel is missing; observe it"):
        system.restart(system.parameters.low, jnp.zeros(1))
