"""A system from any MuJoCo model: what is unknown in it, what is seen of it, and an engine that steps it."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from flax import struct
from jaxtyping import Array, ArrayLike, Float, PRNGKeyArray

from bayessim_jax.contracts import Box
from bayessim_jax.engines.choice import choose_engine
from bayessim_jax.engines.contract import Engine
from bayessim_jax.engines.fields import find_writes, merge_writes
from bayessim_jax.systems.channels import Channel, find_channels, observed_sensors, state_columns

__all__ = ["MjcfState", "MjcfSystem", "Unknown", "mjcf_system", "system_key"]


@dataclass(frozen=True)
class Unknown:
    """One parameter: its value is written to every target, such as `body/bob/mass` or `joint/hinge/damping`."""

    name: str
    targets: tuple[str, ...]
    low: float
    high: float
    unit: str = ""


@struct.dataclass
class MjcfState:
    """The engine's state, and the control that led to it."""

    physics: Any
    ctrl: Float[Array, " nu"]


@struct.dataclass
class MjcfSystem:
    """A MuJoCo model as a `System`; made by `mjcf_system`.

    Actions are `ctrl`, held for one control period of `substeps` time steps. `engine.name` and `reason` say what steps
    it. Effects act between: `advance` takes a generalized force on every degree of freedom, `positions` and
    `velocities` are what they look at, and `engine.model` is the compiled model.
    """

    parameters: Box
    actions: Box
    observations: Box
    noise: Float[Array, " obs"]
    qpos: Float[Array, " nq"]
    """Where episodes begin."""
    qvel: Float[Array, " nv"]
    scatter: Float[Array, " nv"]
    """Episodes begin with every degree of freedom moved by this times a uniform number in ±1, m or rad and per s."""
    dt: float = struct.field(pytree_node=False)
    substeps: int = struct.field(pytree_node=False)
    engine: Engine[Any] = struct.field(pytree_node=False)
    reason: str = struct.field(pytree_node=False)
    channels: tuple[Channel, ...] = struct.field(pytree_node=False)

    def reset(self, key: PRNGKeyArray, theta: Float[Array, " d"]) -> MjcfState:
        """The given initial state, scattered."""
        place, rate = jax.random.split(key)
        move = self.scatter * jax.random.uniform(place, self.scatter.shape, minval=-1.0, maxval=1.0)
        push = self.scatter * jax.random.uniform(rate, self.scatter.shape, minval=-1.0, maxval=1.0)
        return self.begin(theta, displace(self.engine.model, self.qpos, move), self.qvel + push)

    def begin(self, theta: Float[Array, " d"], qpos: Float[Array, " nq"], qvel: Float[Array, " nv"]) -> MjcfState:
        """The state with these positions and velocities, without a control."""
        return MjcfState(self.engine.init(theta, qpos, qvel), jnp.zeros(self.actions.size))

    def restart(self, theta: Float[Array, " d"], observation: Float[Array, " obs"]) -> MjcfState:
        """The state that shows this observation; raises `ValueError` where a position or velocity is not observed."""
        places, rates = (jnp.asarray(c) for c in state_columns(self.engine.model, self.channels))
        return self.begin(theta, observation[places], observation[rates])

    def step(self, theta: Float[Array, " d"], state: MjcfState, action: Float[Array, " act"]) -> MjcfState:
        """Advance by one control period."""
        return MjcfState(self.engine.step(theta, state.physics, action, None, self.substeps), action)

    def advance(
        self,
        theta: Float[Array, " d"],
        state: MjcfState,
        action: Float[Array, " act"],
        applied: Float[Array, " nv"] | None = None,
        steps: int = 1,
    ) -> MjcfState:
        """Advance by `steps` time steps of the model, with a generalized force on every degree of freedom."""
        return MjcfState(self.engine.step(theta, state.physics, action, applied, steps), action)

    def replay(self, theta: Float[Array, " d"], state: MjcfState, actions: Float[Array, "periods act"]) -> MjcfState:
        """The states after each control period under recorded actions, in one call of the engine."""
        return MjcfState(self.engine.replay(theta, state.physics, actions, None, self.substeps), actions)

    def observe(self, theta: Float[Array, " d"], state: MjcfState) -> Float[Array, " obs"]:
        """The channels in their order."""
        seen = {"qpos": self.positions(state), "qvel": self.velocities(state)}
        if any(c.source == "sensor" for c in self.channels):
            seen["sensor"] = self.engine.sensors(theta, state.physics, state.ctrl)
        return jnp.stack([seen[c.source][c.index] for c in self.channels])

    def positions(self, state: MjcfState) -> Float[Array, " nq"]:
        """`qpos`."""
        return self.engine.qpos(state.physics)

    def velocities(self, state: MjcfState) -> Float[Array, " nv"]:
        """`qvel`."""
        return self.engine.qvel(state.physics)


