"""Fetch Push and Fetch Slide: an arm with a closed gripper moves an object on a table, as in gymnasium-robotics.

The model files are read where gymnasium-robotics is installed: `pip install 'bayessim-jax[fetch]'`.

Source: Plappert et al. 2018
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from bayessim_jax.contracts import Box, Discrete, Recording, Scalar
from bayessim_jax.engines.fields import Write
from bayessim_jax.engines.gymnasium import find_fetch_friction, require_robotics
from bayessim_jax.engines.mujoco import MujocoEngine, MujocoState

__all__ = ["Fetch", "FetchState", "MoveTo"]

SUBSTEPS = 20
REACH = 0.05
"""How far an action of 1 moves what the gripper is drawn to, m."""
THRESHOLD = 0.05
"""An object that is no farther than this from its goal has arrived, m."""
CLEARANCE = 0.1
"""Least distance of the object from the gripper in the beginning, m."""
CANDIDATES = 64
COLLIDING = ("base_link", "forearm_roll_link", "wrist_flex_link", "wrist_roll_link", "gripper_link")
"""Links whose meshes collide here: the base stands on the floor; those of others hardly ever come near anything."""
INPUTS = int(mujoco.mjtState.mjSTATE_MOCAP_POS) | int(mujoco.mjtState.mjSTATE_MOCAP_QUAT)
DOWN = (1.0, 0.0, 1.0, 0.0)
"""The quaternion that the gripper is drawn to, added to its own at every step."""
CHANNELS = {
    "grip": ((1.0, 1.6), (0.3, 1.2), (0.4, 0.8)),
    "object": ((0.7, 1.9), (0.3, 1.2), (0.4, 0.5)),
    "relative": ((-0.6, 0.6), (-0.6, 0.6), (-0.4, 0.1)),
    "finger": ((0.0, 0.05),) * 2,
    "turn": ((-3.2, 3.2),) * 3,
    "object_rate": ((-0.1, 0.1),) * 3,
    "turn_rate": ((-0.5, 0.5),) * 3,
    "grip_rate": ((-0.05, 0.05),) * 3,
    "finger_rate": ((-0.05, 0.05),) * 2,
    "goal": ((0.7, 1.9), (0.3, 1.2), (0.4, 0.5)),
}
"""What is seen, in its order, and where it lies as a rule."""


@dataclass(frozen=True)
class _Layout:
    """Where an environment puts things, in m."""

    file: str
    base: tuple[float, float, float]
    thing: tuple[float, float, float]
    height: float
    scatter: float
    spread: float
    ahead: float


_LAYOUTS = {
    "push": _Layout("push.xml", (0.405, 0.48, 0.0), (1.25, 0.53, 0.4), 0.0, 0.15, 0.15, 0.0),
    "slide": _Layout("slide.xml", (0.05, 0.48, 0.0), (1.7, 1.1, 0.41), -0.02, 0.1, 0.3, 0.4),
}


@struct.dataclass
class FetchState:
    """The engine's state, what its sensors show, and the goal of the episode, m."""

    physics: MujocoState
    hand: Float[Array, "13"]
    """Position and velocity of the point between the fingers; position and quaternion of the gripper."""
    goal: Float[Array, "3"]


