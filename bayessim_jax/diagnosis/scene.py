"""The recorded motion with effects along it: what a candidate would change in what was measured, without simulating.

Effects of the three ports exert forces, change commands or distort readings along the smoothed motion; effects on the
model change the steps around it. What does not depend on a candidate is computed once.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from bayessim_jax.beliefs.margins import Margin, Margins
from bayessim_jax.diagnosis.bench import SLOTS, Candidate, margin_of_effect
from bayessim_jax.diagnosis.forcing import Joint, commands_of, force_of, restore_readings
from bayessim_jax.diagnosis.response import Forcing, Linearized, Motion, Windowed, assess, linearize_steps
from bayessim_jax.effects import Scales, at, with_effects
from bayessim_jax.effects.drive import CAUTION, actuator_torque, actuators_of, read_numbers
from bayessim_jax.effects.places import find_site
from bayessim_jax.effects.wiring import edit_model
from bayessim_jax.inference.shooting import Curvature, Shots
from bayessim_jax.systems.mjcf import MjcfSystem, displace

__all__ = ["Scene"]

FINE = 4
"""Most time steps in a row at which effects are evaluated."""
MOVED = 0.15
"""Of θ's z: how far it may move before the steps are linearized anew."""


@dataclass
class _Around:
    """Steps linearized around a motion, and what effects see of its joints."""

    p: Float[Array, " k"]
    """Where θ was."""
    motion: Motion
    lin: Linearized
    windowed: Windowed
    kept: dict[Any, Any] = field(default_factory=dict)