def system_key(system: Any) -> Hashable:
    """What is equal for systems that are the same: their numbers and what they are made of.

    Engines with a state of their own, and systems that are no pytree, are only the same as themselves.
    """
    leaves, structure = jax.tree.flatten(system)
    numbers = (jax.Array, np.ndarray, float, int)
    known = ((np.asarray(x).dtype.str, np.shape(x), np.asarray(x).tobytes()) for x in leaves if isinstance(x, numbers))
    return structure, tuple(known), tuple(_Itself(x) for x in leaves if not isinstance(x, numbers))


class _Itself:
    """What is only the same as itself, and in another process nothing (`programs.name_of`)."""

    __slots__ = ("value",)

    def __init__(self, value: Any) -> None:
        self.value = value

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Itself) and other.value is self.value

    def __hash__(self) -> int:
        return id(self.value)


def mjcf_system(
    model: str | Path | mujoco.MjSpec,
    parameters: Sequence[Unknown],
    *,
    observe: Sequence[str] | None = None,
    noise: float | Float[ArrayLike, " obs"] = 0.0,
    substeps: int = 1,
    qpos: Float[ArrayLike, " nq"] | None = None,
    qvel: Float[ArrayLike, " nv"] | None = None,
    scatter: float | Float[ArrayLike, " nv"] = 0.0,
    engine: str = "auto",
) -> MjcfSystem:
    """Make a system of a model: a path, the text of an MJCF file, or an `MjSpec`.

    `observe` names channels, `joint/<name>/qpos`, `joint/<name>/qvel` and `sensor/<name>`; without it all joints'
    positions and velocities are seen. Raises `ValueError` for what the model does not have.
    """
    spec = _read_spec(model)
    compiled = spec.compile()
    writes = merge_writes([find_writes(compiled, unknown.targets, k) for k, unknown in enumerate(parameters)])
    channels = find_channels(compiled, observe)
    choice = choose_engine(compiled, writes, engine, spec, observed_sensors(compiled, channels))
    return MjcfSystem(
        parameters=Box.create(**{p.name: (p.low, p.high, p.unit) for p in parameters}),
        actions=_control_box(compiled),
        observations=Box.create(**{c.name: (c.low, c.high, c.unit) for c in channels}),
        noise=_fill("noise", noise, len(channels)),
        qpos=_fill("qpos", compiled.qpos0 if qpos is None else qpos, compiled.nq),
        qvel=_fill("qvel", 0.0 if qvel is None else qvel, compiled.nv),
        scatter=_fill("scatter", scatter, compiled.nv),
        dt=substeps * float(compiled.opt.timestep),
        substeps=substeps,
        engine=choice.engine,
        reason=choice.reason,
        channels=channels,
    )


def _read_spec(model: str | Path | mujoco.MjSpec) -> mujoco.MjSpec:
    if isinstance(model, str) and model.lstrip().startswith("<"):
        return mujoco.MjSpec.from_string(model)
    if isinstance(model, (str, Path)):
        return mujoco.MjSpec.from_file(str(model))
    return model.copy()


def _control_box(model: mujoco.MjModel) -> Box:
    """Ranges of the controls; one without a range has ±1."""
    axes = {}
    for i in range(model.nu):
        low, high = model.actuator_ctrlrange[i] if model.actuator_ctrllimited[i] else (-1.0, 1.0)
        axes[model.actuator(i).name or f"actuator{i}"] = (float(low), float(high), "")
    return Box.create(**axes)


def _fill(name: str, values: Any, size: int) -> Float[Array, " n"]:
    values = jnp.asarray(np.asarray(values, float), float)
    if values.shape not in ((), (size,)):
        raise ValueError(f"{name} has shape {values.shape}; this model needs one number or {size}.")
    return jnp.broadcast_to(values, (size,))


def displace(model: mujoco.MjModel, qpos: Float[Array, " nq"], move: Float[Array, " nv"]) -> Float[Array, " nq"]:
    """Positions moved along every degree of freedom, a turn of a ball or free joint as a rotation vector."""
    pieces, free, ball = [], mujoco.mjtJoint.mjJNT_FREE, mujoco.mjtJoint.mjJNT_BALL
    for joint in range(model.njnt):
        q, v, kind = int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint]), model.jnt_type[joint]
        if kind == free:
            pieces += [qpos[q : q + 3] + move[v : v + 3], _turn(qpos[q + 3 : q + 7], move[v + 3 : v + 6])]
        elif kind == ball:
            pieces.append(_turn(qpos[q : q + 4], move[v : v + 3]))
        else:
            pieces.append(qpos[q : q + 1] + move[v : v + 1])
    return jnp.concatenate(pieces)


def _turn(quaternion: Float[Array, "4"], by: Float[Array, "3"]) -> Float[Array, "4"]:
    """The quaternion turned by a small rotation vector, to second order and normalized."""
    w, x, y, z = quaternion
    a, b, c = by / 2
    s = 1.0 - (a * a + b * b + c * c) / 2
    turned = jnp.stack(
        [
            w * s - x * a - y * b - z * c,
            w * a + x * s + y * c - z * b,
            w * b - x * c + y * s + z * a,
            w * c + x * b - y * a + z * s,
        ]
    )
    return turned / jnp.linalg.norm(turned)
