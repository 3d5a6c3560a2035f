"""Every effect at every place held against what was measured, along the recorded motion and without simulating it.

A candidate is fitted with θ and the initial states of all windows by `diagnosis.response`, with the force that it
exerts along the motion by `diagnosis.forcing`, and scored on recordings that its fit has not seen. One fit takes
hundredths of a second, so that pairs are tried as well. What comes out on top is then simulated (`diagnosis.bench`).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from bayessim_jax.beliefs.margins import Margin, Margins, log_uniform, uniform
from bayessim_jax.diagnosis.bench import SLOTS, Candidate
from bayessim_jax.diagnosis.forcing import Joint, commands_of, force_of, restore_readings
from bayessim_jax.diagnosis.response import (
    Forcing,
    Linearized,
    Motion,
    Windowed,
    assess,
    cross_validate,
    linearize_steps,
    propose,
)
from bayessim_jax.diagnosis.whiteness import Misfit, judge_misfit
from bayessim_jax.effects import Scales, at, with_effects
from bayessim_jax.effects.drive import CAUTION, actuator_torque, actuators_of, read_numbers
from bayessim_jax.effects.places import find_site
from bayessim_jax.effects.wiring import edit_model
from bayessim_jax.inference.direct import noise_floor
from bayessim_jax.inference.shooting import Shots
from bayessim_jax.systems.mjcf import MjcfSystem, displace

__all__ = ["Screen", "Screened"]

FINE = 4
"""Most time steps in a row at which effects are evaluated."""
ITERATIONS = 6
BEGINNING, KEPT, LASTING = 8, 2, 8
"""Steps of the solver from every point that a candidate is begun from, how many go on, and their further steps."""
MOVED = 0.15
"""Of θ's z: how far it may move before the steps are linearized anew."""
MOMENTS, CLOCK = 8, 2.0
"""Times that are tried for what happens at some time; a parameter in s that may be so many windows long is a time."""
DRAWS = 3
"""Points of its prior from which a candidate of several parameters is begun, beside the usual ones."""


@dataclass
class Screened:
    """A candidate fitted along the motion."""

    candidate: Candidate
    p: Float[Array, " k"]
    """[θ's z, the candidate's x, zeros in the places that are not used]."""
    delta: Float[Array, "windows n"]
    sigma: Float[Array, " obs"]
    likelihood: float
    """Log likelihood at its own noise, up to a constant."""
    scores: Float[np.ndarray, " windows"]
    """Log predictive density of every window."""

    @property
    def score(self) -> float:
        """Sum over windows."""
        return float(self.scores.sum())