class Scene:
    """Pairs of effects and places, and windows of recordings with their smoothed motion."""

    def __init__(
        self,
        system: MjcfSystem,
        margins: Margins,
        pairs: Sequence[tuple[Any, str]],
        scales: Mapping[str, Scales],
        shots: Shots,
        motion: Motion,
        step: float = 0.0,
        slots: int = SLOTS,
    ) -> None:
        self.system, self.margins, self.pairs, self.step, self.slots = system, margins, tuple(pairs), step, slots
        self.motion, self.shots = motion, shots
        self.parameters = [effect.parameters(place, scales[place]) for effect, place in self.pairs]
        self.margin: list[list[Margin]] = [[margin_of_effect(p) for p in each] for each in self.parameters]
        self.kinds = [
            tuple((p.name, m.kind) for p, m in zip(*each, strict=True))
            for each in zip(self.parameters, self.margin, strict=True)
        ]
        self.ranges = [
            (jnp.asarray([m.a for m in each], float), jnp.asarray([m.b for m in each], float)) for each in self.margin
        ]
        self.model = system.engine.model
        self.sites = [find_site(self.model, place) for _, place in self.pairs]
        self.edits = [k for k, (effect, _) in enumerate(self.pairs) if effect.port == "model"]
        plain: Any = system
        self.edited = with_effects(plain, [self.pairs[k] for k in self.edits], scales) if self.edits else None
        self.engine = self.edited.engine if self.edited else system.engine
        rows = system.substeps
        self.fine = next(s for s in range(min(FINE, rows), 0, -1) if rows % s == 0)
        self.h = system.dt / self.fine
        self.times = motion.start[:, None] + self.h * jnp.arange(motion.ctrl.shape[1] * self.fine)
        self._around: _Around | None = None
        self._commands: dict[Any, Array] = {}

    @property
    def d(self) -> int:
        """Parameters of the system."""
        return self.margins.size

    @property
    def length(self) -> float:
        """Of a window, s."""
        return self.motion.ctrl.shape[1] * self.system.dt

    def count(self, candidate: Candidate) -> int:
        """Parameters of a candidate."""
        return sum(len(self.parameters[k]) for k in candidate.effects)

    def name(self, candidate: Candidate) -> str:
        """`coulomb_friction@joint/hinge + …`."""
        return " + ".join(f"{self.pairs[k][0].name}@{at(self.pairs[k][1])}" for k in candidate.effects) or "nothing"

    def takes(self, candidate: Candidate) -> bool:
        """Whether it can be tried here: not at something else than a joint, nor with too many parameters."""
        placed = (self.pairs[k][0].port == "model" or self.sites[k].joint >= 0 for k in candidate.effects)
        return all(placed) and self.count(candidate) <= self.slots

    def offsets(self, candidate: Candidate) -> list[tuple[int, slice]]:
        """Every effect of a candidate and the places of its parameters in p = [θ's z, x, zeros]."""
        found, first = [], self.d
        for k in candidate.effects:
            found.append((k, slice(first, first + len(self.parameters[k]))))
            first += len(self.parameters[k])
        return found

    def assess(
        self, candidate: Candidate, p: Float[Array, " k"], delta: Float[Array, "windows n"], sigma: Array
    ) -> tuple[Curvature, Float[Array, "windows rows obs"], Float[Array, "windows kn rowsobs"]]:
        """Normal equations at a point, residuals over σ, and derivatives of what is predicted over σ."""
        motion, readings = self._restored(candidate, p)
        ports = {self.pairs[k][0].port for k in candidate.effects}
        around = self._linearized(candidate, p, motion, fresh=bool(ports & {"model", "sense"}))
        pushes = [push for k, place in self.offsets(candidate) for push in self._pushes(k, p, place, around)]
        sensed = []
        if readings:
            raw = self._windowed(p, self.motion).seen
            sensed = [(channel, raw[..., channel], *rest) for channel, *rest in readings]
        forcing = _assemble(around.windowed.seen, pushes, sensed, self.model.nv, p.size)
        moved = jnp.where(jnp.arange(p.size) < self.d, p - around.p, 0.0)
        return assess(around.lin, around.windowed, forcing, moved, p, delta, sigma)

    @cached_property
    def numbers(self) -> Any:
        """The engine's θ as a function of [z, x of all model effects, which are on, low, high, neutral]."""
        if self.edited is None:
            return self.margins.theta
        d, wired = self.d, self.edited.effects
        kinds = [m.kind for k in self.edits for m in self.margin[k]]
        m = len(kinds)
        writes, model, margins = self.system.engine.writes, self.edited.engine.model, self.margins

        def numbers(full: Array) -> Array:
            x, on, low, high, neutral = (full[d + i * m : d + (i + 1) * m] for i in range(5))
            values = [
                jnp.where(on[i] > 0.5, Margin(kind, 0.0, 1.0).between(low[i], high[i]).value(x[i]), neutral[i])
                for i, kind in enumerate(kinds)
            ]
            theta = jnp.concatenate([margins.theta(full[:d]), jnp.stack(values)])
            return edit_model(model, writes, wired, theta, d)

        return numbers

    def _full(self, candidate: Candidate, p: Array) -> tuple[Array, Array]:
        """The argument of `numbers`, and what of it p moves."""
        k = self.d + self.slots
        if self.edited is None:
            return p[: self.d], jnp.eye(k, self.d)
        first = dict(zip(self.edits, np.cumsum([0, *(len(self.parameters[e]) for e in self.edits)]), strict=False))
        flat = [(q, m) for e in self.edits for q, m in zip(self.parameters[e], self.margin[e], strict=True)]
        m = len(flat)
        here = np.asarray(p)
        x, on = np.zeros(m), np.zeros(m)
        along = np.zeros((k, self.d + 5 * m))
        along[: self.d, : self.d] = np.eye(self.d)
        for e, place in self.offsets(candidate):
            if e in first:
                own = slice(int(first[e]), int(first[e]) + len(self.parameters[e]))
                x[own], on[own] = here[place], 1.0
                along[range(place.start, place.stop), range(self.d + own.start, self.d + own.stop)] = 1.0
        low, high = ([getattr(mm, side) for _, mm in flat] for side in ("a", "b"))
        neutral = [q.neutral for q, _ in flat]
        parts = (here[: self.d], x, on, *(np.asarray(v, float) for v in (low, high, neutral)))
        return jnp.asarray(np.concatenate(parts)), jnp.asarray(along)

    def _linearized(self, candidate: Candidate, p: Array, motion: Motion, fresh: bool) -> _Around:
        """Steps around the motion: those of before, where neither the model nor the motion nor θ has changed much."""
        if not fresh and self._around is not None:
            change = np.abs(np.asarray(p) - np.asarray(self._around.p))[: self.d]
            if change.max(initial=0.0) < MOVED:
                return self._around
        full, along = self._full(candidate, p)
        lin = linearize_steps(self.engine, self.numbers, motion, full, along, self.system.substeps, self.step)
        around = _Around(p, motion, lin, self._windowed(p, motion))
        if not fresh:
            self._around = around
        return around

    def _windowed(self, p: Array, motion: Motion) -> Windowed:
        ctrl = jnp.concatenate([motion.ctrl, motion.ctrl[:, -1:]], 1)
        seen, c = _see_all(self.system, self.margins.theta(p[: self.d]), motion.qpos, motion.qvel, ctrl)
        return Windowed(self.shots.y, self.shots.measured, seen, c, self.shots.spread)

    @cached_property
    def _rates(self) -> tuple[Array, Array]:
        """Accelerations and their rates along the motion."""
        acceleration = jnp.asarray(jnp.gradient(self.motion.qvel, self.system.dt, axis=1))
        return acceleration, jnp.asarray(jnp.gradient(acceleration, self.system.dt, axis=1))

    def _restored(self, candidate: Candidate, p: Array) -> tuple[Motion, list[tuple[Any, ...]]]:
        """The true motion behind what sensors with effects showed: channel, ∂q/∂x, ∂q/∂reading, place in p."""
        motion, readings = self.motion, []
        for k, place in self.offsets(candidate):
            effect, name = self.pairs[k]
            if effect.port != "sense":
                continue
            joint = self.sites[k].joint
            q, v = int(self.model.jnt_qposadr[joint]), int(self.model.jnt_dofadr[joint])
            channels = [c.name for c in self.system.channels]
            rows = motion.start[:, None] + self.system.dt * jnp.arange(motion.qpos.shape[1])
            seen = (motion.qpos[..., q], motion.qvel[..., v], *(rate[..., v] for rate in self._rates))
            new_q, new_v, along, slope = restore_readings(
                effect, self.kinds[k], self.system.dt, p[place], *self.ranges[k], rows, *seen
            )
            qpos, qvel = motion.qpos.at[..., q].set(new_q), motion.qvel
            if name.removesuffix("/qpos") + "/qvel" not in channels:
                qvel = qvel.at[..., v].set(new_v)
            motion = dataclasses.replace(motion, qpos=qpos, qvel=qvel)
            readings.append((channels.index(at(name)), along, slope, place.start))
        return motion, readings

    def _pushes(self, e: int, p: Array, place: slice, around: _Around) -> list[tuple[Any, ...]]:
        """What an effect exerts: degree of freedom, force, derivatives along x, place of x in p."""
        effect, site = self.pairs[e][0], self.sites[e]
        if effect.port not in ("force", "act"):
            return []
        joint = self._joint(site.joint, around, site.actuators if effect.port == "force" else ())
        kinds, x, (low, high) = self.kinds[e], p[place], self.ranges[e]
        if effect.port == "force":
            other = self._joint(site.other, around, ()) if site.other >= 0 else None
            f, along = force_of(effect, kinds, site.detail, self.h, self.fine, x, low, high, self.times, joint, other)
            return [(self._dof(site.joint), f, along, place.start)]
        before = 0 if effect.looks else self.motion.past.shape[1] * self.fine
        times = self.times
        if before:
            joint = jax.tree.map(lambda a: jnp.concatenate([jnp.repeat(a[:, :1], before, 1), a], 1), joint)
            times = self.times[:, :1] + self.h * jnp.arange(-before, self.times.shape[1])
        gains = [self._gain(actuator, around) for actuator in site.actuators]
        commands = self._commanded(tuple(site.actuators), before)
        f, along = commands_of(effect, kinds, self.h, self.fine, before, x, low, high, times, joint, commands, gains[0])
        return [
            (
                self._dof(int(self.model.actuator_trnid[actuator, 0])),
                gain * f[..., i],
                gain * along[..., i, :],
                place.start,
            )
            for i, (actuator, gain) in enumerate(zip(site.actuators, gains, strict=True))
        ]

    def _dof(self, joint: int) -> int:
        return int(self.model.jnt_dofadr[joint])

    def _numbers_at(self, around: _Around) -> Any:
        """Numbers of the model, with θ written into them."""
        return read_numbers(self.model, self.system.engine.writes, self.margins.theta(around.p[: self.d]))

    def _gain(self, actuator: int, around: _Around) -> Array:
        """Force on its joint for a command of one."""
        key = ("gain", actuator)
        if key not in around.kept:
            read = self._numbers_at(around)
            gain = read("actuator_gear", actuator, 0) * read("actuator_gainprm", actuator, 0)
            around.kept[key] = jnp.asarray(gain, float)
        return around.kept[key]

    def _commanded(self, actuators: tuple[int, ...], before: int) -> Float[Array, "windows steps act"]:
        """Commands of every time step within their limits, those before the window first."""
        if (actuators, before) not in self._commands:
            past, ctrl = self.motion.past, self.motion.ctrl
            rows = jnp.concatenate([past, ctrl], 1) if before else ctrl
            limits = [self.model.actuator_ctrlrange[i] for i in actuators]
            limited = [bool(self.model.actuator_ctrllimited[i]) for i in actuators]
            low, high = (
                np.array([r[k] if on else bound for r, on in zip(limits, limited, strict=True)])
                for k, bound in ((0, -np.inf), (1, np.inf))
            )
            self._commands[actuators, before] = jnp.repeat(
                jnp.clip(rows[..., list(actuators)], low, high), self.fine, 1
            )
        return self._commands[actuators, before]

    def _joint(self, joint: int, around: _Around, actuators: Sequence[int]) -> Joint:
        """What effects see of a joint; the drive is that of some actuators, or of all that the joint has."""
        key = (joint, tuple(actuators))
        if key not in around.kept:
            around.kept[key] = self._look_at(joint, around, tuple(actuators) or actuators_of(self.model, joint))
        return around.kept[key]

    def _look_at(self, joint: int, around: _Around, actuators: Sequence[int]) -> Joint:
        motion, lin = around.motion, around.lin
        q, v, nv = int(self.model.jnt_qposadr[joint]), self._dof(joint), self.model.nv
        inertia = CAUTION * self.system.dt / jnp.maximum(lin.b[..., nv + v, v], 1e-12)
        rise = lin.gap[..., nv + v] + motion.qvel[:, 1:, v] - motion.qvel[:, :-1, v]
        position, velocity = self._between(motion.qpos[..., q]), self._between(motion.qvel[..., v])
        drive, numbers = jnp.zeros_like(position), self._numbers_at(around)
        for i in actuators:
            command = jnp.repeat(motion.ctrl[..., i], self.fine, axis=1)
            drive = drive + actuator_torque(self.model, numbers, i, command, position, velocity)
        fine = lambda rows: jnp.repeat(rows, self.fine, axis=1)  # noqa: E731
        return Joint(position, velocity, fine(rise / self.system.dt), fine(inertia), drive)

    def _between(self, rows: Float[Array, "windows rows"]) -> Float[Array, "windows steps"]:
        """On a line between rows."""
        f = jnp.arange(self.fine) / self.fine
        return (rows[:, :-1, None] * (1 - f) + rows[:, 1:, None] * f).reshape(len(rows), -1)


