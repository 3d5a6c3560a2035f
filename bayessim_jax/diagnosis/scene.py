"""The recorded motion with effects along it: what a candidate would change in what was measured, without simulating.

Effects of the three ports exert forces, change commands or distort readings along the smoothed motion; effects on the
model change the steps around it. What does not depend on a candidate is computed once.
"""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from bayessim_jax.beliefs.margins import Margin, Margins, values_between
from bayessim_jax.diagnosis.bench import SLOTS, Candidate, CandidatesOf, margin_of_effect
from bayessim_jax.diagnosis.forcing import Joint, Partners, Passed, commands_of, force_of, pass_on, restore_readings
from bayessim_jax.diagnosis.response import (
    Beside,
    Forcing,
    Linearized,
    Motion,
    Readings,
    Rest,
    Ways,
    Windowed,
    assess,
    bound_gains,
    differ,
    expand_response,
    find_gaps,
    find_heavier,
    move_steps,
    respond,
    weigh,
)
from bayessim_jax.effects import Scales, at, with_effects
from bayessim_jax.effects.contract import Numbers
from bayessim_jax.effects.drive import CAUTION, actuators_of, drive_of, read_numbers
from bayessim_jax.effects.history import split_history
from bayessim_jax.effects.places import find_site, has_rate
from bayessim_jax.effects.wiring import Wired, edit_model
from bayessim_jax.engines.contract import Engine
from bayessim_jax.engines.fields import Write
from bayessim_jax.inference.arrow import Curvature
from bayessim_jax.inference.shooting import COMPILER_OPTIONS, Shots
from bayessim_jax.systems.mjcf import MjcfSystem, displace

__all__ = ["Scene"]

FINE = 4
"""Most time steps in a row at which effects are evaluated."""
MOVED = 0.03
"""How far θ's z and parameters of effects on the model may move before it is found anew where the steps lead."""
TOGETHER = 8
"""Points beside a motion in a program."""
AWAY = 1.0
"""Of θ's z at least, for how what withstands forces grows with it."""
HOMES = 8
"""Points around which the steps were linearized that are kept."""
NOISES = 3
"""Of each of them the last ones for which the response is kept over σ."""
PIECES, LITTLE = 16, 0.3
"""Of a window, in which a force that may be any is constant; and share of what one explains, beyond noise, where it
explains most."""
FEW = 3
"""Parameters of most candidates: programs with room for no more are as many times faster."""


@dataclass
class _Around:
    """Steps around a motion, and what effects see of its joints."""

    edits: tuple[tuple[int, int], ...]
    """Effects on the model, and where the parameters of each begin in p."""
    p: Float[np.ndarray, " k"]
    """θ and the parameters of effects on the model, where it was found what the steps lead to."""
    motion: Motion
    lin: Linearized
    windowed: Windowed
    shared: Float[np.ndarray, "windows dn rowsobs"]
    """How readings move with θ's z and initial states."""
    weighed: dict[bytes, Rest]
    """The same over σ."""
    kept: dict[Any, Any] = field(default_factory=dict)


