"""Effects in a system without a model: they begin with what was commanded before, behind what sensors showed."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayessim_jax.effects import EFFECTS, Scales, commanded_scales, effect_places, with_effects
from bayessim_jax.inference.replay import Inputs, replay_window
from bayessim_jax.systems import SkidSteer

LEFT, RIGHT = "actuator/input/left", "actuator/input/right"
THETA = jnp.array([0.07, 0.5, 0.1])
POSE = jnp.array([0.3, -0.2, 0.4])


def vehicle(*pairs):
    robot = SkidSteer.create(noise=0.0)
    return with_effects(robot, [(EFFECTS[name], place) for name, place in pairs], Scales(period=0.05, timestep=0.05))


def test_a_lag_begins_where_the_commands_before_left_it():
    machine, lag = vehicle(("actuator_lag", LEFT)), 0.2
    past = jnp.array([[2.0, 0.0]] * 2 + [[4.0, 0.0]] * 3)
    state = machine.begin(jnp.append(THETA, lag), POSE, past, time=1.0)
    assert float(state.memories[0]) == pytest.approx(4.0 - 2.0 * np.exp(-0.15 / lag), rel=1e-5)
    assert float(state.time) == pytest.approx(1.0)


def test_a_delay_hands_on_the_commands_before():
    machine = vehicle(("actuator_delay", LEFT))
    theta = jnp.append(THETA, 0.1)
    past = jnp.array([[1.0, 0.0], [5.0, 0.0], [3.0, 0.0]])
    state, moved = machine.begin(theta, POSE, past), []
    for _ in range(3):
        state = machine.step(theta, state, jnp.array([9.0, 0.0]))
        moved.append(float(state.base.speed))
    np.testing.assert_allclose(moved, [0.035 * u for u in (5.0, 3.0, 9.0)], rtol=1e-5)


@pytest.mark.parametrize(
    ("name", "value"), [("actuator_lag", 0.3), ("actuator_delay", 0.12), ("actuator_deadband", 1.5)]
)
def test_an_effect_on_all_actuators_is_the_same_one_on_each(name, value):
    alike, apart = vehicle((name, "actuator/*")), vehicle((name, LEFT), (name, RIGHT))
    rows = jnp.asarray(np.random.default_rng(1).uniform(-5, 5, (8, 2)))
    shown = []
    for machine, own in ((alike, [value]), (apart, [value, value])):
        theta = jnp.append(THETA, jnp.array(own))
        state = machine.begin(theta, POSE, rows)
        for row in rows:
            state = machine.step(theta, state, row)
        shown.append(machine.observe(theta, state))
    np.testing.assert_allclose(*shown, rtol=1e-6)


def test_places_in_a_vehicle_are_its_actuators_all_of_them_and_its_channels():
    robot = SkidSteer.create()
    places = {name: effect_places(EFFECTS[name], robot) for name in EFFECTS}
    assert places["actuator_lag"] == [LEFT, RIGHT, "actuator/*"]
    assert places["wheel_slip"] == [f"{LEFT}#{RIGHT}"]
    assert places["sensor_scale"] == ["base/x", "base/y", "base/yaw"]
    assert not places["sensor_delay"] and not places["back_emf"] and not places["coulomb_friction"]


def test_delays_reach_over_many_control_periods_however_long_these_are():
    (slow,), (fast,) = (EFFECTS["actuator_delay"].parameters(LEFT, Scales(period=h, timestep=h)) for h in (0.05, 0.002))
    assert slow.high == pytest.approx(0.8) and fast.high == pytest.approx(0.1)


@pytest.mark.parametrize(("name", "value"), [("sensor_offset", 0.3), ("sensor_scale", 1.2)])
def test_a_state_shows_what_it_was_begun_with(name, value):
    machine = vehicle((name, "base/yaw"))
    theta = jnp.append(THETA, value)
    np.testing.assert_allclose(machine.observe(theta, machine.begin(theta, POSE, jnp.zeros((2, 2)))), POSE, rtol=1e-6)


def test_commands_from_before_a_recording_are_part_of_what_is_fitted():
    machine, ctrl = vehicle(("actuator_lag", LEFT)), jnp.full((6, 2), 4.0)
    past, early = jnp.full((4, 2), 4.0), jnp.array([True, True, False, False])
    theta = jnp.append(THETA, 0.2)

    def shown(past, delta, unrecorded=None):
        inputs = Inputs(POSE, jnp.zeros(0), ctrl, past, jnp.zeros(()), unrecorded=unrecorded)
        return np.asarray(replay_window(machine, theta, jnp.asarray(delta), inputs))

    moved = shown(past, [0.0, 0.0, 0.0, -3.0, 1.0], early)
    held = past.at[:2].add(jnp.array([-3.0, 1.0]))
    np.testing.assert_allclose(moved, shown(held, jnp.zeros(3)), rtol=1e-6)
    assert np.abs(moved - shown(past, jnp.zeros(3))).max() > 1e-2


def test_scales_are_those_of_the_command_and_of_the_channel():
    robot, rng = SkidSteer.create(), np.random.default_rng(0)
    observations, commands = rng.normal([5.0, 0.0, 0.0], [2.0, 1.0, 1.0], (1000, 3)), rng.uniform(-8, 8, (1000, 2))
    at_actuator, at_channel = (
        commanded_scales(robot, place, observations, commands, 0.05, 4.0) for place in (LEFT, "base/x")
    )
    assert at_actuator.command == pytest.approx(0.95 * 8, rel=0.05)
    assert (at_actuator.period, at_actuator.duration) == (0.05, 4.0)
    assert at_channel.position == pytest.approx(2 * 1.96, rel=0.1) and at_channel.unit == "m"
    with pytest.raises(ValueError, match="take one of input/left, input/right"):
        commanded_scales(robot, "actuator/input/lft", observations, commands, 0.05, 4.0)


def test_memory_of_a_chain_is_that_of_the_same_commands_stepped_through():
    """What a lag behind a delay remembers does not depend on whether its commands came before or after it began."""
    machine = vehicle(("actuator_delay", LEFT), ("actuator_lag", LEFT))
    theta = jnp.concatenate([THETA, jnp.array([0.12, 0.3])])
    rows = jnp.asarray(np.random.default_rng(1).uniform(-5, 5, (8, 2)))
    begun = machine.begin(theta, POSE, rows)
    stepped = machine.begin(theta, POSE, rows[:1])
    for row in rows[1:]:
        stepped = machine.step(theta, stepped, row)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5), begun.memories, stepped.memories)
