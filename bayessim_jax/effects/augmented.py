"""A MuJoCo model with effects: they act at every time step of the model, between its engine's steps."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import pairwise
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float, PRNGKeyArray

from bayessim_jax.contracts import Box, Scalar
from bayessim_jax.effects.contract import Moment, Number, Numbers
from bayessim_jax.effects.drive import (
    CAUTION,
    actuators_of,
    drive_of,
    probe_inertia,
    read_numbers,
)
from bayessim_jax.effects.history import split_history
from bayessim_jax.effects.places import Site
from bayessim_jax.effects.wiring import Wired, edit_model
from bayessim_jax.engines.contract import Engine
from bayessim_jax.systems.channels import Channel, state_columns
from bayessim_jax.systems.mjcf import MjcfState, MjcfSystem

__all__ = ["AugmentedMjcf", "AugmentedState", "Grip"]

Actions = Float[Array, "periods act"]
NONE: frozenset[int] = frozenset()


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
    ) -> AugmentedState:
        """The state with these measured positions and velocities, `time` seconds into a recording.

        `action` is the command of the first control period, without it zero; `past` are those before it, one row for
        each control period, the most recent last, without them as if the first had always been held. `motion` are
        positions and velocities of as many control periods, for effects that remember how a joint has moved.
        """
        kind = jnp.result_type(theta)
        qpos, qvel = (jnp.asarray(x, kind) for x in (qpos, qvel))
        first = jnp.zeros(self.actions.size, kind) if action is None else jnp.asarray(action, kind)
        time = jnp.asarray(time, kind)
        late = [w for _, w in self._senses() if w.effect.remembers]
        bent = [w for _, w in self._senses() if not w.effect.remembers]
        still = jnp.zeros_like(qvel)
        qpos, qvel = self._restore(bent, theta, qpos, qvel, time, still, still)
        start = partial(self._start, theta, action=first, time=time, past=past, motion=motion)
        if not late:
            return start(qpos, qvel)
        seen = self._begin_late(theta, start(qpos, qvel), still, still)
        curve = self._curve(theta, seen, first)
        return self._begin_late(theta, start(*self._restore(late, theta, qpos, qvel, time, *curve)), *curve)

    def _start(
        self,
        theta: Float[Array, " d"],
        qpos: Float[Array, " nq"],
        qvel: Float[Array, " nv"],
        action: Float[Array, " act"],
        time: Scalar,
        past: Actions | None,
        motion: tuple[Float[Array, "periods nq"], Float[Array, "periods nv"]] | None,
    ) -> AugmentedState:
        """The state with these true positions and velocities."""
        kind, first = jnp.result_type(theta), action
        numbers, inner = self._prepare(theta)
        held = first if past is None or not len(past) else jnp.asarray(past[0], kind)
        physics = self.engine.init(inner, qpos, qvel)
        inertias = {
            joint: share * probe_inertia(self.engine, inner, self.base.qpos.astype(kind), self._dof(joint))
            for joint, share in self.shares
        }
        grips = tuple(Grip(qvel[self._dof(j)], jnp.zeros((), kind), m) for j, m in inertias.items())
        state = AugmentedState(MjcfState(physics, first), (), grips, time)
        state = self._begin_commands(theta, numbers, state, held)
        if past is not None and len(past):
            state = self._warm(theta, numbers, state, jnp.asarray(past, kind))
        commands, _ = self._commands(theta, numbers, state, first)
        state = self._begin_joints(theta, numbers, inner, state, commands)
        if motion is None or not len(motion[0]):
            return state
        commanded = jnp.broadcast_to(first, (len(motion[0]), first.size)) if past is None else jnp.asarray(past, kind)
        return self._recall(theta, numbers, state, *motion, commanded)

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
        numbers, inner = self._prepare(theta)
        early = self._early()
        if not early and self._only(early):
            physics = self.engine.replay(inner, state.base.physics, actions, None, self.substeps)
            return self._later(state, actions, physics)
        rows, memories = self._pass_early(theta, numbers, state, actions, early) if early else (None, {})
        if rows is not None and self._only(early):
            return self._replay_rows(inner, state, actions, rows, memories)
        period = self._period(theta, numbers, inner, early)

        def once(state: AugmentedState, now: Any) -> tuple[AugmentedState, AugmentedState]:
            action, rows, memories = now
            after = period(state, action, rows)
            kept = tuple(memories.get(k, memory) for k, memory in enumerate(after.memories))
            return after, replace(after, memories=kept)

        return jax.lax.scan(once, state, (actions, rows, memories))[1]

    def observe(self, theta: Float[Array, " d"], state: AugmentedState) -> Float[Array, " obs"]:
        """The channels in their order, as the sensors' effects show them."""
        _, inner = self._prepare(theta)
        seen = replace(self.base, engine=self.engine).observe(inner, state.base)
        for k, w in self._senses():
            for c in self._channels_of(w):
                seen = seen.at[c].set(
                    w.effect.sense(w.values(theta), state.memories[k], seen[c], Moment(state.time, self.dt))
                )
        return seen

    def positions(self, state: AugmentedState) -> Float[Array, " nq"]:
        """`qpos`, as it is."""
        return self.engine.qpos(state.base.physics)

    def velocities(self, state: AugmentedState) -> Float[Array, " nv"]:
        """`qvel`, as it is."""
        return self.engine.qvel(state.base.physics)

    def _prepare(self, theta: Float[Array, " d"]) -> tuple[Numbers, Float[Array, " e"]]:
        """The model's numbers as the engine has them, and the engine's θ."""
        edits = [w for _, w in self._at("model")]
        size = self.base.parameters.size
        inner = edit_model(self.engine.model, self.base.engine.writes, edits, theta, size)
        return read_numbers(self.engine.model, self.engine.writes, inner), inner

    def _at(self, port: str) -> list[tuple[int, Wired]]:
        return [(k, w) for k, w in enumerate(self.effects) if w.effect.port == port]

    def _senses(self) -> list[tuple[int, Wired]]:
        """Effects on readings in the order in which they act: first those that show another moment of the motion."""
        return sorted(self._at("sense"), key=lambda item: not item[1].effect.remembers)

    def _dof(self, joint: int) -> int:
        return int(self.engine.model.jnt_dofadr[joint])

    def _channels_of(self, wired: Wired) -> list[int]:
        return [k for k, c in enumerate(self.channels) if c.name == wired.place]

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
            memories = list(after.memories)
            for k, w in self._at("sense"):
                if w.effect.remembers:
                    moment = self._sensor_moment(after, w.site)._replace(h=self.dt)
                    memories[k] = w.effect.track(w.values(theta), memories[k], moment)
            return replace(after, base=replace(after.base, ctrl=action), memories=tuple(memories))

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
        commands, memories = self._commands(theta, numbers, state, action, early)
        forces, grips, memories = self._forces(theta, numbers, state, commands, memories)
        ctrl = jnp.stack(commands) if self._at("act") else action
        physics = self.engine.step(inner, state.base.physics, ctrl, forces, 1)
        return AugmentedState(replace(state.base, physics=physics), tuple(memories), grips, state.time + self._h)

    @property
    def _h(self) -> float:
        return float(self.engine.model.opt.timestep)

    def _commands(
        self,
        theta: Float[Array, " d"],
        numbers: Numbers,
        state: AugmentedState,
        action: Float[Array, " act"],
        early: frozenset[int] = NONE,
    ) -> tuple[list[Number], list[Any]]:
        """What arrives at the actuators during the next time step, and the memories after it."""
        commands: list[Number] = [action[k] for k in range(self.actions.size)]
        if not early:
            commands = self._limit(numbers, action)
        memories = list(state.memories)
        for k, w in self._at("act"):
            if k in early:
                continue
            moment = self._actuator_moment(numbers, state, w.site)
            commands, memories[k] = self._pass(theta, w, memories[k], commands, moment)
        return commands, memories

    def _limit(self, numbers: Numbers, action: Float[Array, "*rows act"]) -> list[Number]:
        """The commands within the limits that the model has on them; what becomes of them then has none."""
        limits, left = self.base.engine.model.actuator_ctrllimited, self.engine.model.actuator_ctrllimited
        commands: list[Number] = [action[..., k] for k in range(self.actions.size)]
        for k in np.flatnonzero(limits != left):
            low, high = (numbers("actuator_ctrlrange", int(k), side) for side in (0, 1))
            commands[k] = jnp.clip(commands[k], low, high)
        return commands

    def _pass(
        self, theta: Float[Array, " d"], wired: Wired, memory: Any, commands: list[Number], moment: Moment
    ) -> tuple[list[Number], Any]:
        new, memory = wired.effect.command(wired.values(theta), memory, _pick(commands, wired.site), moment)
        commands = list(commands)
        for actuator, value in zip(wired.site.actuators, new if isinstance(new, tuple) else (new,), strict=True):
            commands[actuator] = value
        return commands, memory

    def _forces(
        self,
        theta: Float[Array, " d"],
        numbers: Numbers,
        state: AugmentedState,
        commands: list[Number],
        memories: list[Any],
    ) -> tuple[Float[Array, " nv"] | None, tuple[Grip, ...], list[Any]]:
        """The generalized force of all effects together; holding effects do not see the forces of each other."""
        wired = self._at("force")
        if not wired:
            return None, state.grips, memories
        accelerations = self._accelerations(state)
        kind = state.time.dtype
        total: list[Number] = [0.0] * self.engine.model.nv
        held: dict[int, Number] = {joint: 0.0 for joint, _ in self.shares}
        for k, w in wired:
            moment = self._joint_moment(numbers, state, w.site, commands, accelerations)
            force, memories[k] = w.effect.force(w.values(theta), memories[k], moment)
            dof = self._dof(w.site.joint)
            total[dof] = total[dof] + force
            if w.effect.holds:
                held[w.site.joint] = held[w.site.joint] + force
                accelerations[w.site.joint] = accelerations[w.site.joint] + force / moment.inertia
        velocity = self.engine.qvel(state.base.physics)
        grips = tuple(
            Grip(velocity[self._dof(joint)], jnp.asarray(held[joint], kind), grip.inertia)
            for (joint, _), grip in zip(self.shares, state.grips, strict=True)
        )
        return jnp.stack([jnp.asarray(f, kind) for f in total]), grips, memories

    def _begin_commands(
        self, theta: Float[Array, " d"], numbers: Numbers, state: AugmentedState, held: Float[Array, " act"]
    ) -> AugmentedState:
        """Memories of the actuators' effects as after a command that has been held for long."""
        memories: list[Any] = [()] * len(self.effects)
        commands = self._limit(numbers, held)
        for k, w in self._at("act"):
            moment = self._actuator_moment(numbers, state, w.site)
            memories[k] = _arrays(w.effect.begin(w.values(theta), _pick(commands, w.site), moment), state.time)
            commands, _ = self._pass(theta, w, memories[k], commands, moment)
        return replace(state, memories=tuple(memories))

    def _begin_joints(
        self,
        theta: Float[Array, " d"],
        numbers: Numbers,
        inner: Float[Array, " e"],
        state: AugmentedState,
        commands: list[Number],
    ) -> AugmentedState:
        """Memories of the effects at joints, from what these are about to do without anything that holds them."""
        memories = list(state.memories)
        if self._at("force"):
            kind = state.time.dtype
            ctrl = jnp.stack([jnp.asarray(c, kind) for c in commands]) if commands else state.base.ctrl
            acceleration = self._push(inner, state.base.physics, ctrl)
            before = [
                replace(grip, velocity=grip.velocity - self._h / CAUTION * acceleration[self._dof(joint)])
                for (joint, _), grip in zip(self.shares, state.grips, strict=True)
            ]
            state = replace(state, grips=tuple(before))
        accelerations = self._accelerations(state)
        for k, w in self._at("force"):
            moment = self._joint_moment(numbers, state, w.site, commands, accelerations)
            memories[k] = _arrays(w.effect.begin(w.values(theta), moment), state.time)
        return replace(state, memories=tuple(memories))

    def _begin_late(
        self, theta: Float[Array, " d"], state: AugmentedState, acceleration: Array, jerk: Array
    ) -> AugmentedState:
        """What late sensors remember of a joint that came with this acceleration and jerk."""
        memories = list(state.memories)
        for k, w in self._senses():
            if w.effect.remembers:
                dof = self._dof(w.site.joint)
                moment = self._sensor_moment(state, w.site)
                moment = moment._replace(h=self.dt, acceleration=acceleration[dof], jerk=jerk[dof])
                memories[k] = _arrays(w.effect.begin(w.values(theta), moment), state.time)
        return replace(state, memories=tuple(memories))

    def _recall(
        self, theta: Float[Array, " d"], numbers: Numbers, state: AugmentedState, qpos: Array, qvel: Array, ctrl: Array
    ) -> AugmentedState:
        """The memories of effects that remember how their joint has moved, and under which commands."""
        memories, model = list(state.memories), self.engine.model
        for k, w in self._at("force"):
            if w.effect.recalls:
                position = qpos[:, int(model.jnt_qposadr[w.site.joint])]
                velocity = qvel[:, self._dof(w.site.joint)]
                drive = drive_of(model, numbers, actuators_of(model, w.site.joint), ctrl.T, position, velocity)
                drives = drive + jnp.zeros_like(position)
                memories[k] = w.effect.recall(w.values(theta), memories[k], position, velocity, drives, self.dt)
        return replace(state, memories=tuple(memories))

    def _push(self, inner: Float[Array, " e"], physics: Any, ctrl: Float[Array, " act"]) -> Float[Array, " nv"]:
        """Accelerations over one time step under a command, without the effects of forces."""
        after = self.engine.step(inner, physics, ctrl, None, 1)
        return (self.engine.qvel(after) - self.engine.qvel(physics)) / self._h

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

    def _accelerations(self, state: AugmentedState) -> dict[int, Number]:
        """What the joints did in the last time step, less what held them: a = (v − v⁻)/h − f⁻/m."""
        velocity = self.engine.qvel(state.base.physics)
        return {
            joint: (velocity[self._dof(joint)] - grip.velocity) / self._h - grip.held / grip.inertia
            for (joint, _), grip in zip(self.shares, state.grips, strict=True)
        }

    def _joint_moment(
        self,
        numbers: Numbers,
        state: AugmentedState,
        site: Site,
        commands: list[Number],
        accelerations: Mapping[int, Number],
    ) -> Moment:
        model = self.engine.model
        grips = dict(zip((joint for joint, _ in self.shares), state.grips, strict=True))

        def of(joint: int, actuators: list[int]) -> Moment:
            q = self.engine.qpos(state.base.physics)[int(model.jnt_qposadr[joint])]
            v = self.engine.qvel(state.base.physics)[self._dof(joint)]
            drive = drive_of(model, numbers, actuators, commands, q, v)
            inertia = grips[joint].inertia if joint in grips else 1.0
            return Moment(state.time, self._h, q, v, accelerations.get(joint, 0.0), inertia, drive)

        moment = of(site.joint, list(site.actuators) or actuators_of(model, site.joint))._replace(detail=site.detail)
        return moment if site.other < 0 else moment._replace(other=of(site.other, actuators_of(model, site.other)))

    def _actuator_moment(self, numbers: Numbers, state: AugmentedState, site: Site) -> Moment:
        if site.joint < 0:
            return Moment(state.time, self._h)
        actuator = site.actuators[0]
        q = self.engine.qpos(state.base.physics)[int(self.engine.model.jnt_qposadr[site.joint])]
        v = self.engine.qvel(state.base.physics)[self._dof(site.joint)]
        gain = numbers("actuator_gear", actuator, 0) * numbers("actuator_gainprm", actuator, 0)
        inertias = {j: grip.inertia for (j, _), grip in zip(self.shares, state.grips, strict=True)}
        return Moment(state.time, self._h, q, v, inertia=inertias.get(site.joint, 1.0), gain=gain)

    def _sensor_moment(self, state: AugmentedState, site: Site) -> Moment:
        if site.joint < 0:
            return Moment(state.time, self._h)
        q = self.engine.qpos(state.base.physics)[int(self.engine.model.jnt_qposadr[site.joint])]
        return Moment(state.time, self._h, q, self.engine.qvel(state.base.physics)[self._dof(site.joint)])

    def _restore(
        self,
        wired: Sequence[Wired],
        theta: Float[Array, " d"],
        qpos: Float[Array, " nq"],
        qvel: Float[Array, " nv"],
        time: Scalar,
        acceleration: Float[Array, " nv"],
        jerk: Float[Array, " nv"],
    ) -> tuple[Float[Array, " nq"], Float[Array, " nv"]]:
        """The positions and velocities behind these, which some effects on readings show, the last one outermost."""
        seen = {c.name for c in self.channels}
        for w in reversed(wired):
            if w.site.joint < 0:
                continue
            q, v = int(self.engine.model.jnt_qposadr[w.site.joint]), self._dof(w.site.joint)
            prompt = w.place.removesuffix("/qpos") + "/qvel" in seen
            moment = Moment(time, self.dt, qpos[q], qvel[v], acceleration[v], jerk=jerk[v], prompt=prompt)
            position, velocity = w.effect.restore(w.values(theta), moment)
            if not w.place.endswith("/qvel"):
                qpos = qpos.at[q].set(position)
            if w.place.endswith("/qvel") or not prompt:
                qvel = qvel.at[v].set(velocity)
        return qpos, qvel

    def _warm(
        self, theta: Float[Array, " d"], numbers: Numbers, state: AugmentedState, past: Actions
    ) -> AugmentedState:
        """The memories of the actuators' effects after past commands; those that look at the joint are left alone.

        What lies long back goes in longer steps, past effects that have not forgotten it.
        """
        blind = frozenset(k for k, w in self._at("act") if not w.effect.looks)
        long = frozenset(k for k in blind if not self.effects[k].effect.brief)
        older, h, past = split_history(past, self.dt)
        if len(older) and long:
            begun = replace(state, time=state.time - len(past) * self.dt - len(older) * h)
            afresh = self._begin_commands(theta, numbers, state, past[0])
            long_ago = self._remember(state, self._pass_early(theta, numbers, begun, older, long, h)[1])
            pairs = enumerate(zip(long_ago.memories, afresh.memories, strict=True))
            state = replace(state, memories=tuple(old if k in long else new for k, (old, new) in pairs))
        begun = replace(state, time=state.time - len(past) * self.dt)
        return self._remember(state, self._pass_early(theta, numbers, begun, past, blind)[1])

    def _remember(self, state: AugmentedState, later: Mapping[int, Any]) -> AugmentedState:
        """The state with the last of some effects' memories."""
        last = jax.tree.map(lambda x: x[-1], dict(later))
        return replace(state, memories=tuple(last.get(k, memory) for k, memory in enumerate(state.memories)))

    def _early(self) -> frozenset[int]:
        """Effects of actuators that are worked out before the simulation: for one that hurries also those before it."""
        blind: list[int] = []
        for k, w in self._at("act"):
            if w.effect.looks:
                break
            blind.append(k)
        if self.engine.name == "mujoco" and self._only(frozenset(blind)):
            return frozenset(blind)
        while blind and not self.effects[blind[-1]].effect.hurries:
            blind.pop()
        return frozenset(blind)

    def _only(self, early: frozenset[int]) -> bool:
        """Whether nothing is left to do between time steps."""
        others = [w.effect for k, w in enumerate(self.effects) if k not in early]
        return all(e.port == "model" or (e.port == "sense" and not e.remembers) for e in others)

    def _pass_early(
        self,
        theta: Float[Array, " d"],
        numbers: Numbers,
        state: AugmentedState,
        actions: Actions,
        early: frozenset[int],
        h: float = 0.0,
    ) -> tuple[Float[Array, "periods steps act"], dict[int, Any]]:
        """What has become of the commands at each time step, and the memories after each period.

        With `h` a period is one step of that length.
        """
        substeps = 1 if h else self.substeps
        rows = jnp.repeat(actions, substeps, axis=0) if substeps > 1 else actions
        columns = self._limit(numbers, rows)
        later = {}
        for k in sorted(early):
            w, moment = self.effects[k], Moment(state.time, h or self._h)
            new, memory = w.effect.ahead(w.values(theta), state.memories[k], _pick(columns, w.site), moment)
            for actuator, value in zip(w.site.actuators, new if isinstance(new, tuple) else (new,), strict=True):
                columns[actuator] = value
            later[k] = jax.tree.map(lambda x: x[substeps - 1 :: substeps], memory)
        return jnp.stack(columns, -1).reshape(-1, substeps, self.actions.size), later

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
        later = self._later(state, actions, ends)
        return replace(later, memories=tuple(memories.get(k, m) for k, m in enumerate(later.memories)))

    def _later(self, state: AugmentedState, actions: Actions, physics: Any) -> AugmentedState:
        """States at the ends of control periods between which nothing but the engine was at work."""
        count = len(actions)
        times = state.time + self.dt * jnp.arange(1, count + 1, dtype=state.time.dtype)
        spread = jax.tree.map(lambda x: jnp.broadcast_to(x, (count, *x.shape)), state)
        return replace(spread, base=MjcfState(physics, actions), time=times)


def _pick(commands: list[Number], site: Site) -> Any:
    picked = tuple(commands[i] for i in site.actuators)
    return picked[0] if len(picked) == 1 else picked


def _arrays(memory: Any, like: Scalar) -> Any:
    return jax.tree.map(lambda x: jnp.asarray(x, like.dtype), memory)