class Scene(CandidatesOf):
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
        self.motion, self.shots, self.d = motion, shots, margins.size
        self.parameters = [effect.parameters(place, scales[place]) for effect, place in self.pairs]
        self.margin: list[list[Margin]] = [[margin_of_effect(p) for p in each] for each in self.parameters]
        self.names = [tuple(p.name for p in each) for each in self.parameters]
        self.model = system.engine.model
        self.sites = [find_site(self.model, place) for _, place in self.pairs]
        self.edits = [k for k, (effect, _) in enumerate(self.pairs) if effect.port == "model"]
        plain: Any = system
        self.edited = with_effects(plain, [self.pairs[k] for k in self.edits], scales) if self.edits else None
        self.engine = self.edited.engine if self.edited else system.engine
        edits = tuple(self.pairs[k] for k in self.edits)
        kinds = tuple(m.kind for k in self.edits for m in self.margin[k])
        wired = self.edited.effects if self.edited else ()
        self.numbers = _EngineNumbers(self.engine, system.engine.writes, margins, edits, kinds, wired)
        rows = system.substeps
        self.fine = next(s for s in range(min(FINE, rows), 0, -1) if rows % s == 0)
        self.h = system.dt / self.fine
        self.times = _device(np.asarray(motion.start)[:, None] + self.h * np.arange(motion.ctrl.shape[1] * self.fine))
        self.length = step or float(jnp.finfo(float).eps) ** (1 / 3)
        self._homes: dict[Any, _Around] = {}
        self._base: _Around | None = None
        self._recent: _Around | None = None
        self._heavier: Array | None = None
        self._kept: dict[Any, Any] = {}

    def twin(self) -> Scene:
        """The same scene for another thread: what is kept from fit to fit is its own, compiled programs are shared."""
        twin = copy.copy(self)
        twin._homes, twin._base, twin._recent, twin._kept = {}, None, None, {}
        return twin

    def takes(self, candidate: Candidate) -> bool:
        """Whether it can be tried here: not at something else than a joint, nor with too many parameters."""
        placed = (self.pairs[k][0].port == "model" or self.sites[k].joint >= 0 for k in candidate.effects)
        return all(placed) and self.count(candidate) <= self.slots

    def apart(self, candidate: Candidate) -> list[tuple[Candidate, tuple[int, ...]]]:
        """What stands for an effect of several actuators with one for each: nothing, for each has its own here."""
        return []

    def assess(
        self, candidate: Candidate, p: Float[np.ndarray, " k"], delta: Float[Array, "windows n"], sigma: Array
    ) -> tuple[Curvature, Float[np.ndarray, "windows rows obs"]]:
        """Normal equations at a point, and residuals over σ."""
        around, forcing, moved = self._force(candidate, p)
        rest = self._weigh(around, sigma)
        return assess(around.lin, rest, around.windowed, forcing, moved, p, delta, sigma)

    def expand(
        self, candidate: Candidate, p: Float[np.ndarray, " k"], delta: Float[Array, "windows n"], sigma: Array
    ) -> tuple[Float[np.ndarray, "windows rows obs"], Float[np.ndarray, "windows kn rowsobs"]]:
        """Residuals over σ at a point, and derivatives of what is predicted over σ."""
        around, forcing, moved = self._force(candidate, p)
        rest = self._weigh(around, sigma)
        return expand_response(around.lin, rest, around.windowed, forcing, moved, delta, sigma)

    def reach(
        self, candidate: Candidate, p: Float[np.ndarray, " k"], delta: Float[Array, "windows n"], sigma: Array
    ) -> list[int]:
        """Pairs that may explain much of what a fit leaves: no forces on a joint where any force would do little."""
        around, forcing, moved = self._force(candidate, p)
        seen = (around.lin, self._weigh(around, sigma), around.windowed, forcing, moved)
        gains = bound_gains(*seen, p, delta, sigma, pieces=PIECES)
        # of noise alone: half of χ² with a degree of freedom for every piece
        noise = 0.5 * PIECES * len(delta)
        excess, sd = gains - noise, np.sqrt(noise)
        enough = ~(excess < LITTLE * excess.max() - 2.0 * sd) | ~(excess.max() > 3.0 * sd)
        forced = [
            effect.port in ("act", "force") and site.joint >= 0
            for (effect, _), site in zip(self.pairs, self.sites, strict=True)
        ]
        return [k for k, site in enumerate(self.sites) if not forced[k] or enough[self._dof(site.joint)]]

    def _weigh(self, around: _Around, sigma: Array) -> Rest:
        """How readings over σ move with θ's z and initial states."""
        key, kept = np.asarray(sigma).tobytes(), around.weighed
        found = kept.pop(key, None)
        kept[key] = found if found is not None else weigh(around.shared, around.windowed, sigma)
        if len(kept) > NOISES:
            del kept[next(iter(kept))]
        return kept[key]

    def _force(self, candidate: Candidate, p: Float[np.ndarray, " k"]) -> tuple[_Around, Forcing, np.ndarray]:
        """What a candidate exerts and distorts, and how far p is from where the steps were found."""
        motion, readings = self._restored(candidate, p)
        around = self._find_around(candidate, p, motion)
        (windows, rows, _), nv = self.motion.ctrl.shape, self.model.nv
        size = FEW if self.count(candidate) <= FEW and not readings else self.slots
        pushes = _Pushes(np.zeros((windows, rows, nv)), np.zeros((windows, rows, nv, size)))
        self._drive(candidate, p, around, pushes)
        exerting = [(k, place) for k, place in self.offsets(candidate) if self.pairs[k][0].port == "force"]
        # what holds a joint withstands what the others exert on it
        for k, place in sorted(exerting, key=lambda item: self.pairs[item[0]][0].holds):
            self._exert(candidate, k, p, place, around, pushes)
        raw = np.asarray(self._windowed(p, self.motion).seen) if readings else np.zeros(0)
        forcing = Forcing(
            pushes.force, pushes.along, _distort(np.asarray(around.windowed.seen), raw, readings, nv, size)
        )
        return around, forcing, np.where(self._steps(candidate), p - around.p, 0.0)

    def states(self, delta: Float[Array, "windows n"]) -> list[Float[Array, "windows n"]]:
        """Initial states to begin from beside those of a fit: none, for every fit is close to the recorded motion."""
        return [delta]

    def begin_around(self, candidate: Candidate, p: Float[Array, " k"] | np.ndarray) -> None:
        """Linearize the steps around a candidate's point, for the fits that follow.

        They move the simulator's parameters and effects on the model: where the steps lead is found anew then, and what
        becomes of deviations from there is taken from here. It errs by products of the two, for each candidate alike.
        """
        steps = self._steps(candidate)
        senses = [place for k, place in self.offsets(candidate) if self.pairs[k][0].port == "sense"]
        x = np.asarray(p)
        key = (self._edits(candidate), np.where(steps, x, 0.0).tobytes(), tuple(x[s].tobytes() for s in senses))
        if key not in self._homes:
            if len(self._homes) >= HOMES:
                del self._homes[next(iter(self._homes))]
            self._homes[key] = self._linearize(candidate, x)
        self._base = self._recent = self._homes[key]

    def approach(self, candidate: Candidate, p: Float[Array, " k"] | np.ndarray) -> None:
        """The same where a candidate's point is far from where the steps are linearized."""
        assert self._base is not None
        senses = any(self.pairs[k][0].port == "sense" for k in candidate.effects)
        if senses or self._base.edits != self._edits(candidate) or self._is_far(candidate, np.asarray(p), self._base):
            self.begin_around(candidate, p)

    def _edits(self, candidate: Candidate) -> tuple[tuple[int, int], ...]:
        """A candidate's effects on the model, and where the parameters of each begin in p."""
        return tuple((k, place.start) for k, place in self.offsets(candidate) if k in self.edits)

    def _is_far(self, candidate: Candidate, p: Float[np.ndarray, " k"], around: _Around) -> bool:
        """Whether a point's steps lead elsewhere than derivatives there tell."""
        return bool(np.abs(p - around.p)[self._steps(candidate)].max(initial=0.0) >= MOVED)

    def _steps(self, candidate: Candidate) -> Bool[np.ndarray, " k"]:
        """What of p changes the steps themselves: θ, and parameters of effects on the model."""
        found = np.arange(self.d + self.slots) < self.d
        for k, place in self.offsets(candidate):
            found[place] = k in self.edits
        return found

    def _full(self, candidate: Candidate, p: Float[np.ndarray, " k"]) -> Float[np.ndarray, " m"]:
        """The argument of `numbers`."""
        if self.edited is None:
            return p[: self.d]
        first = dict(zip(self.edits, np.cumsum([0, *(len(self.parameters[e]) for e in self.edits)]), strict=False))
        flat = [(q, m) for e in self.edits for q, m in zip(self.parameters[e], self.margin[e], strict=True)]
        x, on = np.zeros(len(flat)), np.zeros(len(flat))
        for e, place in self.offsets(candidate):
            if e in first:
                own = slice(int(first[e]), int(first[e]) + len(self.parameters[e]))
                x[own], on[own] = p[place], 1.0
        low, high = ([getattr(mm, side) for _, mm in flat] for side in ("a", "b"))
        neutral = [q.neutral for q, _ in flat]
        return np.concatenate([p[: self.d], x, on, *(np.asarray(v, float) for v in (low, high, neutral))])

    def _linearize(self, candidate: Candidate, p: Float[np.ndarray, " k"]) -> _Around:
        """Steps linearized around the motion behind what the sensors showed."""
        return self._step_from(candidate, p, self._restored(candidate, p)[0])

    def _step_from(
        self, candidate: Candidate, p: Float[np.ndarray, " k"], motion: Motion, base: _Around | None = None
    ) -> _Around:
        """Where the steps lead at a point; most derivatives are those of a `base`, if there is one."""
        moves = [i for k, place in self.offsets(candidate) if k in self.edits for i in range(place.start, place.stop)]
        exerts = any(self.pairs[k][0].port in ("force", "act") for k in candidate.effects)
        lin = None
        if base and not moves and not base.edits:
            x, shift = self._full(candidate, p), self._theta(p) - self._theta(base.p)
            at_work = (base.lin.b, self._heavier, shift, self.system.substeps)
            gap, b, gives_way = move_steps(self.engine, self.numbers, motion, x, *at_work)
            lin = dataclasses.replace(base.lin, gap=gap, b=b) if gives_way else None
        if lin is None:
            forced = base is None or exerts
            count, beside, ways = self._look_beside(candidate, p, moves, forced, base is None)
            gaps = self._find_gaps(motion, beside, count)
            lin = differ(base.lin if base else None, gaps, ways, forced, self.step > 0.0)
        if self._heavier is None and self.d:
            self._heavier = self._find_heavier(candidate, p, motion, lin)
        kept, windowed = np.where(self._steps(candidate), p, 0.0), self._windowed(p, motion)
        shared, weighed = (base.shared, base.weighed) if base else (respond(lin, windowed, self.d), {})
        return _Around(self._edits(candidate), kept, motion, lin, windowed, shared, weighed)

    def _look_beside(
        self, candidate: Candidate, p: Float[np.ndarray, " k"], moves: Sequence[int], forced: bool, whole: bool
    ) -> tuple[int, Beside, Ways]:
        """Points from which steps are taken, how many of them matter, and what they lie along.

        Along a candidate's own parameters of the model; along forces where it is `forced`, of a size that moves a
        velocity by about `length`; along the state and θ if the steps are linearized as a `whole`.
        """
        d, nv, m, length = self.d, self.model.nv, len(moves), self.length
        width = np.full(self.slots + 3 * nv + d, length)
        width[m : m + nv] = self._pushing
        sides = (1.0, -1.0) if self.step else (1.0,)
        beside = self._stay(candidate, p, 1 + len(sides) * len(width))
        points, move, force = beside.x, beside.move, beside.force
        for k, side in enumerate(sides, 1):
            rows = k + len(sides) * np.arange(len(width))
            for row, i in zip(rows, moves, strict=False):
                points[row] = self._full(candidate, p + side * length * (np.arange(p.size) == i))
            force[rows[m : m + nv], np.arange(nv)] = side * width[m : m + nv]
            move[rows[m + nv : m + 3 * nv], np.arange(2 * nv)] = side * length
            points[rows[m + 3 * nv : m + 3 * nv + d], np.arange(d)] += side * length
        own, places = np.zeros(self.slots, int), np.full(self.slots, d + self.slots)
        own[:m], places[:m] = np.arange(m), moves
        after = m + np.arange(3 * nv + d)
        used = m + nv * forced + (2 * nv + d) * whole
        ways = Ways(len(sides) * width, own, places, after[:nv], after[nv : 3 * nv], after[3 * nv :])
        return 1 + len(sides) * used, beside, ways

    def _stay(self, candidate: Candidate, p: Float[np.ndarray, " k"], count: int) -> Beside:
        """So many points that lie on the motion and have no force."""
        nv = self.model.nv
        return Beside(np.tile(self._full(candidate, p), (count, 1)), np.zeros((count, 2 * nv)), np.zeros((count, nv)))

    def _find_gaps(self, motion: Motion, beside: Beside, count: int) -> Float[Array, "k windows steps n"]:
        """Where steps from the first `count` points lead, by one program for few points and many; 0 for the others."""
        found = []
        for first in range(0, len(beside.x), TOGETHER):
            some = jax.tree.map(lambda x: np.resize(x[first : first + TOGETHER], (TOGETHER, x.shape[1])), beside)  # noqa: B023
            here = min(max(count - first, 0), len(beside.x) - first)
            found.append(find_gaps(self.engine, self.numbers, motion, some, here, self.system.substeps))
        return (jnp.concatenate(found) if len(found) > 1 else found[0])[: len(beside.x)]

    @property
    def _pushing(self) -> Float[np.ndarray, " nv"]:
        """Forces that move a velocity by about `length` in a row."""
        return self.length / (self.system.dt * np.maximum(self.model.dof_invweight0, 1e-12))

    def _find_heavier(self, candidate: Candidate, p: Float[np.ndarray, " k"], motion: Motion, lin: Linearized) -> Array:
        """How what withstands forces grows with θ, from where each by itself is at or towards its usual value.

        The same at every θ where it is linear in that, as in masses, and along motions that are near, as those are that
        sensors distort.
        """
        nv, every, by = self.model.nv, [], []
        for j in range(self.d):
            away = np.copysign(max(AWAY, abs(p[j])), p[j])
            there = p - away * (np.arange(p.size) == j)
            force = np.concatenate([np.zeros((1, nv)), np.diag(self._pushing)])
            beside = dataclasses.replace(self._stay(candidate, there, 1 + nv), force=force)
            every.append(self._find_gaps(motion, beside, 1 + nv)[: 1 + nv])
            by.append(self._theta(there)[j] - self._theta(p)[j])
        return find_heavier(lin, jnp.stack(every), self._pushing, np.array(by))

    def _theta(self, p: Float[np.ndarray, " k"]) -> Float[np.ndarray, " d"]:
        return np.asarray(self.margins.theta(np.asarray(p[: self.d])))

    def _find_around(self, candidate: Candidate, p: Float[np.ndarray, " k"], motion: Motion) -> _Around:
        """Steps around the motion: those of before, where neither the motion nor the model has changed much."""
        if self._base is None:
            self.begin_around(candidate, p)
        for kept in (self._recent, self._base):
            assert kept is not None
            alike = kept.motion is motion and kept.edits == self._edits(candidate)
            if alike and not self._is_far(candidate, p, kept):
                return kept
        assert self._base is not None
        around = self._step_from(candidate, p, motion, self._base)
        if motion is self.motion:
            self._recent = around
        return around

    def _windowed(self, p: np.ndarray, motion: Motion) -> Windowed:
        seen, c = _see_all(self.system, self.margins, p[: self.d], motion.qpos, motion.qvel, motion.ctrl, self.step)
        return Windowed(self.shots.y, self.shots.measured, seen, c, self.shots.spread)

    @cached_property
    def _rates(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Times of all rows, and accelerations and their rates along the motion."""
        return self._rates_of(np.arange(self.motion.qvel.shape[1]), self.motion.qvel)

    @cached_property
    def _rates_before(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The same before the windows."""
        assert self.motion.earlier is not None
        return self._rates_of(np.arange(-self.motion.earlier[1].shape[1], 0), self.motion.earlier[1])

    def _rates_of(self, rows: np.ndarray, qvel: Array) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The same of rows by their numbers, from the first of a window on."""
        dt = self.system.dt
        acceleration = np.gradient(np.asarray(qvel), dt, axis=1)
        return np.asarray(self.motion.start)[:, None] + dt * rows, acceleration, np.gradient(acceleration, dt, axis=1)

    def _restored(self, candidate: Candidate, p: np.ndarray) -> tuple[Motion, list[_Reading]]:
        """The true motion behind what sensors with effects showed, and what these do to readings of it."""
        sensors = [(k, place) for k, place in self.offsets(candidate) if self.pairs[k][0].port == "sense"]
        if not sensors:
            return self.motion, []
        qpos, qvel, readings = np.array(self.motion.qpos), np.array(self.motion.qvel), []
        recalls = any(self.pairs[k][0].port == "force" and self.pairs[k][0].recalls for k in candidate.effects)
        earlier = tuple(map(np.array, self.motion.earlier)) if self.motion.earlier is not None and recalls else None
        channels = [c.name for c in self.system.channels]
        for k, place in sensors:
            effect, name = self.pairs[k]
            q, v = int(self.model.jnt_qposadr[self.sites[k].joint]), self._dof(self.sites[k].joint)
            prompt = has_rate(name, channels)
            rows, *rates = self._rates
            seen = (rows, qpos[..., q], qvel[..., v], *(rate[..., v] for rate in rates))
            found = restore_readings(
                effect, self.names[k], self.system.dt, prompt, *self._numbers_at(k, p[place]), *seen
            )
            qpos[..., q], new_v, along, along_v, slope = found
            if prompt:
                along_v = np.zeros_like(along_v)
            else:
                qvel[..., v] = new_v
            if earlier is not None:
                rows, *rates = self._rates_before
                seen = (rows, earlier[0][..., q], earlier[1][..., v], *(rate[..., v] for rate in rates))
                past = restore_readings(
                    effect, self.names[k], self.system.dt, prompt, *self._numbers_at(k, p[place]), *seen
                )
                earlier[0][..., q], earlier[1][..., v] = past[0], earlier[1][..., v] if prompt else past[1]
            own = slice(place.start - self.d, place.stop - self.d)
            readings.append(_Reading(channels.index(at(name)), v, own, along, along_v, slope))
        restored = dataclasses.replace(self.motion, qpos=_device(qpos), qvel=_device(qvel))
        if earlier is not None:
            restored = dataclasses.replace(restored, earlier=tuple(map(_device, earlier)))
        return restored, readings

    def _drive(self, candidate: Candidate, p: Float[np.ndarray, " k"], around: _Around, pushes: _Pushes) -> None:
        """What a candidate's effects on commands change in forces: those of the same actuators one after the other."""
        for actuators, effects in self._acting(candidate).items():
            gains = self._gains(actuators, around)
            if len(effects) == 1:
                (k, place) = effects[0]
                effect, joint = self.pairs[k][0], self._joint(self.sites[k].joint, around, ())
                commands, older, coarse, before = self._commands(actuators, effect.looks)
                seen = (*self._numbers_at(k, p[place]), self.times, joint, commands, older, gains)
                f, along = commands_of(effect, self.names[k], self.h, self.fine, before, coarse, *seen)
                columns = slice(place.start - self.d, place.stop - self.d)
            else:
                f, along = self._pass_all(effects, p, around, pushes.along.shape[-1])
                columns = slice(None)
            for i, actuator in enumerate(actuators):
                dof = self._dof(int(self.model.actuator_trnid[actuator, 0]))
                pushes.add(dof, f[..., i], along[..., i, :], columns, drives=True)

    def _acting(self, candidate: Candidate) -> dict[tuple[int, ...], list[tuple[int, slice]]]:
        """A candidate's effects on commands in their order, and their places in p, by the actuators."""
        groups: dict[tuple[int, ...], list[tuple[int, slice]]] = {}
        for k, place in self.offsets(candidate):
            if self.pairs[k][0].port == "act":
                groups.setdefault(tuple(self.sites[k].actuators), []).append((k, place))
        return groups

    def _pass_all(
        self, effects: Sequence[tuple[int, slice]], p: Float[np.ndarray, " k"], around: _Around, size: int
    ) -> tuple[Float[np.ndarray, "windows rows act"], Float[np.ndarray, "windows rows act e"]]:
        """What effects on the same commands change in forces together, and its derivatives along a candidate's x."""
        actuators = self.sites[effects[0][0]].actuators
        gains = self._gains(actuators, around)
        raw, older, coarse, before = map(np.asarray, self._commands(actuators, False))
        before, coarse = int(before), float(coarse)
        passed = Passed(raw, older, np.zeros((size, *raw.shape)), np.zeros((size, *older.shape)))
        for k, place in effects:
            effect, joint = self.pairs[k][0], self._joint(self.sites[k].joint, around, ())
            # an effect that looks at the joint has not seen what was before
            unseen = before if effect.looks else 0
            own, numbers = self._ways(place, size), self._numbers_at(k, p[place])
            here = Passed(passed.commands[:, unseen:], passed.older, passed.along[:, :, unseen:], passed.older_along)
            seen = (numbers[0], own * numbers[1], self.times, joint, here, gains)
            new = pass_on(effect, self.names[k], self.h, before - unseen, coarse, *seen)
            if unseen:
                commands = np.concatenate([passed.commands[:, :unseen], new.commands], 1)
                along = np.concatenate([passed.along[:, :, :unseen], new.along], 2)
                new = dataclasses.replace(passed, commands=commands, along=along)
            passed = new
        rows = (len(raw), -1, self.fine, len(gains))
        f = gains * (passed.commands - raw)[:, before:].reshape(rows).mean(2)
        along = gains * passed.along[:, :, before:].reshape(size, *rows).mean(3)
        return f, np.moveaxis(along, 0, -1)

    def _exert(
        self,
        candidate: Candidate,
        k: int,
        p: Float[np.ndarray, " k"],
        place: slice,
        around: _Around,
        pushes: _Pushes,
    ) -> None:
        """Add what one of a candidate's effects exerts on its joint, under what others exert there."""
        effect, site, dof = self.pairs[k][0], self.sites[k], self._dof(self.sites[k].joint)
        joint = self._joint(site.joint, around, site.actuators)
        other = self._joint(site.other, around, ()) if site.other >= 0 else None
        earlier = self._earlier(site.joint, around) if effect.recalls else None
        numbers, partners = self._numbers_at(k, p[place]), None
        columns = slice(place.start - self.d, place.stop - self.d)
        if dof in pushes.at and (effect.holds or effect.feels):
            size = pushes.along.shape[-1]
            joint, partners = pushes.beside(dof, joint, self._ways(place, size) * numbers[1], self.fine)
            columns = slice(None)
            if earlier is not None and dof in pushes.drives:
                change, along = self._driven_before(candidate, p, site.joint, around, size)
                earlier = (*earlier[:2], np.asarray(earlier[2]) + change)
                partners = dataclasses.replace(partners, before=along)
        seen = (self.h, self.fine, *numbers, self.times, joint, other, earlier, self.system.dt, partners)
        f, along = force_of(effect, self.names[k], site.detail, *seen)
        pushes.add(dof, f, along, columns)

    def _driven_before(
        self, candidate: Candidate, p: Float[np.ndarray, " k"], joint: int, around: _Around, size: int
    ) -> tuple[Float[np.ndarray, "windows before"], Float[np.ndarray, "e windows before"]]:
        """What effects on commands changed in what actuators exerted on a joint before the windows; its derivatives.

        A row is a step of what they remember, and the first command of all had been held for long.
        """
        assert around.motion.earlier is not None
        position, velocity = (
            np.asarray(x)[..., i]
            for x, i in zip(around.motion.earlier, (int(self.model.jnt_qposadr[joint]), self._dof(joint)), strict=True)
        )
        past, dt = np.asarray(self.motion.past), self.system.dt
        times = np.asarray(self.motion.start)[:, None] + dt * np.arange(-past.shape[1], 0)
        change, slopes = np.zeros(past.shape[:2]), np.zeros((size, *past.shape[:2]))
        for actuators, effects in self._acting(candidate).items():
            own = [i for i, a in enumerate(actuators) if int(self.model.actuator_trnid[a, 0]) == joint]
            if not own:
                continue
            gains, raw = self._gains(actuators, around), self._limited(past, actuators)
            passed = Passed(raw, raw[:, :0], np.zeros((size, *raw.shape)), np.zeros((size, *raw[:, :0].shape)))
            nothing = np.zeros_like(position)
            inertia = np.asarray(self._joint(joint, around, ()).inertia)[:, :1] + nothing
            seen = Joint(*map(_device, (position, velocity, nothing, inertia, nothing)))
            for k, place in effects:
                numbers, along = self._numbers_at(k, p[place]), self._ways(place, size)
                at_work = (numbers[0], along * numbers[1], times, seen, passed, gains)
                passed = pass_on(self.pairs[k][0], self.names[k], dt, 0, 0.0, *at_work)
            change += (gains * (np.asarray(passed.commands) - raw))[..., own].sum(-1)
            slopes += (gains * np.asarray(passed.along))[..., own].sum(-1)
        return change, slopes

    def _ways(self, place: slice, size: int) -> Float[np.ndarray, "e own"]:
        """How an effect's own numbers move with a candidate's."""
        first = place.start - self.d
        return np.eye(size, place.stop - place.start, -first)

    def _numbers_at(self, e: int, x: Float[np.ndarray, " k"]) -> tuple[np.ndarray, np.ndarray]:
        """An effect's parameters in their units, and how they grow with x."""
        pairs = list(zip(self.margin[e], x.tolist(), strict=True))
        return np.array([m.value(z) for m, z in pairs]), np.array([m.slope(z) for m, z in pairs])

    def _dof(self, joint: int) -> int:
        return int(self.model.jnt_dofadr[joint])

    def _earlier(self, joint: int, around: _Around) -> tuple[Array, ...] | None:
        """Positions and velocities of a joint before the windows, and what actuators exerted on it."""
        if around.motion.earlier is None:
            return None
        key = ("earlier", joint)
        if key not in around.kept:
            position, velocity = around.motion.earlier
            place = int(self.model.jnt_qposadr[joint]), self._dof(joint)
            driving, theta = tuple(actuators_of(self.model, joint)), around.p[: self.d]
            around.kept[key] = _look_back(
                self.system, self.margins, place, driving, theta, self.motion.past, position, velocity
            )
        return around.kept[key]

    def _numbers(self, around: _Around) -> Numbers:
        """The model's numbers at the θ that the steps were linearized at."""
        theta = self.margins.theta(around.p[: self.d])
        return read_numbers(self.model, self.system.engine.writes, theta)

    def _gains(self, actuators: Sequence[int], around: _Around) -> Float[np.ndarray, " act"]:
        """Forces on their joints for commands of one."""
        key = ("gains", tuple(actuators))
        if key not in around.kept:
            read = self._numbers(around)
            gains = [read("actuator_gear", i, 0) * read("actuator_gainprm", i, 0) for i in actuators]
            around.kept[key] = np.array([float(gain) for gain in gains])
        return around.kept[key]

    def _commands(self, actuators: Sequence[int], looks: bool) -> tuple[Array, Array, float, int]:
        """Commands of every time step within their limits; those further back, their step, s; how many come before."""
        key = (tuple(actuators), looks)
        if key not in self._kept:
            older, coarse, recent = split_history(self.motion.past, self.system.dt)
            older, recent, ctrl = map(np.asarray, (older, recent, self.motion.ctrl))
            rows = ctrl if looks else np.concatenate([recent, ctrl], 1)
            commands = np.repeat(self._limited(rows, actuators), self.fine, 1)
            before = 0 if looks else recent.shape[1] * self.fine
            self._kept[key] = _device(commands), _device(self._limited(older, actuators)), coarse, before
        return self._kept[key]

    def _limited(self, rows: Float[np.ndarray, "windows rows nu"], actuators: Sequence[int]) -> np.ndarray:
        """Commands of some actuators within their limits."""
        limits = [self.model.actuator_ctrlrange[i] for i in actuators]
        limited = [bool(self.model.actuator_ctrllimited[i]) for i in actuators]
        low, high = (
            np.array([r[k] if on else bound for r, on in zip(limits, limited, strict=True)])
            for k, bound in ((0, -np.inf), (1, np.inf))
        )
        return np.clip(rows[..., list(actuators)], low, high)

    def _joint(self, joint: int, around: _Around, actuators: Sequence[int]) -> Joint:
        """What effects see of a joint; the drive is that of some actuators, or of all that the joint has."""
        driving = tuple(actuators) or tuple(actuators_of(self.model, joint))
        key = (joint, driving)
        if key not in around.kept:
            place = int(self.model.jnt_qposadr[joint]), self._dof(joint)
            around.kept[key] = _look_at(
                self.system, self.margins, place, driving, self.fine, around.p[: self.d], around.motion, around.lin
            )
        return around.kept[key]


@dataclass
class _Pushes:
    """What a candidate's effects add to the forces in every row, and its derivatives along its x."""

    force: Float[np.ndarray, "windows rows nv"]
    along: Float[np.ndarray, "windows rows nv e"]
    at: set[int] = field(default_factory=set)
    """Degrees of freedom that something was added to."""
    drives: dict[int, tuple[np.ndarray, np.ndarray]] = field(default_factory=dict)
    """What actuators exert there besides, and its derivatives."""

    def add(self, dof: int, f: np.ndarray, along: np.ndarray, columns: slice, drives: bool = False) -> None:
        """Add a force; its derivatives are along a part of x."""
        self.at.add(dof)
        self.force[..., dof] += f
        self.along[..., dof, columns] += along
        if drives:
            self.drives[dof] = self.force[..., dof].copy(), self.along[..., dof, :].copy()

    def beside(self, dof: int, joint: Joint, own: Float[np.ndarray, "e own"], fine: int) -> tuple[Joint, Partners]:
        """A joint under what was added, as an effect sees it that is next; `own` are the ways of its own numbers."""

        def steps(rows: np.ndarray) -> np.ndarray:
            return np.repeat(rows, fine, axis=1)

        response = CAUTION / np.asarray(joint.inertia)
        along = np.moveaxis(steps(self.along[..., dof, :]), -1, 0)
        acceleration = np.asarray(joint.acceleration) + response * steps(self.force[..., dof])
        drive, drive_along = np.asarray(joint.drive), np.zeros_like(along)
        if dof in self.drives:
            more, slopes = self.drives[dof]
            drive, drive_along = drive + steps(more), np.moveaxis(steps(slopes), -1, 0)
        there = dataclasses.replace(joint, acceleration=acceleration, drive=drive)
        return there, Partners(own, response * along, drive_along)


@dataclass(frozen=True, eq=False)
class _EngineNumbers:
    """The engine's θ as a function of [z, x of all model effects, which are on, low, high, neutral].

    Two of the same engine, priors and effects are equal, whatever the ranges of the effects' parameters.
    """

    engine: Engine[Any]
    writes: tuple[Write, ...]
    """Of the engine without effects."""
    margins: Margins
    edits: tuple[tuple[Any, str], ...]
    kinds: tuple[str, ...]
    """Of the margins of the effects' parameters."""
    wired: tuple[Wired, ...]

    def __call__(self, full: Float[Array, " m"]) -> Float[Array, " e"]:
        """What the engine is stepped with."""
        d, m = self.margins.size, len(self.kinds)
        if not m:
            return self.margins.theta(full)
        x, on, low, high, neutral = (full[d + i * m : d + (i + 1) * m] for i in range(5))
        values = jnp.where(on > 0.5, values_between(self.kinds, low, high, x), neutral)
        theta = jnp.concatenate([self.margins.theta(full[:d]), values])
        return edit_model(self.engine.model, self.writes, self.wired, theta, d)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _EngineNumbers) and other._key == self._key

    def __hash__(self) -> int:
        return self._hash

    @cached_property
    def _hash(self) -> int:
        return hash(self._key)

    @property
    def _key(self) -> tuple[Any, ...]:
        return self.engine, self.writes, self.margins, self.edits, self.kinds


