"""What effects are wired to in a MuJoCo model, what is kept of them from step to step, and what they see."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
from flax import struct

from bayessim_jax.contracts import Scalar
from bayessim_jax.effects.contract import Moment, Number, Numbers
from bayessim_jax.effects.drive import actuators_of, drive_of
from bayessim_jax.effects.places import Site
from bayessim_jax.effects.wiring import Wired
from bayessim_jax.engines.contract import Engine

__all__ = ["AugmentedState", "Grip", "Rig", "as_arrays"]


@struct.dataclass
class Grip:
    """What holding effects look back on at a joint: its last velocity, what held it, and what it feels."""

    velocity: Scalar
    held: Scalar
    inertia: Scalar


@struct.dataclass
class AugmentedState:
    """The simulator's state, what each effect remembers, the joints that effects look at, and the recording's time."""

    base: Any
    memories: tuple[Any, ...]
    grips: tuple[Grip, ...]
    time: Scalar

    def with_memories(self, later: Mapping[int, Any]) -> AugmentedState:
        """The state in which some effects, by their numbers, remember something else."""
        return replace(self, memories=tuple(later.get(k, memory) for k, memory in enumerate(self.memories)))


@dataclass(frozen=True)
class Rig:
    """An engine and the effects around it; nothing in it is traced."""

    engine: Engine[Any]
    """With the numbers that effects set as further parameters."""
    plain: mujoco.MjModel
    """The model without effects."""
    effects: tuple[Wired, ...]
    shares: tuple[tuple[int, float], ...]
    """Joints whose inertia effects look at, and what is left of it at the worst pose."""
    dt: float
    """One control period, s."""
    substeps: int
    """Time steps in it."""

    @property
    def model(self) -> mujoco.MjModel:
        """The engine's."""
        return self.engine.model

    @property
    def h(self) -> float:
        """One time step, s."""
        return float(self.model.opt.timestep)

    def at(self, port: str) -> list[tuple[int, Wired]]:
        """The effects of a port with their numbers."""
        return [(k, w) for k, w in enumerate(self.effects) if w.effect.port == port]

    @property
    def recalls(self) -> bool:
        """Whether an effect remembers how its joint has moved."""
        return any(w.effect.recalls for _, w in self.at("force"))

    def address(self, joint: int) -> tuple[int, int]:
        """Where a joint stands in qpos and qvel."""
        return int(self.model.jnt_qposadr[joint]), int(self.model.jnt_dofadr[joint])

    def motion(self, state: AugmentedState, joint: int) -> tuple[Scalar, Scalar]:
        """Position and velocity of a joint."""
        q, v = self.address(joint)
        return self.engine.qpos(state.base.physics)[q], self.engine.qvel(state.base.physics)[v]

    def see_joint(
        self,
        numbers: Numbers,
        state: AugmentedState,
        site: Site,
        commands: Sequence[Number],
        accelerations: Mapping[int, Number],
    ) -> Moment:
        """What an effect at a joint sees, and of another joint if it looks at one."""
        grips = dict(zip((joint for joint, _ in self.shares), state.grips, strict=True))

        def of(joint: int, actuators: list[int]) -> Moment:
            q, v = self.motion(state, joint)
            drive = drive_of(self.model, numbers, actuators, commands, q, v)
            inertia = grips[joint].inertia if joint in grips else 1.0
            return Moment(state.time, self.h, q, v, accelerations.get(joint, 0.0), inertia, drive)

        own = list(site.actuators) or actuators_of(self.model, site.joint)
        moment = of(site.joint, own)._replace(detail=site.detail)
        return moment if site.other < 0 else moment._replace(other=of(site.other, actuators_of(self.model, site.other)))

    def see_actuator(self, numbers: Numbers, state: AugmentedState, site: Site) -> Moment:
        """What an effect on an actuator's command sees."""
        if site.joint < 0:
            return Moment(state.time, self.h)
        actuator, (q, v) = site.actuators[0], self.motion(state, site.joint)
        gain = numbers("actuator_gear", actuator, 0) * numbers("actuator_gainprm", actuator, 0)
        inertias = {j: grip.inertia for (j, _), grip in zip(self.shares, state.grips, strict=True)}
        return Moment(state.time, self.h, q, v, inertia=inertias.get(site.joint, 1.0), gain=gain)

    def see_sensor(self, state: AugmentedState, site: Site) -> Moment:
        """What an effect on a reading sees, once a control period."""
        if site.joint < 0:
            return Moment(state.time, self.dt)
        return Moment(state.time, self.dt, *self.motion(state, site.joint))


def as_arrays(memory: Any, like: Scalar) -> Any:
    """A memory whose numbers are arrays of one kind."""
    return jax.tree.map(lambda x: jnp.asarray(x, like.dtype), memory)
