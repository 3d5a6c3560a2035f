"""The skid-steer robot against what geometry says of it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayessim_jax.contracts import Recording
from bayessim_jax.systems import FollowCircle, SkidSteer

ROBOT = SkidSteer.create(noise=0.0)
THETAS = [(0.0625, 0.475, 0.2), (0.3, 1.08, -0.4), (0.05, 0.4, 0.0)]


def drive(theta, start, commands, robot=ROBOT):
    """Poses from a start, one for each command and the start itself."""

    def step(state, command):
        after = robot.step(theta, state, command)
        return after, robot.observe(theta, after)

    theta, start = jnp.asarray(theta), jnp.asarray(start)
    _, poses = jax.lax.scan(step, robot.restart(theta, start), jnp.asarray(commands))
    return np.concatenate([start[None], poses])


def turned(poses, body):
    """Points fixed to the body, in the world."""
    cos, sin = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    return poses[:, :2] + np.stack([cos * body[0] - sin * body[1], sin * body[0] + cos * body[1]], -1)


@pytest.mark.parametrize("theta", THETAS)
def test_equal_speeds_go_straight(theta):
    poses = drive(theta, [0.1, -0.2, 0.7], np.full((40, 2), 5.0))
    way = theta[0] * 5.0 * 0.05 * np.arange(41)
    expected = np.stack([0.1 + way * np.cos(0.7), -0.2 + way * np.sin(0.7), np.full(41, 0.7)], -1)
    np.testing.assert_allclose(poses, expected, atol=1e-5)


@pytest.mark.parametrize("theta", THETAS)
@pytest.mark.parametrize("command", [(3.0, 5.0), (6.0, -2.0), (-4.0, -1.0)])
def test_other_speeds_turn_around_the_instant_centre_of_rotation(theta, command):
    """It lies x_ICR ahead and v/ψ̇ to the left, and stays where it is: the path is a circle around it."""
    radius, distance, offset = theta
    left, right = command
    speed, rate = radius * (right + left) / 2, radius * (right - left) / distance
    poses = drive(theta, [0.3, 0.4, -0.5], np.tile(command, (60, 1)))
    np.testing.assert_allclose(np.diff(poses[:, 2]), rate * 0.05, atol=1e-5)
    centre = turned(poses, (offset, speed / rate))
    np.testing.assert_allclose(centre, np.tile(centre[0], (61, 1)), atol=1e-5)
    turning = np.linalg.norm(poses[:, :2] - centre[0], axis=1)
    np.testing.assert_allclose(turning, np.hypot(speed / rate, offset), rtol=1e-4)


def test_a_turn_on_the_spot_slides_the_robot_sideways():
    """Opposite speeds turn it around a point x_ICR ahead: after half a turn it stands twice that far away."""
    theta = (0.0625, 0.5, 0.2)
    rate = 0.0625 * 2 * 4.0 / 0.5
    steps = 40
    dt = np.pi / rate / steps
    poses = drive(theta, [0.0, 0.0, 0.0], np.tile([-4.0, 4.0], (steps, 1)), ROBOT.replace(dt=dt))
    np.testing.assert_allclose(poses[-1], [0.4, 0.0, np.pi], atol=1e-5)
    first = poses[1] / dt
    assert first[1] == pytest.approx(-0.2 * rate, rel=0.01)


def test_one_period_is_two_of_half_the_length():
    commands = jax.random.uniform(jax.random.key(0), (30, 2), minval=-10.0, maxval=10.0)
    whole = drive(THETAS[0], [0.0, 0.0, 0.0], commands)
    halves = drive(THETAS[0], [0.0, 0.0, 0.0], np.repeat(commands, 2, 0), ROBOT.replace(dt=0.025))
    np.testing.assert_allclose(whole, halves[::2], atol=1e-5)


def test_a_simulation_restarts_at_any_row_of_a_recording():
    commands = jax.random.uniform(jax.random.key(1), (30, 2), minval=-10.0, maxval=10.0)
    poses = drive(THETAS[0], [0.5, 0.1, 2.0], commands)
    np.testing.assert_allclose(drive(THETAS[0], poses[11], commands[11:]), poses[11:], atol=1e-5)
    seen = ROBOT.observe(jnp.asarray(THETAS[0]), ROBOT.restart(jnp.asarray(THETAS[0]), poses[11]))
    np.testing.assert_array_equal(seen, poses[11])


def test_theta_is_traced_and_differentiated():
    traces = []

    @jax.jit
    def end(theta, commands):
        traces.append(1)
        _, poses = jax.lax.scan(
            lambda state, command: (ROBOT.step(theta, state, command),) * 2,
            ROBOT.restart(theta, jnp.zeros(3)),
            commands,
        )
        return jnp.stack([poses.x[-1], poses.y[-1], poses.yaw[-1]])

    straight, turn = jnp.full((20, 2), 4.0), jnp.tile(jnp.array([3.0, 5.0]), (20, 1))
    ends = [end(jnp.asarray(theta), turn) for theta in THETAS]
    assert len(traces) == 1
    assert not np.allclose(ends[0], ends[1])
    slopes = jax.jacfwd(end)(jnp.asarray(THETAS[0]), straight)
    np.testing.assert_allclose(slopes, [[4.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]], atol=1e-5)
    slopes = jax.jacfwd(end)(jnp.asarray(THETAS[0]), turn)
    assert np.abs(slopes[1, 2]) > 0.01


def test_the_circle_costs_nothing_on_it_at_its_speed():
    task, theta = FollowCircle(), jnp.array([0.0625, 0.475, 0.0])
    rate = 0.2 / 0.75
    wheels = jnp.array([0.2 - rate * 0.475 / 2, 0.2 + rate * 0.475 / 2]) / 0.0625
    assert ROBOT.actions.contains(wheels)
    state, costs = ROBOT.restart(theta, jnp.zeros(3)), []
    for _ in range(task.steps):
        after = ROBOT.step(theta, state, wheels)
        costs.append(-task.reward(state, wheels, after))
        state = after
    assert max(costs) < 1e-3
    assert state.yaw > 2 * jnp.pi
    assert not task.terminated(state)


def test_the_cost_is_the_papers():
    task, theta, still = FollowCircle(), jnp.asarray(THETAS[0]), jnp.zeros(2)
    for pose, distance in (([0.0, 0.0, 0.0], 0.0), ([0.0, 0.75, 1.0], 0.75), ([1.0, 0.75, 0.0], 0.25)):
        state = ROBOT.restart(theta, jnp.array(pose))
        reward = task.reward(state, still, ROBOT.step(theta, state, still))
        assert reward == pytest.approx(-np.hypot(distance, 0.2), abs=1e-6)


def test_features_are_theta_wherever_the_robot_is_and_whichever_way_it_faces():
    """Without noise least squares find θ; they are zero where a transition did not happen."""
    commands = np.array(jax.random.uniform(jax.random.key(2), (60, 2), minval=jnp.array([-8.0, -6.0]), maxval=14.0))
    valid = jnp.arange(60) < 50
    for theta in THETAS:
        for start in ([0.0, 0.0, 0.0], [3.0, -1.0, 2.5]):
            poses = jnp.asarray(drive(theta, start, commands))
            times = 0.05 * jnp.arange(61)
            rows = ROBOT.features(Recording(times, poses, commands, jnp.zeros(60), valid, jnp.array(False)))
            found = np.concatenate([np.exp(rows[49, :2]), rows[49, 2:]])
            np.testing.assert_allclose(found, theta, rtol=0.03, atol=0.003)
            np.testing.assert_array_equal(rows[50:], 0.0)