def _device(x: np.ndarray) -> Array:
    """Where programs take it from without a copy, and without a program of its own."""
    return jax.device_put(x.astype(jnp.result_type(float)))


@partial(jax.jit, static_argnames=("place", "actuators", "fine"), compiler_options=COMPILER_OPTIONS)
def _look_at(
    system: MjcfSystem,
    margins: Margins,
    place: tuple[int, int],
    actuators: tuple[int, ...],
    fine: int,
    z: Array,
    motion: Motion,
    lin: Linearized,
) -> Joint:
    """What effects see of the joint whose place is in qpos and qvel."""
    q, v = place
    engine, nv = system.engine, system.engine.model.nv

    def between(rows: Float[Array, "windows rows"]) -> Float[Array, "windows steps"]:
        """On a line between rows."""
        f = jnp.arange(fine) / fine
        return (rows[:, :-1, None] * (1 - f) + rows[:, 1:, None] * f).reshape(len(rows), -1)

    inertia = CAUTION * system.dt / jnp.maximum(lin.b[..., nv + v, v], 1e-12)
    rise = lin.gap[..., nv + v] + motion.qvel[:, 1:, v] - motion.qvel[:, :-1, v]
    position, velocity = between(motion.qpos[..., q]), between(motion.qvel[..., v])
    numbers = read_numbers(engine.model, engine.writes, margins.theta(z))
    commands = jnp.moveaxis(jnp.repeat(motion.ctrl, fine, axis=1), -1, 0)
    drive = drive_of(engine.model, numbers, actuators, commands, position, velocity) + jnp.zeros_like(position)
    acceleration, inertia = (jnp.repeat(rows, fine, axis=1) for rows in (rise / system.dt, inertia))
    return Joint(position, velocity, acceleration, inertia, drive)