class Screen:
    """All pairs of effects and places, and windows of recordings with their smoothed motion."""

    def __init__(
        self,
        system: MjcfSystem,
        margins: Margins,
        pairs: Sequence[tuple[Any, str]],
        scales: Mapping[str, Scales],
        shots: Shots,
        motion: Motion,
        folds: Bool[np.ndarray, "folds windows"],
        step: float = 0.0,
        slots: int = SLOTS,
    ) -> None:
        self.system, self.margins, self.pairs, self.step, self.slots = system, margins, tuple(pairs), step, slots
        self.motion, self.shots, self.folds = motion, shots, jnp.asarray(folds)
        self.parameters = [effect.parameters(place, scales[place]) for effect, place in self.pairs]
        self.margin: list[list[Margin]] = [
            [log_uniform(p.low, p.high) if p.log else uniform(p.low, p.high) for p in each] for each in self.parameters
        ]
        self.model = system.engine.model
        self.sites = [find_site(self.model, place) for _, place in self.pairs]
        self.edits = [k for k, (effect, _) in enumerate(self.pairs) if effect.port == "model"]
        plain: Any = system
        self.edited = with_effects(plain, [self.pairs[k] for k in self.edits], scales) if self.edits else None
        self.engine = self.edited.engine if self.edited else system.engine
        self.floor = noise_floor(shots)
        rows = system.substeps
        self.fine = next(s for s in range(min(FINE, rows), 0, -1) if rows % s == 0)
        self.h = system.dt / self.fine
        self._kept: tuple[Any, Linearized, Windowed] | None = None

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
        """Whether it can be tried here: not a sensor with a memory of something else than a joint, nor too large."""
        for k in candidate.effects:
            effect, _ = self.pairs[k]
            if effect.port == "sense" and self.sites[k].joint < 0:
                return False
            if effect.port in ("force", "act") and self.sites[k].joint < 0:
                return False
        return self.count(candidate) <= self.slots

    def offsets(self, candidate: Candidate) -> list[tuple[int, slice]]:
        """Every effect of a candidate and the places of its parameters in p."""
        found, first = [], self.d
        for k in candidate.effects:
            found.append((k, slice(first, first + len(self.parameters[k]))))
            first += len(self.parameters[k])
        return found

    def starts(self, candidate: Candidate, random: np.random.Generator) -> list[np.ndarray]:
        """Points of a candidate's x to begin from: its start values, mirrored where a sign is open, and draws."""
        each = [(p, m) for k in candidate.effects for p, m in zip(self.parameters[k], self.margin[k], strict=True)]
        begin = np.array([float(m.standard(jnp.asarray(p.start, float))) for p, m in each])
        points = [begin]
        if any(p.low < 0.0 for p, _ in each):
            points.append(-begin)
        clocks = [k for k, (p, _) in enumerate(each) if p.unit == "s" and p.high > CLOCK * self.length]
        for centre in np.linspace(0.0, 1.0, MOMENTS + 2)[1:-1] if clocks else ():
            point = begin.copy()
            for i, k in enumerate(clocks):
                p, m = each[k]
                when = centre + (2 * i - len(clocks) + 1) / (2 * MOMENTS)
                point[k] = float(m.standard(jnp.asarray(p.low + when * (p.high - p.low), float)))
            points.append(point)
        if len(each) > 1 and not clocks:
            points += [0.7 * random.standard_normal(len(each)) for _ in range(DRAWS)]
        return points

    def fit(
        self, candidate: Candidate, p: Float[Array, " k"], delta: Array, sigma: Array, iterations: int = ITERATIONS
    ) -> tuple[Any, ...]:
        """Levenberg-Marquardt from a point; returns (p, δ, curvature, residuals, slopes)."""
        free = jnp.arange(self.d + self.slots) < self.d + self.count(candidate)
        damping = 1e-3
        here: Any = None
        tried = (p, delta)
        for _ in range(iterations):
            there = self._assess(candidate, *tried, sigma)
            cost = float(there[0].cost)
            if np.isfinite(cost) and (here is None or cost <= float(here[2].cost)):
                gain = np.inf if here is None else (float(here[2].cost) - cost) / max(abs(cost), 1e-12)
                here, damping = (*tried, *there), max(damping / 5, 1e-9)
                if gain < 1e-4:
                    break
            elif here is None:
                break
            else:
                damping *= 10
            move, moves = propose(here[2], damping, free, self.shots.spread)
            tried = (here[0] + move, here[1] + moves)
        return here if here is not None else (p, delta, None, None, None)

    def settle(
        self, candidate: Candidate, p: Array, delta: Array, sigma: Array, rounds: int = 2, iterations: int = ITERATIONS
    ) -> Screened | None:
        """Fit a candidate and its noise in turn, and score it."""
        measured = np.asarray(self.shots.measured)
        counts = np.maximum(measured.sum((0, 1)), 1)
        fitted = self.d + self.count(candidate) + delta.size
        share = max(1.0 - fitted / counts.sum(), 0.2)
        r = slopes = None
        for k in range(rounds):
            p, delta, curvature, r, slopes = self.fit(candidate, p, delta, sigma, iterations if k == 0 else 3)
            if curvature is None:
                return None
            squares = (np.asarray(r) ** 2).sum((0, 1)) * np.asarray(sigma) ** 2
            new = jnp.maximum(jnp.asarray(np.sqrt(squares / (counts * share))), self.floor)
            r, slopes = r * (sigma / new), slopes * jnp.broadcast_to(sigma / new, self.shots.y.shape[1:]).reshape(-1)
            sigma = new
        free = jnp.arange(self.d + self.slots) < self.d + self.count(candidate)
        scores = cross_validate(r, slopes, self.shots.measured, p, free, sigma, self.floor, self.folds)
        likelihood = float(-(counts * np.log(np.asarray(sigma))).sum())
        return Screened(candidate, p, delta, sigma, likelihood, np.asarray(scores))

    def begin(self, z: Float[Array, " d"], sigma: Array) -> Screened:
        """The simulator without effects."""
        p = jnp.zeros(self.d + self.slots).at[: self.d].set(z)
        delta = jnp.zeros((len(self.motion.start), 2 * self.model.nv))
        found = self.settle(Candidate(), p, delta, sigma)
        if found is None:
            raise ValueError("the simulator diverges along the recorded motion.")
        return found

    def try_candidate(self, candidate: Candidate, known: Screened, random: np.random.Generator) -> Screened | None:
        """A candidate's best fit, begun from a fit without it; `known` may hold some of its effects already."""
        held = dict(self.offsets(known.candidate))
        added = Candidate(tuple(k for k in candidate.effects if k not in held))
        own, found = dict(self.offsets(added)), []
        for start in self.starts(added, random):
            p = self._put(candidate, known, held, own, start)
            found.append(self.fit(candidate, p, known.delta, known.sigma, BEGINNING))
        found = sorted((f for f in found if f[2] is not None), key=lambda f: float(f[2].cost))[:KEPT]
        ends = [self.fit(candidate, f[0], f[1], known.sigma, LASTING) for f in found]
        ends = [end for end in ends if end[2] is not None]
        if not ends:
            return None
        best = min(ends, key=lambda end: float(end[2].cost))
        return self.settle(candidate, best[0], best[1], known.sigma)

    def misfit(self, key: PRNGKeyArray, found: Screened) -> Misfit:
        """What a candidate leaves of the misfit."""
        _, r, slopes = self._assess(found.candidate, found.p, found.delta, found.sigma)
        n = found.delta.shape[-1]
        unscaled = slopes[:, -n:].reshape(len(slopes), n, *r.shape[1:]) * found.sigma
        residual = np.asarray(r * found.sigma)
        return judge_misfit(key, residual, unscaled.reshape(len(slopes), n, -1), np.asarray(self.shots.measured))

    def glance(self, candidate: Candidate, known: Screened) -> float:
        """The cost of a candidate after a first step from a fit of a part of it."""
        held = dict(self.offsets(known.candidate))
        added = Candidate(tuple(k for k in candidate.effects if k not in held))
        start = self.starts(added, np.random.default_rng(0))[0]
        own = dict(self.offsets(added))
        p = self._put(candidate, known, held, own, start)
        found = self.fit(candidate, p, known.delta, known.sigma, 2)
        return float("inf") if found[2] is None else float(found[2].cost)

    def _put(
        self,
        candidate: Candidate,
        known: Screened,
        held: Mapping[int, slice],
        own: Mapping[int, slice],
        start: np.ndarray,
    ) -> Array:
        """A candidate's p, with what is known of some of its effects and a start for the others."""
        p = jnp.zeros(self.d + self.slots).at[: self.d].set(known.p[: self.d])
        for k, place in self.offsets(candidate):
            x = known.p[held[k]] if k in held else jnp.asarray(start[own[k].start - self.d : own[k].stop - self.d])
            p = p.at[place].set(x)
        return p

    def _numbers(self) -> Any:
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
                jnp.where(
                    on[i] > 0.5,
                    dataclasses.replace(Margin(kind, 0.0, 1.0), a=low[i], b=high[i]).value(x[i]),
                    neutral[i],
                )
                for i, kind in enumerate(kinds)
            ]
            theta = jnp.concatenate([margins.theta(full[:d]), jnp.stack(values)])
            return edit_model(model, writes, wired, theta, d)

        return numbers

    @cached_property
    def numbers(self) -> Any:
        """One function, so that it is traced once."""
        return self._numbers()

    def _full(self, candidate: Candidate, p: Array) -> tuple[Array, Array]:
        """The argument of `numbers`, and what of it p moves."""
        k = self.d + self.slots
        if self.edited is None:
            return p[: self.d], jnp.eye(k, self.d)
        first = dict(zip(self.edits, np.cumsum([0, *(len(self.parameters[e]) for e in self.edits)]), strict=False))
        flat = [(q, m) for e in self.edits for q, m in zip(self.parameters[e], self.margin[e], strict=True)]
        m = len(flat)
        x, on = jnp.zeros(m), np.zeros(m)
        along = np.zeros((k, self.d + 5 * m))
        along[: self.d, : self.d] = np.eye(self.d)
        for e, place in self.offsets(candidate):
            if e in first:
                own = slice(int(first[e]), int(first[e]) + len(self.parameters[e]))
                x, on[own] = x.at[own].set(p[place]), 1.0
                along[range(place.start, place.stop), range(self.d + own.start, self.d + own.stop)] = 1.0
        low, high = ([getattr(mm, side) for _, mm in flat] for side in ("a", "b"))
        neutral = [q.neutral for q, _ in flat]
        parts = (p[: self.d], x, jnp.asarray(on), *(jnp.asarray(v, float) for v in (low, high, neutral)))
        return jnp.concatenate(parts), jnp.asarray(along)

    def _assess(self, candidate: Candidate, p: Array, delta: Array, sigma: Array) -> tuple[Any, ...]:
        motion, readings = self._restored(candidate, p)
        edited = [k for k in candidate.effects if self.pairs[k][0].port in ("model", "sense")]
        lin, windowed, at_p = self._linearized(candidate, p, motion, fresh=bool(edited))
        forcing = self._forcing(candidate, p, lin, motion, windowed, readings)
        moved = (p - at_p).at[self.d :].set(0.0)
        return assess(lin, windowed, forcing, moved, p, delta, sigma)

    def _linearized(
        self, candidate: Candidate, p: Array, motion: Motion, fresh: bool
    ) -> tuple[Linearized, Windowed, Array]:
        """Steps around the motion: those of before, where neither the model nor the motion nor θ has changed much."""
        if not fresh and self._kept is not None:
            near = float(jnp.abs(p - self._kept[0])[: self.d].max(initial=0.0)) < MOVED
            if near:
                return self._kept[1], self._kept[2], self._kept[0]
        full, along = self._full(candidate, p)
        lin = linearize_steps(self.engine, self.numbers, motion, full, along, self.system.substeps, self.step)
        windowed = self._windowed(p, motion)
        if not fresh:
            self._kept = (p, lin, windowed)
        return lin, windowed, p

    def _windowed(self, p: Array, motion: Motion) -> Windowed:
        seen, c = _see(self.system, self.margins.theta(p[: self.d]), motion)
        return Windowed(self.shots.y, self.shots.measured, seen, c, self.shots.spread)

    def _restored(self, candidate: Candidate, p: Array) -> tuple[Motion, list[tuple[int, Array, Array]]]:
        """The true motion behind what sensors with effects showed: channel, ∂q/∂x and ∂q/∂reading."""
        motion, readings = self.motion, []
        for k, place in self.offsets(candidate):
            effect, name = self.pairs[k]
            if effect.port != "sense":
                continue
            joint = self.sites[k].joint
            q, v = int(self.model.jnt_qposadr[joint]), int(self.model.jnt_dofadr[joint])
            channels = [c.name for c in self.system.channels]
            velocity = motion.qvel[..., v]
            acceleration = jnp.asarray(jnp.gradient(velocity, self.system.dt, axis=1))
            jerk = jnp.asarray(jnp.gradient(acceleration, self.system.dt, axis=1))
            low, high = self._range(k)
            new_q, new_v, along, slope = restore_readings(
                effect,
                self._kinds(k),
                self.system.dt,
                p[place],
                low,
                high,
                self._row_times(),
                motion.qpos[..., q],
                velocity,
                acceleration,
                jerk,
            )
            qpos, qvel = motion.qpos.at[..., q].set(new_q), motion.qvel
            if name.removesuffix("/qpos") + "/qvel" not in channels:
                qvel = qvel.at[..., v].set(new_v)
            motion = dataclasses.replace(motion, qpos=qpos, qvel=qvel)
            readings.append((channels.index(at(name)), along, slope))
        return motion, readings

    def _row_times(self) -> Float[Array, "windows rows"]:
        return self.motion.start[:, None] + self.system.dt * jnp.arange(self.motion.qpos.shape[1])

    def _kinds(self, k: int) -> Any:
        return tuple((p.name, m.kind) for p, m in zip(self.parameters[k], self.margin[k], strict=True))

    def _range(self, k: int) -> tuple[Array, Array]:
        return jnp.asarray([m.a for m in self.margin[k]], float), jnp.asarray([m.b for m in self.margin[k]], float)

    def _forcing(
        self, candidate: Candidate, p: Array, lin: Linearized, motion: Motion, windowed: Windowed, readings: Any
    ) -> Forcing:
        windows, rows = motion.ctrl.shape[:2]
        nv, k = self.model.nv, self.d + self.slots
        force, along = jnp.zeros((windows, rows, nv)), jnp.zeros((windows, rows, nv, k))
        for e, place in self.offsets(candidate):
            effect = self.pairs[e][0]
            if effect.port not in ("force", "act"):
                continue
            low, high = self._range(e)
            site = self.sites[e]
            if effect.port == "force":
                joint = self._joint(site.joint, lin, motion, p, site.actuators)
                other = self._joint(site.other, lin, motion, p, ()) if site.other >= 0 else None
                f, slopes = force_of(
                    effect,
                    self._kinds(e),
                    site.detail,
                    self.h,
                    self.fine,
                    p[place],
                    low,
                    high,
                    self._times,
                    joint,
                    other,
                )
                dof = int(self.model.jnt_dofadr[site.joint])
                force, along = force.at[..., dof].add(f), along.at[..., dof, place].add(slopes)
                continue
            changes, slopes = self._changes(e, p[place], lin, motion, p)
            for i, actuator in enumerate(site.actuators):
                dof = int(self.model.jnt_dofadr[self._driven(actuator)])
                gain = self._gain(actuator, p)
                force = force.at[..., dof].add(gain * changes[..., i])
                along = along.at[..., dof, place].add(gain * slopes[..., i, :])
        scale, shift = jnp.ones_like(windowed.seen), jnp.zeros_like(windowed.seen)
        reading_along = jnp.zeros((*windowed.seen.shape, k))
        sensed = [place for e, place in self.offsets(candidate) if self.pairs[e][0].port == "sense"]
        for (channel, own, slope), place in zip(readings, sensed, strict=True):
            # the reading of a restored motion is what it was restored from: s(x, q(x, r)) = r
            s = 1.0 / slope
            scale = scale.at[..., channel].set(s)
            raw = self._windowed(p, self.motion).seen[..., channel]
            shift = shift.at[..., channel].set(raw - s * windowed.seen[..., channel])
            reading_along = reading_along.at[..., channel, place].set(-s[..., None] * own)
        return Forcing(force, along, scale, shift, reading_along)

    @cached_property
    def _times(self) -> Float[Array, "windows steps"]:
        steps = self.motion.ctrl.shape[1] * self.fine
        return self.motion.start[:, None] + self.h * jnp.arange(steps)

    def _theta_numbers(self, p: Array) -> Any:
        return read_numbers(self.model, self.system.engine.writes, self.margins.theta(p[: self.d]))

    def _driven(self, actuator: int) -> int:
        return int(self.model.actuator_trnid[actuator, 0])

    def _gain(self, actuator: int, p: Array) -> Any:
        numbers = self._theta_numbers(p)
        return numbers("actuator_gear", actuator, 0) * numbers("actuator_gainprm", actuator, 0)

    def _spread(self, rows: Float[Array, "windows rows"]) -> Float[Array, "windows steps"]:
        """The value of a row for all of its time steps."""
        return jnp.repeat(rows, self.fine, axis=1)

    def _between(self, rows: Float[Array, "windows rows"]) -> Float[Array, "windows steps"]:
        """On a line between rows."""
        f = jnp.arange(self.fine) / self.fine
        return (rows[:, :-1, None] * (1 - f) + rows[:, 1:, None] * f).reshape(len(rows), -1)

    def _joint(self, joint: int, lin: Linearized, motion: Motion, p: Array, actuators: Sequence[int]) -> Joint:
        q, v = int(self.model.jnt_qposadr[joint]), int(self.model.jnt_dofadr[joint])
        nv = self.model.nv
        push = lin.b[..., nv + v, v]
        inertia = CAUTION * self.system.dt / jnp.maximum(push, 1e-12)
        rise = lin.gap[..., nv + v] + motion.qvel[:, 1:, v] - motion.qvel[:, :-1, v]
        position, velocity = self._between(motion.qpos[..., q]), self._between(motion.qvel[..., v])
        drive, numbers = jnp.zeros_like(position), self._theta_numbers(p)
        for i in actuators or actuators_of(self.model, joint):
            command = self._spread(motion.ctrl[..., i])
            drive = drive + actuator_torque(self.model, numbers, i, command, position, velocity)
        return Joint(position, velocity, self._spread(rise / self.system.dt), self._spread(inertia), drive)

    def _changes(self, e: int, x: Array, lin: Linearized, motion: Motion, p: Array) -> tuple[Array, Array]:
        effect, _ = self.pairs[e]
        site = self.sites[e]
        low, high = self._range(e)
        joint = self._joint(site.joint, lin, motion, p, ())
        rows = motion.ctrl
        before = 0 if effect.looks else motion.past.shape[1] * self.fine
        if before:
            rows = jnp.concatenate([motion.past, rows], 1)
            joint = jax.tree.map(lambda a: jnp.concatenate([jnp.repeat(a[:, :1], before, 1), a], 1), joint)
        commands = jnp.repeat(rows, self.fine, axis=1)
        for i in range(self.model.nu):
            if self.model.actuator_ctrllimited[i]:
                span = self.model.actuator_ctrlrange[i]
                commands = commands.at[..., i].set(jnp.clip(commands[..., i], *(float(b) for b in span)))
        times = self._times[:, :1] + self.h * jnp.arange(-before, self._times.shape[1])
        picked = commands[..., list(site.actuators)]
        gain = jnp.asarray(self._gain(site.actuators[0], p), float)
        return commands_of(effect, self._kinds(e), self.h, self.fine, before, x, low, high, times, joint, picked, gain)


