"""A MuJoCo model with effects: they act at every time step of the model, between its engine's steps."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cached_property, partial
from itertools import pairwise
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float, PRNGKeyArray

from bayessim_jax.contracts import Box, Scalar
from bayessim_jax.effects.commands import (
    NONE,
    Actions,
    begin_commands,
    early_effects,
    is_free,
    pass_commands,
    pass_early,
    warm_up,
)
from bayessim_jax.effects.contract import Numbers
from bayessim_jax.effects.drive import read_numbers
from bayessim_jax.effects.forces import add_forces, begin_joints, recall_motion
from bayessim_jax.effects.readings import begin_late, distort, restore, restore_motion, sensors, track
from bayessim_jax.effects.rig import AugmentedState, Grip, Rig
from bayessim_jax.effects.wiring import Wired, edit_model
from bayessim_jax.engines.contract import Engine
from bayessim_jax.systems.channels import Channel, state_columns
from bayessim_jax.systems.mjcf import MjcfState, MjcfSystem

__all__ = ["AugmentedMjcf"]


@struct.dataclass
class AugmentedMjcf:
    """An `MjcfSystem` with effects; made by `with_effects`. θ' = [θ, the effects' parameters in their order].

    States begin as they were measured: an effect of a sensor is taken back out of the positions and velocities given
    to `begin`.
    """

    parameters: Box
    base: MjcfSystem
    engine: Engine[Any] = struct.field(pytree_node=False)
    """The engine with the numbers that effects set as further parameters."""
    effects: tuple[Wired, ...] = struct.field(pytree_node=False)
    shares: tuple[tuple[int, float], ...] = struct.field(pytree_node=False)
    """Joints whose inertia effects look at, and what is left of it at the worst pose."""

    @property
    def actions(self) -> Box:
        """Commands, before the actuators' effects."""
        return self.base.actions

    @property
    def observations(self) -> Box:
        """Those of the system without effects."""
        return self.base.observations

    @property
    def noise(self) -> Float[Array, " obs"]:
        """That of the system without effects."""
        return self.base.noise

    @property
    def dt(self) -> float:
        """One control period, s."""
        return self.base.dt

    @property
    def substeps(self) -> int:
        """Time steps in a control period."""
        return self.base.substeps

    @property
    def channels(self) -> tuple[Channel, ...]:
        """What is observed."""
        return self.base.channels

    @property
    def reason(self) -> str:
        """Why this engine was taken."""
        return self.base.reason

    @cached_property
    def _rig(self) -> Rig:
        model = self.base.engine.model
        return Rig(self.engine, model, self.effects, self.shares, self.dt, self.substeps)

    def reset(self, key: PRNGKeyArray, theta: Float[Array, " d"]) -> AugmentedState:
        """An initial state of the system without effects, as its sensors would show it."""
        state = self.base.reset(key, theta[: self.base.parameters.size])
        return self.begin(theta, self.base.positions(state), self.base.velocities(state))

    def begin(
        self,
        theta: Float[Array, " d"],
        qpos: Float[Array, " nq"],
        qvel: Float[Array, " nv"],
        action: Float[Array, " act"] | None = None,
        time: Scalar | float = 0.0,
        past: Actions | None = None,
        motion: tuple[Float[Array, "periods nq"], Float[Array, "periods nv"]] | None = None,
        moves: Float[Array, " m"] | None = None,
    ) -> AugmentedState:
        """The state with these measured positions and velocities, `time` seconds into a recording.

        `action` is the command of the first control period, without it zero; `past` are those before it, one row for
        each control period, the most recent last, without them as if the first had always been held. `motion` are
        positions and velocities of as many control periods, for effects that remember how a joint has moved. `moves`
        are how far the effects that do not settle had moved from what they are taken to remember before that.
        """
        kind = jnp.result_type(theta)
        qpos, qvel = (jnp.asarray(x, kind) for x in (qpos, qvel))
        first = jnp.zeros(self.actions.size, kind) if action is None else jnp.asarray(action, kind)
        time = jnp.asarray(time, kind)
        rig, names = self._rig, [c.name for c in self.channels]
        late = [w for _, w in sensors(rig) if w.effect.remembers]
        bent = [w for _, w in sensors(rig) if not w.effect.remembers]
        still = jnp.zeros_like(qvel)
        qpos, qvel = restore(rig, bent, theta, names, qpos, qvel, time, still, still)
        if motion is not None and rig.recalls:
            motion = restore_motion(rig, theta, names, *motion, time)
        start = partial(self._start, theta, action=first, time=time, past=past, motion=motion, moves=moves)
        if not late:
            return start(qpos, qvel)
        curve = self._curve(theta, begin_late(rig, theta, start(qpos, qvel), still, still), first)
        true = restore(rig, late, theta, names, qpos, qvel, time, *curve)
        return begin_late(rig, theta, start(*true), *curve)

    def _start(
        self,
        theta: Float[Array, " d"],
        qpos: Float[Array, " nq"],
        qvel: Float[Array, " nv"],
        action: Float[Array, " act"],
        time: Scalar,
        past: Actions | None,
        motion: tuple[Float[Array, "periods nq"], Float[Array, "periods nv"]] | None,
        moves: Float[Array, " m"] | None,
    ) -> AugmentedState:
        """The state with these true positions and velocities."""
        kind, rig = jnp.result_type(theta), self._rig
        numbers, inner = self._prepare(theta)
        held = action if past is None or not len(past) else jnp.asarray(past[0], kind)
        physics = self.engine.init(inner, qpos, qvel)
        at_rest = jax.lax.stop_gradient(inner)
        inertias = {
            joint: share * self.engine.inertia(at_rest, self.base.qpos, rig.address(joint)[1])
            for joint, share in self.shares
        }
        grips = tuple(Grip(qvel[rig.address(j)[1]], jnp.zeros((), kind), m) for j, m in inertias.items())
        state = AugmentedState(MjcfState(physics, action), (), grips, time)
        state = begin_commands(rig, theta, numbers, state, held)
        if past is not None and len(past):
            state = warm_up(rig, theta, numbers, state, jnp.asarray(past, kind))
        commands, _ = pass_commands(rig, theta, numbers, state, action)
        state = begin_joints(rig, theta, numbers, inner, state, commands)
        if motion is None or not len(motion[0]):
            return state
        commanded = jnp.broadcast_to(action, (len(motion[0]), action.size)) if past is None else jnp.asarray(past, kind)
        return recall_motion(rig, theta, numbers, state, *motion, commanded, moves)

    def restart(self, theta: Float[Array, " d"], observation: Float[Array, " obs"]) -> AugmentedState:
        """The state that shows this observation, as if nothing had been commanded for long.

        Raises `ValueError` where a position or velocity is not observed.
        """
        places, rates = (jnp.asarray(c) for c in state_columns(self.engine.model, self.channels))
        return self.begin(theta, observation[places], observation[rates])

    def step(self, theta: Float[Array, " d"], state: AugmentedState, action: Float[Array, " act"]) -> AugmentedState:
        """Advance by one control period."""
        return self._period(theta, *self._prepare(theta))(state, action)

    def replay(self, theta: Float[Array, " d"], state: AugmentedState, actions: Actions) -> AugmentedState:
        """The states after each control period under recorded actions; a leading axis on every leaf."""
        (numbers, inner), rig = self._prepare(theta), self._rig
        early = early_effects(rig)
        if not early and is_free(rig, early):
            physics = self.engine.replay(inner, state.base.physics, actions, None, self.substeps)
            return self._later(state, actions, physics)
        rows, memories = pass_early(rig, theta, numbers, state, actions, early) if early else (None, {})
        if rows is not None and is_free(rig, early):
            return self._replay_rows(inner, state, actions, rows, memories)
        period = self._period(theta, numbers, inner, early)

        def once(state: AugmentedState, now: Any) -> tuple[AugmentedState, AugmentedState]:
            action, rows, memories = now
            after = period(state, action, rows)
            return after, after.with_memories(memories)

        return jax.lax.scan(once, state, (actions, rows, memories))[1]

    def observe(self, theta: Float[Array, " d"], state: AugmentedState) -> Float[Array, " obs"]:
        """The channels in their order, as the sensors' effects show them."""
        _, inner = self._prepare(theta)
        seen = replace(self.base, engine=self.engine).observe(inner, state.base)
        return distort(self._rig, theta, state, seen, [c.name for c in self.channels])

    def positions(self, state: AugmentedState) -> Float[Array, " nq"]:
        """`qpos`, as it is."""
        return self.engine.qpos(state.base.physics)

    def velocities(self, state: AugmentedState) -> Float[Array, " nv"]:
        """`qvel`, as it is."""
        return self.engine.qvel(state.base.physics)

    def _prepare(self, theta: Float[Array, " d"]) -> tuple[Numbers, Float[Array, " e"]]:
        """The model's numbers as the engine has them, and the engine's θ."""
        edits = [w for _, w in self._rig.at("model")]
        size = self.base.parameters.size
        inner = edit_model(self.engine.model, self.base.engine.writes, edits, theta, size)
        return read_numbers(self.engine.model, self.engine.writes, inner), inner

    def _period(
        self, theta: Float[Array, " d"], numbers: Numbers, inner: Float[Array, " e"], early: frozenset[int] = NONE
    ) -> Callable[..., AugmentedState]:
        """One control period; commands that have passed the `early` effects come as rows, one for each time step."""

        def period(
            state: AugmentedState, action: Float[Array, " act"], rows: Float[Array, "steps act"] | None = None
        ) -> AugmentedState:
            if all(w.effect.port in ("model", "sense") for w in self.effects):
                physics = self.engine.step(inner, state.base.physics, action, None, self.substeps)
                after = replace(state, base=MjcfState(physics, action), time=state.time + self.dt)
            elif self.substeps == 1:
                after = self._tick(theta, numbers, inner, state, action if rows is None else rows[0], early)
            else:

                def once(s: AugmentedState, row: Float[Array, " act"] | None) -> tuple[AugmentedState, None]:
                    return self._tick(theta, numbers, inner, s, action if row is None else row, early), None

                after = jax.lax.scan(once, state, rows, length=self.substeps)[0]
            return track(self._rig, theta, replace(after, base=replace(after.base, ctrl=action)))

        return period

    def _tick(
        self,
        theta: Float[Array, " d"],
        numbers: Numbers,
        inner: Float[Array, " e"],
        state: AugmentedState,
        action: Float[Array, " act"],
        early: frozenset[int],
    ) -> AugmentedState:
        """One time step of the model."""
        rig = self._rig
        commands, memories = pass_commands(rig, theta, numbers, state, action, early)
        forces, grips, memories = add_forces(rig, theta, numbers, state, commands, memories)
        ctrl = jnp.stack(commands) if rig.at("act") else action
        physics = self.engine.step(inner, state.base.physics, ctrl, forces, 1)
        return AugmentedState(replace(state.base, physics=physics), tuple(memories), grips, state.time + rig.h)

    def _curve(
        self, theta: Float[Array, " d"], state: AugmentedState, action: Float[Array, " act"]
    ) -> tuple[Float[Array, " nv"], Float[Array, " nv"]]:
        """Accelerations under all effects, and how they change, from two control periods."""
        period = self._period(theta, *self._prepare(theta))
        states = [state]
        for _ in range(2):
            states.append(period(states[-1], action))
        now, then = ((self.velocities(after) - self.velocities(before)) / self.dt for before, after in pairwise(states))
        jerk = (then - now) / self.dt
        return now - 0.5 * self.dt * jerk, jerk

    def _replay_rows(
        self,
        inner: Float[Array, " e"],
        state: AugmentedState,
        actions: Actions,
        rows: Float[Array, "periods steps act"],
        memories: dict[int, Any],
    ) -> AugmentedState:
        """Known commands at each time step."""
        flat = rows.reshape(-1, self.actions.size)
        physics = self.engine.replay(inner, state.base.physics, flat, None, 1)
        ends = jax.tree.map(lambda x: x[self.substeps - 1 :: self.substeps], physics)
        return self._later(state, actions, ends).with_memories(memories)

    def _later(self, state: AugmentedState, actions: Actions, physics: Any) -> AugmentedState:
        """States at the ends of control periods between which nothing but the engine was at work."""
        count = len(actions)
        times = state.time + self.dt * jnp.arange(1, count + 1, dtype=state.time.dtype)
        spread = jax.tree.map(lambda x: jnp.broadcast_to(x, (count, *x.shape)), state)
        return replace(spread, base=MjcfState(physics, actions), time=times)