@partial(jax.jit, static_argnames=("place", "actuators"), compiler_options=COMPILER_OPTIONS)
def _look_back(
    system: MjcfSystem,
    margins: Margins,
    place: tuple[int, int],
    actuators: tuple[int, ...],
    z: Array,
    past: Array,
    position: Array,
    velocity: Array,
) -> tuple[Array, Array, Array]:
    """Positions and velocities of one joint before the windows, and what actuators exerted on it."""
    model = system.engine.model
    position, velocity = position[..., place[0]], velocity[..., place[1]]
    numbers = read_numbers(model, system.engine.writes, margins.theta(z))
    drive = drive_of(model, numbers, actuators, jnp.moveaxis(past, -1, 0), position, velocity)
    return position, velocity, drive + jnp.zeros_like(position)


@dataclass
class _Reading:
    """How an effect distorts a sensor's readings, s(x, q(x, r)) = r, of the motion that is restored from them."""

    channel: int
    dof: int
    own: slice
    """Of the effect's numbers among those of the candidate."""
    along: Float[np.ndarray, "windows rows e"]
    """∂q/∂x, and ∂v/∂x."""
    along_v: Float[np.ndarray, "windows rows e"]
    slope: Float[np.ndarray, "windows rows"]
    """∂q/∂reading."""


