"""Hopper: a leg in the plane, the model and the task of Gymnasium's `Hopper-v5`, on Brax's physics or on MuJoCo's.

The model file is read where Brax or Gymnasium is installed: `pip install 'bayessim-jax[brax]'`.

Source: Freeman et al. 2021; Erez, Tassa and Todorov 2011
"""

from __future__ import annotations

import contextlib
import importlib
import importlib.util
import io
import warnings
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from bayessim_jax.contracts import Box, Discrete, Scalar
from bayessim_jax.systems import converged
from bayessim_jax.systems.mjcf import Unknown, mjcf_system

__all__ = ["PIPELINES", "Hop", "Hopper", "HopperState"]

PIPELINES = ("converged", "generalized", "positional", "spring", "mujoco")
"""Brax's dynamics with our contacts, Brax's own three with geoms grown by half of MuJoCo's margins, and MuJoCo's C
engine: the target's, as a reference."""
SUBSTEPS = 4
SCATTER = 5e-3
"""Episodes begin with every position and velocity moved by up to this, m and rad, and per s."""


@struct.dataclass
class HopperState:
    """x and z of the torso, its pitch and three angles, m and rad; their rates; and what the pipeline goes on from."""

    qpos: Float[Array, "6"]
    qvel: Float[Array, "6"]
    physics: Any


@struct.dataclass
class Hopper:
    """Torso, thigh, leg and foot with motors at three hinges, on a floor of sliding friction θ.

    MuJoCo takes the larger friction of two geoms that touch, and so does Brax: θ is that of foot and floor. What is
    seen is what the environment shows: height and pitch of the torso, three angles, and the rates of all, clipped to
    ±10, with the speed along x as the first rate. `pipeline` says what steps it: `converged` is Brax's generalized
    dynamics with the forces of contacts and stops solved to the end, and MuJoCo's integrator; `generalized`,
    `positional` and `spring` are Brax's own; `mujoco` is the C engine with the environment's model, and not
    differentiable.

    Source: Freeman et al. 2021
    """

    parameters: Box
    actions: Box | Discrete
    observations: Box
    noise: Float[Array, " obs"]
    dt: float = struct.field(pytree_node=False)
    pipeline: str = struct.field(pytree_node=False)

    @classmethod
    def create(
        cls, friction: tuple[float, float] = (0.1, 0.5), noise: float = 0.01, pipeline: str = PIPELINES[0]
    ) -> Hopper:
        """The paper's prior range, and sensor noise of the given standard deviation on every channel."""
        if pipeline not in PIPELINES:
            raise ValueError(f"pipeline {pipeline!r}: choose one of {', '.join(PIPELINES)}.")
        hinges, angle = ("thigh", "leg", "foot"), (-2.7, 0.1, "rad")
        return cls(
            parameters=Box.create(friction=(*friction, "")),
            actions=Box.create(**dict.fromkeys(hinges, (-1.0, 1.0, ""))),
            observations=Box.create(
                z=(0.7, 1.7, "m"),
                pitch=(-0.2, 0.2, "rad"),
                thigh=angle,
                leg=angle,
                foot=(-0.8, 0.8, "rad"),
                x_rate=(-3.0, 5.0, "m/s"),
                z_rate=(-4.0, 4.0, "m/s"),
                **{f"{name}_rate": (-10.0, 10.0, "rad/s") for name in ("pitch", *hinges)},
            ),
            noise=jnp.full(11, noise),
            dt=SUBSTEPS * float(_load().opt.timestep),
            pipeline=pipeline,
        )

    @property
    def model(self) -> Any:
        """The MuJoCo model of the same machine, for its shape."""
        return _load().mj_model

    def reset(self, key: PRNGKeyArray, theta: Float[Array, " d"]) -> HopperState:
        """Upright, every coordinate moved by up to 0.005."""
        move = SCATTER * jax.random.uniform(key, (12,), minval=-1.0, maxval=1.0)
        return self.begin(theta, move[:6].at[1].add(_load_rise()), move[6:])

    def begin(self, theta: Float[Array, " d"], qpos: Float[Array, "6"], qvel: Float[Array, "6"]) -> HopperState:
        """The state with these coordinates: x and z of the torso, its pitch, three angles, and their rates."""
        return HopperState(qpos, qvel, _stepper(self.pipeline).begin(theta, qpos, qvel))

    def step(self, theta: Float[Array, " d"], state: HopperState, action: Float[Array, " act"]) -> HopperState:
        """Advance by one control period of four time steps."""
        stepper = _stepper(self.pipeline)
        physics = stepper.step(theta, state.physics, jnp.clip(action, -1.0, 1.0))
        return HopperState(*stepper.show(physics), physics)

    def observe(self, theta: Float[Array, " d"], state: HopperState) -> Float[Array, " obs"]:
        """Everything but the way along x."""
        return jnp.concatenate([state.qpos[1:], jnp.clip(state.qvel, -10.0, 10.0)])