@struct.dataclass
class Fetch:
    """Gripper and object in the world's frame, rates per control period of 40 ms, and the goal as the last channels.

    θ is the sliding friction between object and table. MuJoCo takes the larger friction of two geoms that touch, so θ
    is written to both: on a table of friction 1, an object's friction below 1 would have no effect. An action moves
    the target of the gripper by up to 5 cm along each axis; a weld draws the gripper after it for 20 time steps. The
    fourth action, the width of the gripper, has no effect, for it is held closed.

    Source: Plappert et al. 2018
    """

    parameters: Box
    actions: Box | Discrete
    observations: Box
    noise: Float[Array, " obs"]
    kind: str = struct.field(pytree_node=False)
    dt: float = struct.field(pytree_node=False)
    engine: MujocoEngine = struct.field(pytree_node=False)

    @classmethod
    def create(cls, kind: str, friction: tuple[float, float] = (0.1, 2.0), noise: float = 0.001) -> Fetch:
        """`kind` is push or slide; the sensors' noise is the same number on every channel but the goal's."""
        engine = _build(kind).engine
        seen = {
            f"{name}_{axis}": (*bounds, _unit(name))
            for name, axes in CHANNELS.items()
            for axis, bounds in zip(("x", "y", "z") if len(axes) == 3 else ("right", "left"), axes, strict=True)
        }
        return cls(
            parameters=Box.create(friction=(*friction, "")),
            actions=Box.create(**dict.fromkeys(("move_x", "move_y", "move_z", "width"), (-1.0, 1.0, ""))),
            observations=Box.create(**seen),
            noise=jnp.where(jnp.arange(len(seen)) < min(MoveTo().goal), noise, 0.0),
            kind=kind,
            dt=SUBSTEPS * float(engine.model.opt.timestep),
            engine=engine,
        )

    def reset(self, key: PRNGKeyArray, theta: Float[Array, " d"]) -> FetchState:
        """The arm at rest, the object somewhere around the gripper, a goal on the table."""
        rest, layout = _build(self.kind), _LAYOUTS[self.kind]
        place_key, goal_key = jax.random.split(key)
        tried = jax.random.uniform(place_key, (CANDIDATES, 2), minval=-layout.scatter, maxval=layout.scatter)
        offset = tried[jnp.argmax(jnp.linalg.norm(tried, axis=1) >= CLEARANCE)]
        centre = jnp.asarray(rest.centre, float)
        drawn = jax.random.uniform(goal_key, (2,), minval=-layout.spread, maxval=layout.spread)
        goal = centre + jnp.append(drawn + jnp.array([layout.ahead, 0.0]), 0.0)
        return self.begin(theta, centre[:2] + offset, goal)

    def begin(self, theta: Float[Array, " d"], place: Float[Array, "2"], goal: Float[Array, "3"]) -> FetchState:
        """The arm at rest, the object at x and y on the table, and a goal, m: where an episode begins."""
        rest = _build(self.kind)
        qpos = jnp.asarray(rest.qpos, float).at[rest.object : rest.object + 2].set(place)
        physics = self.engine.init(theta, qpos, jnp.asarray(rest.qvel, float))
        return FetchState(physics, jnp.asarray(rest.hand, float), goal)

    def step(self, theta: Float[Array, " d"], state: FetchState, action: Float[Array, " act"]) -> FetchState:
        """Advance by one control period, and close the fingers."""
        move = REACH * jnp.clip(action[:3], -1.0, 1.0)
        mocap = jnp.concatenate([state.hand[6:9] + move, state.hand[9:13] + jnp.array(DOWN)])
        physics, hand = self.engine.drive(theta, state.physics, mocap, SUBSTEPS)
        fingers = _build(self.kind).fingers
        return FetchState(self.engine.clear(physics, fingers), hand, state.goal)

    def observe(self, theta: Float[Array, " d"], state: FetchState) -> Float[Array, " obs"]:
        """Gripper, object, the object from the gripper, fingers, the object's turn, rates, and the goal."""
        rest, qpos, qvel = _build(self.kind), state.physics.qpos, state.physics.qvel
        place, quaternion = qpos[rest.object : rest.object + 3], qpos[rest.object + 3 : rest.object + 7]
        rate, spin = qvel[-6:-3], qvel[-3:]
        grip, grip_rate = state.hand[:3], state.hand[3:6]
        fingers = jnp.array(rest.fingers)
        rotation = _rotation(quaternion)
        shown = (
            grip,
            place,
            place - grip,
            qpos[fingers],
            _euler(rotation),
            self.dt * (rate - grip_rate),
            self.dt * (rotation @ spin),
            self.dt * grip_rate,
            self.dt * qvel[fingers],
            state.goal,
        )
        return jnp.concatenate(shown)

    @staticmethod
    def features(recording: Recording) -> Float[Array, "steps features"]:
        """What networks read of a transition, in axes that point from the gripper to the object, aside, and up.

        Where on the table things happen says nothing of θ, nor does the goal. Rates before and after, their change, the
        ways of object and gripper and their difference are shown as asinh(x / s) with s some times the sensors' noise:
        an object that comes to rest within millimetres tells of friction, and one that is flung away hides it.
        """
        before, after = recording.observations[:-1], recording.observations[1:]
        apart = before[:, 6:8]
        distance = jnp.sqrt(jnp.sum(apart**2, -1, keepdims=True) + 1e-6)
        cos, sin = jnp.moveaxis(apart / distance, -1, 0)

        def turned(v: Array) -> Array:
            return jnp.stack([cos * v[:, 0] + sin * v[:, 1], cos * v[:, 1] - sin * v[:, 0], v[:, 2]], -1)

        grip, later_grip = before[:, 20:23], after[:, 20:23]
        thing, later_thing = before[:, 14:17] + grip, after[:, 14:17] + later_grip
        way, grip_way = after[:, 3:6] - before[:, 3:6], after[:, :3] - before[:, :3]
        ways = (thing, later_thing, later_thing - thing, way, grip, later_grip, grip_way, way - grip_way)
        angle = after[:, 11:14] - before[:, 11:14]
        turns = (before[:, 17:20], after[:, 17:20], jnp.arctan2(jnp.sin(angle), jnp.cos(angle)))
        side = before[:, 13] - jnp.arctan2(sin, cos)
        tilt = jnp.sin(before[:, 11:13])
        columns = (
            distance,
            before[:, 8:9],
            turned(recording.actions[:, :3]),
            *(jnp.arcsinh(turned(v) / 0.004) for v in ways),
            *(jnp.arcsinh(turned(v) / 0.02) for v in turns),
            jnp.stack([jnp.cos(4.0 * side), jnp.sin(4.0 * side)], -1),
            turned(jnp.concatenate([tilt, before[:, 5:6] - before[:1, 5:6]], -1)),
        )
        return jnp.where(recording.valid[:, None], jnp.concatenate(columns, -1), 0.0)