def _see_one(system: MjcfSystem, theta: Array, qpos: Array, qvel: Array, ctrl: Array) -> tuple[Array, Array]:
    model = system.engine.model
    nv = model.nv

    def see(move: Array) -> Array:
        state = system.begin(theta, displace(model, qpos, move[:nv]), qvel + move[nv:])
        return system.observe(theta, dataclasses.replace(state, ctrl=ctrl))

    zero = jnp.zeros(2 * nv)
    return see(zero), jax.vmap(lambda d: jax.jvp(see, (zero,), (d,))[1], out_axes=-1)(jnp.eye(2 * nv))


def _see(system: MjcfSystem, theta: Array, motion: Motion) -> tuple[Array, Array]:
    """Readings of the motion, and how they change with a deviation."""
    ctrl = jnp.concatenate([motion.ctrl, motion.ctrl[:, -1:]], 1)
    return _see_all(system, theta, motion.qpos, motion.qvel, ctrl)


@jax.jit
def _see_all(system: MjcfSystem, theta: Array, qpos: Array, qvel: Array, ctrl: Array) -> tuple[Array, Array]:
    one = lambda q, v, u: _see_one(system, theta, q, v, u)  # noqa: E731
    return jax.vmap(jax.vmap(one))(qpos, qvel, ctrl)
