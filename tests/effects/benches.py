"""Small machines on which effects are tried, and how to run them."""

import jax
import jax.numpy as jnp
import numpy as np

from bayessim_jax.effects import EFFECTS, Scales, recorded_scales, with_effects
from bayessim_jax.systems.mjcf import Unknown, mjcf_system

BODY = '<body name="{name}" pos="{pos}"><joint name="{joint}" {how}/><inertial {inertial}/>{inner}</body>'
ROD = 'pos="0 0 -0.3" mass="0.5" diaginertia="0.002 0.002 0.001"'


def mjcf(body, actuator, timestep=0.002, gravity="0 0 -9.81"):
    option = f'<compiler angle="radian"/><option timestep="{timestep}" gravity="{gravity}"/>'
    return f"<mujoco>{option}<worldbody>{body}</worldbody><actuator>{actuator}</actuator></mujoco>"


def part(name, joint, how='axis="0 1 0"', inertial=ROD, inner="", pos="0 0 0"):
    return BODY.format(name=name, joint=joint, how=how, inertial=inertial, inner=inner, pos=pos)


MOTOR = '<motor name="m" joint="hinge"/>'
CART = part("cart", "rail", 'type="slide" axis="1 0 0"', 'pos="0 0 0" mass="2" diaginertia="0.1 0.1 0.1"')


def pendulum(timestep=0.002):
    return mjcf(part("bob", "hinge"), MOTOR, timestep)


def cart(timestep=0.002, gravity="0 0 -9.81"):
    return mjcf(CART, '<motor name="m" joint="rail"/>', timestep, gravity)


def arm(timestep=0.002):
    body = part("upper", "shoulder", inner=part("lower", "elbow", pos="0 0 -0.5"))
    motors = '<motor name="m0" joint="shoulder"/><motor name="m1" joint="elbow"/>'
    return mjcf(body, motors, timestep)


def system(xml, body, engine="tree", period=0.01):
    """θ is the mass of one body."""
    timestep = float(xml.split('timestep="')[1].split('"')[0])
    unknown = Unknown("mass", (f"body/{body}/mass",), 0.1, 4.0, "kg")
    return mjcf_system(xml, [unknown], substeps=round(period / timestep), engine=engine)


def run(base, effects, values, actions, qpos, qvel, theta=0.5, scales=None, **begin):
    """What is observed after each control period, of joints in order: positions, then velocities."""
    pairs = [(EFFECTS.get(effect, effect), place) for effect, place in effects]
    augmented = with_effects(base, pairs, scales or Scales())
    parameters = jnp.array([theta, *values], float)
    return simulate(augmented, actions, qpos, qvel, **begin)(parameters)


def simulate(augmented, actions, qpos, qvel, **begin):
    actions = jnp.asarray(actions, float).reshape(len(actions), -1)
    qpos, qvel = jnp.atleast_1d(jnp.asarray(qpos, float)), jnp.atleast_1d(jnp.asarray(qvel, float))

    @jax.jit
    def observed(theta):
        state = augmented.begin(theta, qpos, qvel, actions[0], **begin)
        return jax.vmap(lambda s: augmented.observe(theta, s))(augmented.replay(theta, state, actions))

    return observed


def scales_of(base, place, steps=120, force=1.0):
    """The scales of a place in a swing under a chirp."""
    time = base.dt * np.arange(steps)
    actions = force * np.sin(2 * np.pi * (0.5 + time) * time)[:, None] * np.ones(base.actions.size)
    theta = jnp.full(base.parameters.size, 0.5)
    begin = base.begin(theta, jnp.full(base.engine.model.nq, 0.3), jnp.full(base.engine.model.nv, -0.5))
    states = jax.jit(base.replay)(theta, begin, jnp.asarray(actions, float))
    qpos, qvel = (np.asarray(jax.vmap(f)(states)) for f in (base.positions, base.velocities))
    return recorded_scales(base.engine.model, place, qpos, qvel, actions, base.dt, steps * base.dt)


def chirp(steps, period=0.01, force=1.0, actuators=1):
    time = period * np.arange(steps)
    return force * np.sin(2 * np.pi * (0.5 + time) * time)[:, None] * np.ones(actuators)