@struct.dataclass
class MoveTo:
    """Bring the object to the goal: −1 for every step after which it is more than 5 cm away from it, else 0."""

    steps: int = struct.field(pytree_node=False, default=50)
    goal: tuple[int, ...] = struct.field(pytree_node=False, default=(25, 26, 27))
    achieved: tuple[int, ...] = struct.field(pytree_node=False, default=(3, 4, 5))

    def reward(self, state: FetchState, action: Float[Array, " act"], next_state: FetchState) -> Scalar:
        """What the place of the object is worth."""
        return self.pay(next_state.physics.qpos[-7:-4], next_state.goal)

    def terminated(self, state: FetchState) -> Bool[Array, ""]:
        """Never."""
        return jnp.zeros((), bool)

    def pay(self, achieved: Float[Array, "3"], goal: Float[Array, "3"]) -> Scalar:
        """−1 while the object is not there."""
        return -(jnp.sum((achieved - goal) ** 2) > THRESHOLD**2).astype(goal.dtype)


@dataclass(frozen=True)
class _Rest:
    """An engine, and the state that episodes begin from."""

    engine: MujocoEngine
    qpos: np.ndarray
    qvel: np.ndarray
    hand: np.ndarray
    centre: np.ndarray
    """Goals are drawn around it, at its height; objects are put around it."""
    object: int
    fingers: tuple[int, ...]