@partial(jax.jit, static_argnames=("nv", "size"))
def _assemble(
    seen: Float[Array, "windows rows obs"],
    pushes: Sequence[tuple[Any, ...]],
    sensed: Sequence[tuple[Any, ...]],
    nv: int,
    size: int,
) -> Forcing:
    """What effects exert and distort, put together.

    A distorted reading of a restored motion is what it was restored from: s(x, q(x, r)) = r.
    """
    windows, rows, _ = seen.shape
    force, along = jnp.zeros((windows, rows - 1, nv)), jnp.zeros((windows, rows - 1, nv, size))
    for dof, f, slopes, first in pushes:
        at_dof = jnp.arange(nv) == dof
        place = jnp.arange(size) == first + jnp.arange(slopes.shape[-1])[:, None]
        force = force + f[..., None] * at_dof
        along = along + jnp.einsum("wte,ek,v->wtvk", slopes, place.astype(float), at_dof.astype(float))
    scale, shift, reading_along = jnp.ones_like(seen), jnp.zeros_like(seen), jnp.zeros((*seen.shape, size))
    for channel, raw, own, slope, first in sensed:
        here = jnp.arange(seen.shape[-1]) == channel
        place = jnp.arange(size) == first + jnp.arange(own.shape[-1])[:, None]
        s = 1.0 / slope
        scale = jnp.where(here, s[..., None], scale)
        shift = jnp.where(here, (raw[..., None] - s[..., None] * seen), shift)
        moved = jnp.einsum("wte,ek->wtk", -s[..., None] * own, place.astype(float))
        reading_along = reading_along + here[:, None] * moved[:, :, None]
    return Forcing(force, along, scale, shift, reading_along)


def _see_one(system: MjcfSystem, theta: Array, qpos: Array, qvel: Array, ctrl: Array) -> tuple[Array, Array]:
    model = system.engine.model
    nv = model.nv

    def see(move: Array) -> Array:
        state = system.begin(theta, displace(model, qpos, move[:nv]), qvel + move[nv:])
        return system.observe(theta, dataclasses.replace(state, ctrl=ctrl))

    zero = jnp.zeros(2 * nv)
    return see(zero), jax.vmap(lambda d: jax.jvp(see, (zero,), (d,))[1], out_axes=-1)(jnp.eye(2 * nv))


@jax.jit
def _see_all(system: MjcfSystem, theta: Array, qpos: Array, qvel: Array, ctrl: Array) -> tuple[Array, Array]:
    one = lambda q, v, u: _see_one(system, theta, q, v, u)  # noqa: E731
    return jax.vmap(jax.vmap(one))(qpos, qvel, ctrl)