@struct.dataclass
class Hop:
    """Hop forward: speed along x, +1 for every step on which it is upright, −0.001 |u|²; ends where it falls.

    Upright: the torso higher than 0.7 m and pitched by less than 0.2 rad, everything else within ±100.

    Source: Erez, Tassa and Todorov 2011
    """

    steps: int = struct.field(pytree_node=False, default=1000)

    def reward(self, state: HopperState, action: Float[Array, " act"], next_state: HopperState) -> Scalar:
        """What Gymnasium's environment pays."""
        speed = (next_state.qpos[0] - state.qpos[0]) / (SUBSTEPS * float(_load().opt.timestep))
        return speed + ~self.terminated(next_state) - 1e-3 * jnp.sum(action**2)

    def terminated(self, state: HopperState) -> Bool[Array, ""]:
        """Fallen."""
        _, height, pitch, *_ = state.qpos
        rest = jnp.concatenate([state.qpos[2:], state.qvel])
        return ~((height > 0.7) & (jnp.abs(pitch) < 0.2) & (jnp.abs(rest) < 100.0).all())


class _Brax:
    """One of Brax's pipelines, or ours. Brax counts the height from where the torso stands upright."""

    def __init__(self, name: str) -> None:
        with _quiet():
            self.pipeline: Any = converged if name == "converged" else importlib.import_module(f"brax.{name}.pipeline")
        self.rise = np.array([0.0, _load_rise(), 0.0, 0.0, 0.0, 0.0], np.float32)

    def begin(self, theta: Array, qpos: Array, qvel: Array) -> Any:
        with _quiet():
            return self.pipeline.init(_with(theta), qpos - self.rise, qvel)

    def step(self, theta: Array, physics: Any, action: Array) -> Any:
        model = _with(theta)
        step = lambda physics, _: (self.pipeline.step(model, physics, action), None)  # noqa: E731
        with _quiet():
            return jax.lax.scan(step, physics, None, length=SUBSTEPS)[0]

    def show(self, physics: Any) -> tuple[Array, Array]:
        return physics.q + self.rise, physics.qd


class _Mujoco:
    """The environment's own model file on the C engine."""

    def __init__(self) -> None:
        path = Path(str(gymnasium.__file__)).parent / "envs" / "mujoco" / "assets" / "hopper.xml"
        geoms = ("floor", *(f"{link}_geom" for link in ("torso", "thigh", "leg", "foot")))
        friction = Unknown("friction", tuple(f"geom/{geom}/friction/0" for geom in geoms), 0.1, 0.5)
        self.engine = mjcf_system(path, [friction], engine="mujoco").engine

    def begin(self, theta: Array, qpos: Array, qvel: Array) -> Any:
        return self.engine.init(theta, qpos, qvel)

    def step(self, theta: Array, physics: Any, action: Array) -> Any:
        return self.engine.step(theta, physics, action, None, SUBSTEPS)

    def show(self, physics: Any) -> tuple[Array, Array]:
        return physics.qpos, physics.qvel


@cache
def _load() -> Any:
    """The model of Brax's own Hopper; `ValueError` in one line where Brax is not installed."""
    found = importlib.util.find_spec("brax")
    if found is None or found.origin is None:
        raise ValueError("Hopper needs Brax: pip install 'bayessim-jax[brax]' and try again.")
    with _quiet(), jax.ensure_compile_time_eval():
        mjcf: Any = importlib.import_module("brax.io.mjcf")
        model = mjcf.load(str(Path(found.origin).parent / "envs" / "assets" / "hopper.xml"))
        # MuJoCo's contacts act within a margin, Brax's where geoms overlap: floor, geom 0, and links grow by half of it
        data = mujoco.MjData(model.mj_model)
        data.qpos[1] = -0.2
        mujoco.mj_forward(model.mj_model, data)
        half = 0.5 * float(data.contact.includemargin.max())
        places, sizes = jnp.asarray(model.geom_pos), jnp.asarray(model.geom_size)
        return model.replace(geom_pos=places.at[0, 2].add(half), geom_size=sizes.at[1:, 0].add(half))


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Brax tells what it lacks and what is no longer maintained, when it is imported and when it is traced."""
    heard = io.StringIO()
    with contextlib.redirect_stdout(heard), contextlib.redirect_stderr(heard), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


def _load_rise() -> float:
    """Height of the torso at rest, m."""
    return float(_load().mj_model.body("torso").pos[2])


@cache
def _stepper(name: str) -> _Brax | _Mujoco:
    return _Mujoco() if name == "mujoco" else _Brax(name)


def _with(theta: Any) -> Any:
    """The model with a friction on every geom."""
    model = _load()
    return model.replace(geom_friction=jnp.asarray(model.geom_friction).at[:, 0].set(theta[0]))