@cache
def _build(kind: str) -> _Rest:
    """Read and thin out a model, and let its arm come to rest above the table as the environment does."""
    layout = _LAYOUTS[kind]
    spec = mujoco.MjSpec.from_file(str(require_robotics() / "envs" / "assets" / "fetch" / layout.file))
    _thin_out(spec)
    _add_sensors(spec)
    model = spec.compile()
    model.eq_data[:, :7] = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
    data, joint = mujoco.MjData(model), lambda name: int(model.joint(name).qposadr[0])
    thing = joint("object0:joint")
    for axis, value in enumerate(layout.base):
        data.qpos[joint(f"robot0:slide{axis}")] = value
    data.qpos[thing : thing + 7] = (*layout.thing, 1.0, 0.0, 0.0, 0.0)
    mujoco.mj_forward(model, data)
    data.mocap_pos[0] = data.site("robot0:grip").xpos + np.array([-0.498, 0.005, -0.431 + layout.height])
    data.mocap_quat[0] = DOWN
    mujoco.mj_step(model, data, nstep=10 * SUBSTEPS)
    # the environment reads these two before it computes anything of the state that the last time step led to
    centre = np.array([*data.site("robot0:grip").xpos[:2], data.site("object0").xpos[2]])
    mujoco.mj_forward(model, data)
    writes = [Write("geom_friction", (geom, 0), 1.0, 0) for geom in find_fetch_friction(model)]
    engine = MujocoEngine(model, writes, inputs=INPUTS)
    fingers = tuple(joint(f"robot0:{side}_gripper_finger_joint") for side in "rl")
    return _Rest(engine, data.qpos.copy(), data.qvel.copy(), data.sensordata.copy(), centre, thing, fingers)


def _thin_out(spec: mujoco.MjSpec) -> None:
    """Leave out the meshes that collide with nothing, and pictures: a model for each θ is several megabytes else."""
    kept = {f"robot0:{name}" for name in COLLIDING}
    for geom in list(spec.geoms):
        if geom.type == mujoco.mjtGeom.mjGEOM_MESH and geom.name not in kept:
            spec.delete(geom)
    used = {geom.meshname for geom in spec.geoms}
    for mesh in [mesh for mesh in spec.meshes if mesh.name not in used]:
        spec.delete(mesh)
    for geom in spec.geoms:
        geom.material = ""
    for unseen in [*spec.materials, *spec.textures]:
        spec.delete(unseen)


def _add_sensors(spec: mujoco.MjSpec) -> None:
    place, rate, turn = (getattr(mujoco.mjtSensor, f"mjSENS_FRAME{w}") for w in ("POS", "LINVEL", "QUAT"))
    site, body = mujoco.mjtObj.mjOBJ_SITE, mujoco.mjtObj.mjOBJ_XBODY
    grip, link = "robot0:grip", "robot0:gripper_link"
    for kind, holder, name in ((place, site, grip), (rate, site, grip), (place, body, link), (turn, body, link)):
        spec.add_sensor(type=kind, objtype=holder, objname=name)


def _unit(name: str) -> str:
    kind = "rad" if name.startswith("turn") else "m"
    return f"{kind}/step" if name.endswith("rate") else kind


def _rotation(quaternion: Any) -> Any:
    """The matrix of a quaternion (w, x, y, z)."""
    w, x, y, z = quaternion / jnp.linalg.norm(quaternion)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return jnp.stack([jnp.stack(row) for row in rows])


def _euler(r: Any) -> Any:
    """Angles (a, b, c) with R = Rx(a) Ry(b) Rz(c), rad; a is 0 where only its sum with c is known."""
    cos = jnp.hypot(r[2, 2], r[1, 2])
    free = cos > 1e-6
    a = jnp.where(free, -jnp.arctan2(r[1, 2], r[2, 2]), 0.0)
    c = jnp.where(free, -jnp.arctan2(r[0, 1], r[0, 0]), jnp.arctan2(r[1, 0], r[1, 1]))
    return jnp.stack([a, jnp.arctan2(r[0, 2], cos), c])
