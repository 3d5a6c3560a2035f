"""The vehicle that slips: the robot itself where nothing is wrong with it, and the closed forms of what is."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayessim_jax.effects.vehicle import TERRAINS, SkidSteerVehicle
from bayessim_jax.systems import SkidSteer

ROBOT = SkidSteer.create(noise=0.0)
THETA = jnp.array([0.0625, 0.475, 0.2])


def drive(machine, commands, key=0, theta=THETA):
    def step(state, command):
        after = machine.step(theta, state, command)
        return after, machine.observe(theta, after)

    return np.asarray(jax.lax.scan(step, machine.reset(jax.random.key(key), theta), jnp.asarray(commands))[1])


def test_a_vehicle_without_faults_is_the_robot():
    sound = SkidSteerVehicle(ROBOT, limit=1e3)
    theta = sound.theta(THETA, slip=0.0, turning_slip=0.0, lag=0.0)
    commands = np.random.default_rng(0).uniform(-9, 9, (60, 2))
    np.testing.assert_allclose(drive(sound, commands, theta=theta), drive(ROBOT, commands), atol=1e-5)


def test_wheels_follow_as_an_exponential_up_to_the_limit():
    lagging = SkidSteerVehicle(ROBOT, limit=4.0)
    theta = lagging.theta(THETA, slip=0.0, turning_slip=0.0, lag=0.2)
    state, wheels = lagging.reset(jax.random.key(0), theta), []
    for _ in range(10):
        state = lagging.step(theta, state, jnp.array([3.0, 50.0]))
        wheels.append(state.wheels)
    rise = 1 - np.exp(-0.05 * np.arange(1, 11) / 0.2)
    np.testing.assert_allclose(np.stack(wheels), rise[:, None] * [3.0, 4.0], rtol=1e-4)


def test_slip_depends_on_the_ground():
    def speed(border, looseness=5.0):
        machine = SkidSteerVehicle(ROBOT, border=border)
        theta = machine.theta(THETA, slip=0.02, turning_slip=0.05, looseness=looseness, lag=0.0)
        poses = drive(machine, np.full((20, 2), 4.0), theta=theta)
        return np.linalg.norm(np.diff(poses[:, :2], axis=0), axis=1) / 0.05

    np.testing.assert_allclose(speed(50.0), 0.98 * 0.25, rtol=1e-3)
    np.testing.assert_allclose(speed(-50.0), 0.9 * 0.25, rtol=1e-3)
    np.testing.assert_allclose(speed(-50.0, looseness=1.0), 0.98 * 0.25, rtol=1e-3)


@pytest.mark.parametrize("terrain", ["asphalt", "gravel", "ice"])
def test_on_even_ground_the_vehicle_moves_as_the_robot_that_it_seems_to_be(terrain):
    machine = SkidSteerVehicle(ROBOT, limit=1e3)
    theta = machine.theta(THETA, **TERRAINS[terrain], lag=0.0)
    commands = np.random.default_rng(1).uniform(-9, 9, (60, 2))
    robot = machine.apparent(theta)
    np.testing.assert_allclose(drive(machine, commands, theta=theta), drive(ROBOT, commands, theta=robot), atol=1e-5)


def test_the_ground_changes_without_compiling_anew():
    machine, traces = SkidSteerVehicle(ROBOT), []

    @jax.jit
    def end(theta):
        traces.append(1)
        state, _ = jax.lax.scan(
            lambda s, u: (machine.step(theta, s, u), None),
            machine.reset(jax.random.key(0), theta),
            jnp.full((40, 2), 4.0),
        )
        return state.robot.x

    ways = {name: float(end(machine.theta(THETA, **TERRAINS[name]))) for name in ("asphalt", "gravel", "ice")}
    assert len(traces) == 1
    assert ways["ice"] < ways["gravel"] < ways["asphalt"]
    assert machine.parameters.contains(machine.theta(THETA))