def _distort(
    seen: Float[np.ndarray, "windows rows obs"],
    raw: Float[np.ndarray, "windows rows obs"],
    readings: Sequence[_Reading],
    nv: int,
    size: int,
) -> Readings | None:
    """What sensors with effects show: `raw` where the true ones show `seen`."""
    if not readings:
        return None
    scale, shift, along = np.ones_like(seen), np.zeros_like(seen), np.zeros((*seen.shape, size))
    first = np.zeros((len(seen), 2 * nv, size))
    for each in readings:
        here, s = (..., each.channel), 1.0 / each.slope
        scale[here], shift[here] = s, raw[here] - s * seen[here]
        along[(*here, each.own)] -= s[..., None] * each.along
        first[:, each.dof, each.own] += each.along[:, 0]
        first[:, nv + each.dof, each.own] += each.along_v[:, 0]
    return Readings(scale, shift, along, first)


def _see_one(
    system: MjcfSystem, theta: Array, qpos: Array, qvel: Array, ctrl: Array, step: float
) -> tuple[Array, Array]:
    model = system.engine.model
    nv = model.nv

    def see(move: Array) -> Array:
        state = system.begin(theta, displace(model, qpos, move[:nv]), qvel + move[nv:])
        return system.observe(theta, dataclasses.replace(state, ctrl=ctrl))

    zero, every = jnp.zeros(2 * nv), jnp.eye(2 * nv)
    if step:
        slopes = jax.vmap(lambda d: (see(step * d) - see(-step * d)) / (2.0 * step), out_axes=-1)(every)
    else:
        slopes = jax.vmap(lambda d: jax.jvp(see, (zero,), (d,))[1], out_axes=-1)(every)
    return see(zero), slopes


@partial(jax.jit, static_argnames="step", compiler_options=COMPILER_OPTIONS)
def _see_all(
    system: MjcfSystem, margins: Margins, z: Array, qpos: Array, qvel: Array, ctrl: Array, step: float
) -> tuple[Array, Array]:
    """What the sensors show along a motion, and its derivatives along the state; the last command stays.

    Derivatives are differences of two steps' length where there is a `step`.
    """
    theta, held = margins.theta(z), jnp.concatenate([ctrl, ctrl[:, -1:]], 1)
    one = lambda q, v, u: _see_one(system, theta, q, v, u, step)  # noqa: E731
    return jax.vmap(jax.vmap(one))(qpos, qvel, held)
