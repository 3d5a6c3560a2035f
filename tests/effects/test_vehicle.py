"""The vehicle that slips: the robot itself where nothing is wrong with it, and the closed forms of what is."""

import jax
import jax.numpy as jnp
import numpy as np

from bayessim_jax.effects.vehicle import SkidSteerVehicle
from bayessim_jax.systems import SkidSteer

ROBOT = SkidSteer.create(noise=0.0)
THETA = jnp.array([0.0625, 0.475, 0.2])


def drive(machine, commands, key=0):
    def step(state, command):
        after = machine.step(THETA, state, command)
        return after, machine.observe(THETA, after)

    return np.asarray(jax.lax.scan(step, machine.reset(jax.random.key(key), THETA), jnp.asarray(commands))[1])


def test_a_vehicle_without_faults_is_the_robot():
    sound = SkidSteerVehicle(ROBOT, limit=1e3, lag=0.0, firm=(0.0, 0.0), loose=(0.0, 0.0))
    commands = np.random.default_rng(0).uniform(-9, 9, (60, 2))
    np.testing.assert_allclose(drive(sound, commands), drive(ROBOT, commands), atol=1e-5)


def test_wheels_follow_as_an_exponential_up_to_the_limit():
    lagging = SkidSteerVehicle(ROBOT, limit=4.0, lag=0.2, firm=(0.0, 0.0), loose=(0.0, 0.0))
    state, wheels = lagging.reset(jax.random.key(0), THETA), []
    for _ in range(10):
        state = lagging.step(THETA, state, jnp.array([3.0, 50.0]))
        wheels.append(state.wheels)
    rise = 1 - np.exp(-0.05 * np.arange(1, 11) / 0.2)
    np.testing.assert_allclose(np.stack(wheels), rise[:, None] * [3.0, 4.0], rtol=1e-4)


def test_slip_depends_on_the_ground():
    def speed(border):
        machine = SkidSteerVehicle(ROBOT, lag=0.0, firm=(0.02, 0.05), loose=(0.1, 0.2), border=border)
        poses = drive(machine, np.full((20, 2), 4.0))
        return np.linalg.norm(np.diff(poses[:, :2], axis=0), axis=1) / 0.05

    np.testing.assert_allclose(speed(50.0), 0.98 * 0.25, rtol=1e-3)
    np.testing.assert_allclose(speed(-50.0), 0.9 * 0.25, rtol=1e-3)
