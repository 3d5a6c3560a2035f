"""A MuJoCo model with effects: they act at every time step of the model, between its engine's steps."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float, PRNGKeyArray

from bayessim_jax.contracts import Box, Scalar
from bayessim_jax.effects.contract import Moment, Number, Numbers
from bayessim_jax.effects.drive import CAUTION, actuator_torque, actuators_of, probe_inertia, read_numbers
from bayessim_jax.effects.places import Site
from bayessim_jax.effects.wiring import Wired, edit_model
from bayessim_jax.engines.contract import Engine
from bayessim_jax.systems.channels import Channel
from bayessim_jax.systems.mjcf import MjcfState, MjcfSystem

__all__ = ["AugmentedMjcf", "AugmentedState", "Grip"]

Actions = Float[Array, "periods act"]


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
    ) -> AugmentedState:
        """The state with these measured positions and velocities, `time` seconds into a recording.

        `action` is the command of the first control period, without it zero; `past` are those before it, one row for
        each control period, the most recent last, without them as if the first had always been held.
        """
        kind = jnp.result_type(theta)
        numbers, inner = self._prepare(theta)
        qpos, qvel = (jnp.asarray(x, kind) for x in (qpos, qvel))
        first = jnp.zeros(self.actions.size, kind) if action is None else jnp.asarray(action, kind)
        held = first if past is None or not len(past) else jnp.asarray(past[0], kind)
        time = jnp.asarray(time, kind)
        qpos, qvel = self._restore(theta, qpos, qvel, time)
        physics = self.engine.init(inner, qpos, qvel)
        inertias = {
            joint: share * probe_inertia(self.engine, inner, self.base.qpos.astype(kind), self._dof(joint))
            for joint, share in self.shares
        }
        grips = tuple(Grip(qvel[self._dof(j)], jnp.zeros((), kind), m) for j, m in inertias.items())
        state = AugmentedState(MjcfState(physics, first), (), grips, time)
        memories: list[Any] = [()] * len(self.effects)
        commands: list[Number] = [held[k] for k in range(self.actions.size)]
        for k, w in self._at("act"):
            moment = self._actuator_moment(numbers, state, w.site)
            memories[k] = _arrays(w.effect.begin(w.values(theta), _pick(commands, w.site), moment), time)
            commands, _ = self._pass(theta, w, memories[k], commands, moment)
        state = replace(state, memories=tuple(memories))
        if past is not None and len(past):
            state = self._warm(theta, numbers, state, jnp.asarray(past, kind))
        commands, _ = self._commands(theta, numbers, state, first)
        state = replace(state, grips=self._free(inner, state, commands))
        memories = list(state.memories)
        accelerations = self._accelerations(state)
        for k, w in self._at("force"):
            moment = self._joint_moment(numbers, state, w.site, commands, accelerations)
            memories[k] = _arrays(w.effect.begin(w.values(theta), moment), time)
        for k, w in self._at("sense"):
            memory = w.effect.begin(w.values(theta), self._sensor_moment(state, w.site))
            memories[k] = _arrays(memory, time)
        return replace(state, memories=tuple(memories))

    def step(self, theta: Float[Array, " d"], state: AugmentedState, action: Float[Array, " act"]) -> AugmentedState:
        """Advance by one control period."""
        return self._period(theta, *self._prepare(theta))(state, action)

    def replay(self, theta: Float[Array, " d"], state: AugmentedState, actions: Actions) -> AugmentedState:
        """The states after each control period under recorded actions; a leading axis on every leaf."""
        numbers, inner = self._prepare(theta)
        if self._runs_ahead():
            return self._replay_ahead(theta, numbers, inner, state, actions)
        period = self._period(theta, numbers, inner)

        def once(state: AugmentedState, action: Float[Array, " act"]) -> tuple[AugmentedState, AugmentedState]:
            after = period(state, action)
            return after, after

        return jax.lax.scan(once, state, actions)[1]

    def observe(self, theta: Float[Array, " d"], state: AugmentedState) -> Float[Array, " obs"]:
        """The channels in their order, as the sensors' effects show them."""
        _, inner = self._prepare(theta)
        seen = replace(self.base, engine=self.engine).observe(inner, state.base)
        for k, w in self._at("sense"):
            for c in self._channels_of(w):
                seen = seen.at[c].set(w.effect.sense(w.values(theta), state.memories[k], seen[c]))
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

    def _dof(self, joint: int) -> int:
        return int(self.engine.model.jnt_dofadr[joint])

    def _channels_of(self, wired: Wired) -> list[int]:
        return [k for k, c in enumerate(self.channels) if c.name == wired.place]

    def _period(
        self, theta: Float[Array, " d"], numbers: Numbers, inner: Float[Array, " e"]
    ) -> Callable[[AugmentedState, Float[Array, " act"]], AugmentedState]:
        def period(state: AugmentedState, action: Float[Array, " act"]) -> AugmentedState:
            if not any(w.effect.port != "model" for w in self.effects):
                physics = self.engine.step(inner, state.base.physics, action, None, self.substeps)
                return replace(state, base=MjcfState(physics, action), time=state.time + self.dt)
            if self.substeps == 1:
                return self._tick(theta, numbers, inner, state, action)
            state = replace(state, base=replace(state.base, ctrl=action))
            once = lambda s, _: (self._tick(theta, numbers, inner, s, action), None)  # noqa: E731
            return jax.lax.scan(once, state, length=self.substeps)[0]

        return period

    def _tick(
        self,
        theta: Float[Array, " d"],
        numbers: Numbers,
        inner: Float[Array, " e"],
        state: AugmentedState,
        action: Float[Array, " act"],
    ) -> AugmentedState:
        """One time step of the model."""
        commands, memories = self._commands(theta, numbers, state, action)
        forces, grips, memories = self._forces(theta, numbers, state, commands, memories)
        ctrl = jnp.stack(commands) if self._at("act") else action
        physics = self.engine.step(inner, state.base.physics, ctrl, forces, 1)
        after = AugmentedState(MjcfState(physics, action), tuple(memories), grips, state.time + self._h)
        for k, w in self._at("sense"):
            if not w.effect.remembers:
                continue
            moment = self._sensor_moment(after, w.site)
            reading = moment.velocity if w.place.endswith("/qvel") else moment.position
            memories[k] = w.effect.track(w.values(theta), memories[k], reading, moment)
        return replace(after, memories=tuple(memories))

    @property
    def _h(self) -> float:
        return float(self.engine.model.opt.timestep)

    def _commands(
        self, theta: Float[Array, " d"], numbers: Numbers, state: AugmentedState, action: Float[Array, " act"]
    ) -> tuple[list[Number], list[Any]]:
        """What arrives at the actuators during the next time step, and the memories after it."""
        commands: list[Number] = [action[k] for k in range(self.actions.size)]
        memories = list(state.memories)
        for k, w in self._at("act"):
            moment = self._actuator_moment(numbers, state, w.site)
            commands, memories[k] = self._pass(theta, w, memories[k], commands, moment)
        return commands, memories

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

    def _accelerations(self, state: AugmentedState) -> dict[int, Number]:
        """What the joints did in the last time step, less what held them: a = (v − v⁻)/h − f⁻/m."""
        velocity = self.engine.qvel(state.base.physics)
        return {
            joint: (velocity[self._dof(joint)] - grip.velocity) / self._h - grip.held / grip.inertia
            for (joint, _), grip in zip(self.shares, state.grips, strict=True)
        }

    def _free(self, inner: Float[Array, " e"], state: AugmentedState, commands: list[Number]) -> tuple[Grip, ...]:
        """Grips that look back on what the joints are about to do without anything that holds them."""
        if not any(w.effect.holds for _, w in self._at("force")):
            return state.grips
        kind = state.time.dtype
        ctrl = jnp.stack([jnp.asarray(c, kind) for c in commands]) if commands else state.base.ctrl
        before = self.engine.qvel(state.base.physics)
        after = self.engine.qvel(self.engine.step(inner, state.base.physics, ctrl, None, 1))
        dofs = [self._dof(joint) for joint, _ in self.shares]
        change = [(after[dof] - before[dof]) / CAUTION for dof in dofs]
        return tuple(
            replace(grip, velocity=before[dof] - dv) for dof, dv, grip in zip(dofs, change, state.grips, strict=True)
        )

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
            drive: Number = 0.0
            for i in actuators:
                drive = drive + actuator_torque(model, numbers, i, commands[i], q, v)
            inertia = grips[joint].inertia if joint in grips else 1.0
            return Moment(state.time, self._h, q, v, accelerations.get(joint, 0.0), inertia, drive)

        moment = of(site.joint, list(site.actuators) or actuators_of(model, site.joint))
        return moment if site.other < 0 else moment._replace(other=of(site.other, actuators_of(model, site.other)))

    def _actuator_moment(self, numbers: Numbers, state: AugmentedState, site: Site) -> Moment:
        if site.joint < 0:
            return Moment(state.time, self._h)
        gear = numbers("actuator_gear", site.actuators[0], 0)
        q = self.engine.qpos(state.base.physics)[int(self.engine.model.jnt_qposadr[site.joint])]
        v = self.engine.qvel(state.base.physics)[self._dof(site.joint)]
        return Moment(state.time, self._h, gear * q, gear * v)

    def _sensor_moment(self, state: AugmentedState, site: Site) -> Moment:
        if site.joint < 0:
            return Moment(state.time, self._h)
        q = self.engine.qpos(state.base.physics)[int(self.engine.model.jnt_qposadr[site.joint])]
        return Moment(state.time, self._h, q, self.engine.qvel(state.base.physics)[self._dof(site.joint)])

    def _restore(
        self, theta: Float[Array, " d"], qpos: Float[Array, " nq"], qvel: Float[Array, " nv"], time: Scalar
    ) -> tuple[Float[Array, " nq"], Float[Array, " nv"]]:
        """The state that these positions and velocities were measured in."""
        seen = {c.name for c in self.channels}
        for _, w in self._at("sense"):
            if w.site.joint < 0:
                continue
            q, v = int(self.engine.model.jnt_qposadr[w.site.joint]), self._dof(w.site.joint)
            moment = Moment(time, self._h, qpos[q], qvel[v])
            position, velocity = w.effect.restore(w.values(theta), moment)
            if not w.place.endswith("/qvel"):
                qpos = qpos.at[q].set(position)
            if w.place.endswith("/qvel") or w.place.removesuffix("/qpos") + "/qvel" not in seen:
                qvel = qvel.at[v].set(velocity)
        return qpos, qvel

    def _warm(
        self, theta: Float[Array, " d"], numbers: Numbers, state: AugmentedState, past: Actions
    ) -> AugmentedState:
        """The memories of the actuators' effects after past commands; those that look at the joint are left alone."""
        kept = {k for k, w in self._at("act") if not w.effect.looks}
        if not kept:
            return state
        rows = jnp.repeat(past, self.substeps, axis=0) if self.substeps > 1 else past
        start, count = state.time, rows.shape[0]

        def once(carry: tuple[AugmentedState, Scalar], row: Float[Array, " act"]) -> Any:
            state, left = carry
            now = replace(state, time=start - left * self._h)
            _, memories = self._commands(theta, numbers, now, row)
            memories = [m if k in kept else state.memories[k] for k, m in enumerate(memories)]
            return (replace(state, memories=tuple(memories)), left - 1.0), None

        (state, _), _ = jax.lax.scan(once, (state, jnp.asarray(float(count), state.time.dtype)), rows)
        return replace(state, time=start)

    def _runs_ahead(self) -> bool:
        """Whether all commands are known before the simulation begins, and one call of the engine is worth it."""
        ports = {w.effect.port for w in self.effects}
        looks = any(w.effect.looks for _, w in self._at("act"))
        tracks = any(w.effect.remembers for _, w in self._at("sense"))
        if looks or tracks or "force" in ports:
            return False
        return "act" not in ports or self.engine.name == "mujoco"

    def _replay_ahead(
        self,
        theta: Float[Array, " d"],
        numbers: Numbers,
        inner: Float[Array, " e"],
        state: AugmentedState,
        actions: Actions,
    ) -> AugmentedState:
        def once(state: AugmentedState, row: Float[Array, " act"]) -> Any:
            commands, memories = self._commands(theta, numbers, state, row)
            after = replace(state, memories=tuple(memories), time=state.time + self._h)
            return after, (jnp.stack(commands), after)

        if not self._at("act"):
            physics = self.engine.replay(inner, state.base.physics, actions, None, self.substeps)
            times = state.time + self.dt * jnp.arange(1, len(actions) + 1, dtype=state.time.dtype)
            spread = jax.tree.map(lambda x: jnp.broadcast_to(x, (len(actions), *x.shape)), state)
            return replace(spread, base=MjcfState(physics, actions), time=times)
        rows = jnp.repeat(actions, self.substeps, axis=0)
        _, (commands, states) = jax.lax.scan(once, state, rows)
        physics = self.engine.replay(inner, state.base.physics, commands, None, 1)
        ends = lambda x: x[self.substeps - 1 :: self.substeps]  # noqa: E731
        return jax.tree.map(ends, replace(states, base=MjcfState(physics, rows)))


def _pick(commands: list[Number], site: Site) -> Any:
    picked = tuple(commands[i] for i in site.actuators)
    return picked[0] if len(picked) == 1 else picked


def _arrays(memory: Any, like: Scalar) -> Any:
    return jax.tree.map(lambda x: jnp.asarray(x, like.dtype), memory)
