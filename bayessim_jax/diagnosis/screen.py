"""Every effect at every place held against what was measured, along the recorded motion and without simulating it.

A candidate is fitted with θ and the initial states of all windows by `diagnosis.response`, with the force that it
exerts along the motion by `diagnosis.forcing`. One fit takes
hundredths of a second, so that pairs are tried as well. What comes out on top is then simulated (`diagnosis.bench`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain, product
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray
from scipy.special import ndtri

from bayessim_jax.beliefs.margins import Margin
from bayessim_jax.diagnosis.bench import NEAR, Candidate, begin_point, bounded_numbers, traded
from bayessim_jax.diagnosis.scene import Scene
from bayessim_jax.diagnosis.simulated_scene import SimulatedScene
from bayessim_jax.diagnosis.whiteness import Misfit, judge_misfit
from bayessim_jax.effects import EffectParameter
from bayessim_jax.inference.arrow import propose
from bayessim_jax.inference.direct import noise_floor, noise_level
from bayessim_jax.inference.shooting import in_units

__all__ = ["Begun", "March", "Screen", "Screened"]

ITERATIONS, AGAIN = 6, 3
"""Steps of the solver with the noise of before, and then with its own."""
LONGEST = 1.0
"""The longest step of p, but for steps back from an end."""
INERTIAS, BAD = ("kg", "kg m²"), 1.5
"""Units of parameters for which θ gives way first, where an effect begins at so many times the cost without it."""
FALLING = 6
"""Steps more of them before some are left behind: from far away they first make up for what θ had taken of it."""
RACES = ((3, False, 4), (4, True, 2), (6, True, 2))
"""Steps of the solver from the points that a candidate is begun from, whether parameters that are scanned move, and how
many points go on; one race after the other."""
SCAN, SCANNED = ((2, False, 2),), 2
"""The same for a scan beside what is known, of what weighs on a body, and how many points of other scans go on."""
LEFT = 2
"""Of the points that go on from a race, how many times as many are left at least in the midst of it."""
SAME = 0.05
"""Apart in no z by more than this, two points of a race are one."""
LASTING = 8
"""Further steps of those that went on."""
SHIFTS, HELD, MOVES, BETTER = np.delete(np.arange(-5, 6), 5) / 5, 4, 3, 0.99
"""Shares of a window by which moments are moved, steps from there and from traded numbers, how often at most, and share
of the cost from which it is done once more."""
LEAST_SHARE = 0.2
"""Of the numbers measured, that noise is taken to have in the residuals however many are fitted."""
STRAYED = 1.5
"""Of θ's z: where the simulator without an effect was driven further out, a candidate also begins from the middle."""
DRAWS, ASIDE = 4, 0.7
"""Points of its prior from which a candidate of several parameters is begun beside the usual ones, and of one."""
EDGE = 0.02
"""Share of a prior at either end where nothing begins."""


@dataclass
class March:
    """Where Levenberg and Marquardt's method stands: the point that is tried next, and the best one so far."""

    tried: tuple[Any, Any]
    here: tuple[Any, ...] = ()
    """(p, δ, curvature, residuals)."""
    damping: float = 1e-3
    promised: float = np.inf
    """Cost at the point that is tried next, were residuals linear."""
    steps: float = 0
    """Points that were tried; infinitely many where it has ended."""

    @property
    def cost(self) -> float:
        """Of the best point so far; infinite without one."""
        return float(self.here[2].cost) if self.here else np.inf

    def stop(self) -> None:
        """No more steps: the cost does not fall, or is none from the first."""
        self.steps, self.promised = np.inf, self.cost


def _distinct(marches: Sequence[March]) -> list[tuple[Any, Array]]:
    """(p, δ) of those that are not where one before them is."""
    found: list[tuple[Any, Array]] = []
    for march in marches:
        if all(np.abs(march.here[0] - p).max() > SAME for p, _ in found):
            found.append(march.here[:2])
    return found


@dataclass
class Begun:
    """A candidate fitted from several points, at the noise of a fit without it."""

    candidate: Candidate
    ends: list[tuple[Any, Array]]
    """(p, δ), the best first."""
    likelihood: float
    """Log likelihood of the best at its own noise, up to a constant."""


@dataclass
class Screened:
    """A candidate fitted along the motion."""

    candidate: Candidate
    p: Float[Array, " k"]
    """[θ's z, the candidate's x, zeros in the places that are not used]."""
    delta: Float[Array, "windows n"]
    sigma: Float[Array, " obs"]
    cost: float
    """At the noise with which it was fitted last, which is nearly its own."""
    score: float
    """Log likelihood at its own noise, less one for every parameter (Akaike 1974), up to a constant."""


class Screen:
    """Fits of candidates along the motion of a scene."""

    def __init__(self, scene: Scene | SimulatedScene) -> None:
        self.scene = scene
        self.shots, self.d, self.slots = scene.shots, scene.d, scene.slots
        self.pairs, self.name, self.takes, self.offsets = scene.pairs, scene.name, scene.takes, scene.offsets
        self.floor = noise_floor(scene.shots)
        self.bounded = bounded_numbers(scene.margins, scene.slots)
        self.spread = np.asarray(scene.shots.spread)
        self.counts = np.maximum(np.asarray(scene.shots.measured).sum((0, 1)), 1)

    def twin(self) -> Screen:
        """The same screen for another thread."""
        return Screen(self.scene.twin())

    def starts(self, candidate: Candidate) -> list[np.ndarray]:
        """Points of a candidate's x to begin from: its start values, mirrored where a sign is open, and draws."""
        random = np.random.default_rng(candidate.effects)
        parameters, margin = self.scene.parameters, self.scene.margin
        each = [(p, m) for k in candidate.effects for p, m in zip(parameters[k], margin[k], strict=True)]
        begin = self._begin(candidate)
        points = [begin]
        signs = np.array([-1.0 if p.low < 0.0 else 1.0 for p, _ in each])
        if (signs < 0.0).any():
            points.append(signs * begin)
        grids = []
        for unit in dict.fromkeys(p.unit for p, _ in each if p.scan):
            together = [k for k, (p, _) in enumerate(each) if p.scan and p.unit == unit]
            shares = (np.arange(each[together[0]][0].scan) + 1.0) / (each[together[0]][0].scan + 1.0)
            apart = (np.arange(len(together)) - 0.5 * (len(together) - 1)) / len(shares)
            places = ndtri(np.clip(shares[:, None] + apart, EDGE, 1.0 - EDGE))
            grids.append([list(zip(together, place, strict=True)) for place in places])
        # where a sign is open a scan begins in the middle: from the wrong sign the first steps do not come back
        middle = np.where(signs < 0.0, 0.0, begin)
        for chosen in product(*grids) if grids else ():
            point = middle.copy()
            for k, z in chain(*chosen):
                point[k] = z
            points.append(point)
        if len(each) == 1 and not grids:
            points += [np.array([-ASIDE]), np.array([ASIDE])]
        if len(each) > 1:
            points += [random.standard_normal(len(each)) for _ in range(DRAWS)]
        return points

    def fit(
        self,
        candidate: Candidate,
        p: Float[Array, " k"] | np.ndarray,
        delta: Array,
        sigma: Array,
        iterations: int = ITERATIONS,
        scanned: bool = True,
        bad: float = np.inf,
    ) -> tuple[Any, ...]:
        """Levenberg-Marquardt from a point; parameters that are `scanned` may stay where they are.

        Where the point costs more than `bad`, the first step is θ's alone: a rotor takes from the mass that was fitted
        without it. Returns (p, δ, curvature, residuals).
        """
        march = March((np.asarray(p), delta))
        self._advance(march, candidate, sigma, iterations, iterations, scanned, bad)
        return march.here or (p, delta, None, None)

    def _advance(
        self,
        march: March,
        candidate: Candidate,
        sigma: Array,
        until: int,
        iterations: int,
        scanned: bool,
        bad: float,
    ) -> None:
        """Go on with a fit that may take so many steps until it has taken some of them, or has ended."""
        system = np.arange(self.d + self.slots) < self.d
        free = np.arange(self.d + self.slots) < self.d + self.scene.count(candidate)
        if not scanned:
            for effect, place in self.offsets(candidate):
                free[place] = [not q.scan for q in self.scene.parameters[effect]]
        while march.steps < until:
            there = self.scene.assess(candidate, *march.tried, sigma)
            cost, before = float(there[0].cost), march.cost
            march.steps += 1
            if np.isfinite(cost) and cost <= before:
                march.here, march.damping = (*march.tried, *there), max(march.damping / 5, 1e-9)
                if before - cost < 1e-4 * abs(cost):
                    march.stop()
            elif not march.here:
                march.stop()
            else:
                march.damping *= 10
            if march.steps < iterations:
                moving = system if march.steps == 1 and cost > bad else free
                p, delta, curvature = np.asarray(march.here[0]), np.asarray(march.here[1]), march.here[2]
                how = (march.damping, moving, self.bounded, self.spread)
                p, delta, fall = propose(curvature, *how, p, delta, LONGEST)
                march.tried, march.promised = (p, delta), float(np.nan_to_num(march.cost - fall, nan=np.inf))

    def settle(
        self,
        candidate: Candidate,
        p: Float[Array, " k"] | np.ndarray,
        delta: Array,
        sigma: Array,
        iterations: int = ITERATIONS,
    ) -> Screened | None:
        """Fit a candidate and its noise in turn, and score it."""
        own = self.scene.count(candidate)
        self.scene.begin_around(candidate, p)
        for steps in (iterations, AGAIN):
            self.scene.approach(candidate, p)
            p, delta, curvature, r = self.fit(candidate, p, delta, sigma, steps)
            if curvature is None:
                return None
            squares = (np.asarray(r) ** 2).sum((0, 1)) * np.asarray(sigma) ** 2
            level = noise_level(squares, self.counts, self.d + own + delta.size, self.floor, LEAST_SHARE)
            score, sigma = self._profile(r, sigma) - own, level
        return (
            Screened(candidate, jax.device_put(p), delta, sigma, float(curvature.cost), score)
            if np.isfinite(score)
            else None
        )

    def begin(self, z: Float[Array, " d"], sigma: Array) -> Screened:
        """The simulator without effects."""
        p = np.zeros(self.d + self.slots)
        p[: self.d] = z
        delta = jax.device_put(np.zeros((len(self.shots.y), self.shots.spread.size)))
        found = self.settle(Candidate(), p, delta, sigma)
        if found is None:
            raise ValueError("the simulator diverges along the recorded motion.")
        return found

    def reach(self, known: Screened) -> list[int]:
        """Effects that may explain much of what a fit leaves."""
        self.scene.begin_around(known.candidate, known.p)
        return self.scene.reach(known.candidate, np.asarray(known.p), known.delta, known.sigma)

    def begin_candidate(self, candidate: Candidate, known: Screened) -> Begun | None:
        """Take the first steps with a candidate from several points beside a fit without it.

        `known` may hold some of its effects already.
        """
        self.scene.begin_around(known.candidate, known.p)
        added = Candidate(tuple(k for k in candidate.effects if k not in known.candidate.effects))
        points = [self._put(candidate, known, start) for start in self.starts(added)]
        strayed = (np.arange(self.d + self.slots) < self.d) & (np.abs(known.p) > STRAYED)
        if strayed.any():
            points += [np.where(strayed, 0.0, point) for point in points]
        ends = [(p, delta) for p in points for delta in self.scene.states(known.delta)]
        return self._race(candidate, known, ends, RACES[:1])

    def begin_from(self, candidate: Candidate, simpler: Screened, known: Screened) -> Begun | None:
        """Take all steps before the last ones with an effect from the numbers of a special case of it.

        Parameters of the same unit have its number; the others are where they are begun from, and what both have
        besides, as in `known`, is as it is there.
        """
        self.scene.begin_around(known.candidate, known.p)
        own, held = dict(self.offsets(candidate)), dict(self.offsets(simpler.candidate))
        (k,), (s,) = own.keys() - held.keys(), held.keys() - own.keys()
        parameters, margin = self.scene.parameters, self.scene.margin
        numbers = zip(parameters[s], margin[s], simpler.p[held[s]], strict=True)
        values = {p.unit: float(m.value(float(z))) for p, m, z in numbers}
        ends = {}
        for start in self.starts(Candidate((k,))):
            p = np.zeros(self.d + self.slots)
            p[: self.d], p[own[k]] = simpler.p[: self.d], start
            for other in own.keys() & held.keys():
                p[own[other]] = simpler.p[held[other]]
            for i, (parameter, range_) in enumerate(zip(parameters[k], margin[k], strict=True)):
                if parameter.unit in values:
                    value = np.clip(values[parameter.unit], parameter.low, parameter.high)
                    p[own[k].start + i] = np.clip(range_.standard(float(value)), ndtri(EDGE), ndtri(1.0 - EDGE))
            ends[p.tobytes()] = (p, simpler.delta)
        return self._race(candidate, known, list(ends.values()), RACES)

    def resume_candidate(self, begun: Begun, known: Screened) -> Begun | None:
        """Go on with a candidate from the best of those points."""
        self.scene.begin_around(known.candidate, known.p)
        return self._race(begun.candidate, known, begun.ends, RACES[1:])

    def _race(
        self,
        candidate: Candidate,
        known: Screened,
        ends: list[tuple[Any, Array]],
        races: Sequence[tuple[int, bool, int]],
    ) -> Begun | None:
        """Fit a candidate from several points, of which the best go on.

        After each third of a race's steps those half are left behind of which linear residuals promise less (sequential
        halving).

        Source: Karnin, Koren and Somekh 2013
        """
        weighs = self._weighs(k for k in candidate.effects if k not in known.candidate.effects)
        bad = BAD * known.cost if weighs else np.inf
        likelihood = -np.inf
        for steps, scanned, kept in races:
            steps += FALLING if weighs and len(ends) > kept else 0
            marches = [March((np.asarray(p), delta)) for p, delta in ends]
            for third in (1, 2, 3):
                for march in marches:
                    self._advance(march, candidate, known.sigma, third * steps // 3, steps, scanned, bad)
                if third < 3 and third * steps >= 3:
                    marches = sorted(marches, key=lambda m: m.promised)[: max(len(marches) // 2, LEFT * kept)]
            best = sorted((march for march in marches if march.here), key=lambda march: march.cost)
            if not best:
                return None
            ends, likelihood = _distinct(best)[:kept], self._profile(best[0].here[3], known.sigma)
        return Begun(candidate, ends, likelihood)

    def _weighs(self, effects: Iterable[int]) -> bool:
        """Whether some effects take from the masses that were fitted without them."""
        return any(p.unit in INERTIAS for k in effects for p in self.scene.parameters[k])

    def _profile(self, r: Array, sigma: Array) -> float:
        """Log likelihood at the noise that residuals have, up to a constant."""
        rms = np.sqrt((np.asarray(r) ** 2).sum((0, 1)) / self.counts) * np.asarray(sigma)
        return -float((self.counts * np.log(np.maximum(rms, np.asarray(self.floor)))).sum())

    def finish_candidate(self, begun: Begun, known: Screened) -> Screened | None:
        """Fit what was begun to the end, with its own noise, and score it."""
        ends = []
        for p, delta in begun.ends:
            self.scene.begin_around(known.candidate, known.p)
            self.scene.approach(begun.candidate, p)
            ends.append(self.fit(begun.candidate, p, delta, known.sigma, LASTING))
        ends = [end for end in ends if end[2] is not None]
        if not ends:
            return None
        best = self._move_moments(begun.candidate, min(ends, key=lambda end: float(end[2].cost)), known.sigma)
        best = self._trade(begun.candidate, best, known.sigma)
        return self.settle(begun.candidate, best[0], best[1], known.sigma)

    def _move_moments(self, candidate: Candidate, end: tuple[Any, ...], sigma: Array) -> tuple[Any, ...]:
        """Go on from fits with each moment held at others within a window of it, as long as that is better.

        What begins at the end of a window moves nothing in it, so that a fit has no slope there and stops.
        """
        window = self.shots.y.shape[1] * self.scene.system.dt

        def move(p: np.ndarray, i: int, parameter: EffectParameter, margin: Margin) -> list[np.ndarray]:
            values = float(margin.value(float(p[i]))) + SHIFTS * window
            inside = [value for value in values if parameter.low < value < parameter.high]
            return [np.where(np.arange(p.size) == i, margin.standard(value), p) for value in inside]

        for k, place in self.offsets(candidate):
            for i, (parameter, margin) in enumerate(zip(self.scene.parameters[k], self.scene.margin[k], strict=True)):
                if parameter.moment:
                    others = partial(move, i=place.start + i, parameter=parameter, margin=margin)
                    end = self._leap(candidate, end, sigma, others, scanned=False)
        return end

    def _trade(self, candidate: Candidate, end: tuple[Any, ...], sigma: Array) -> tuple[Any, ...]:
        """Go on from other numbers that do much the same as those found, as long as that is better."""

        def trade(p: np.ndarray, k: int, place: slice) -> list[np.ndarray]:
            return traded(self.pairs[k][0], self.scene.parameters[k], self.scene.margin[k], p, place)

        for k, place in self.offsets(candidate):
            end = self._leap(candidate, end, sigma, partial(trade, k=k, place=place))
        return end

    def _leap(
        self,
        candidate: Candidate,
        end: tuple[Any, ...],
        sigma: Array,
        others: Callable[[np.ndarray], list[np.ndarray]],
        scanned: bool = True,
    ) -> tuple[Any, ...]:
        """Go on from the best of other points than a fit came to, as long as that is better."""
        for _ in range(MOVES):
            tried = [self.fit(candidate, p, end[1], sigma, HELD, scanned) for p in others(np.array(end[0]))]
            tried = [other for other in tried if other[2] is not None]
            if not tried:
                break
            start = min(tried, key=lambda other: float(other[2].cost))
            best = self.fit(candidate, *start[:2], sigma, LASTING)
            if best[2] is None or not float(best[2].cost) < BETTER * float(end[2].cost):
                break
            end = best
        return end

    def part(self, found: Screened, effects: tuple[int, ...]) -> Screened:
        """Some effects of a candidate by themselves, with the numbers that they have there."""
        part, held = Candidate(effects), dict(self.offsets(found.candidate))
        p = np.zeros(self.d + self.slots)
        p[: self.d] = found.p[: self.d]
        for k, place in self.offsets(part):
            p[place] = found.p[held[k]]
        return replace(found, candidate=part, p=jnp.asarray(p))

    def misfit(self, key: PRNGKeyArray, found: Screened) -> Misfit:
        """What a candidate leaves of the misfit."""
        self.scene.begin_around(found.candidate, found.p)
        r, slopes = self.scene.expand(found.candidate, np.asarray(found.p), found.delta, found.sigma)
        n = found.delta.shape[-1]
        own = in_units(np.asarray(slopes)[:, -n:], found.sigma)
        residual = np.asarray(r) * np.asarray(found.sigma)
        return judge_misfit(key, residual, own, np.asarray(self.shots.measured))

    def own(self, begun: Begun) -> Float[np.ndarray, " e"]:
        """The candidate's own numbers where it was fitted best."""
        return np.asarray(begun.ends[0][0])[self.d : self.d + self.scene.count(begun.candidate)]

    def beside(
        self, candidate: Candidate, known: Screened, alone: Float[np.ndarray, " e"] | None = None
    ) -> list[March]:
        """Fits of a candidate beside a fit of a part of it, which begin from several points.

        What is added begins nearly neutral, as usual, or as it was fitted `alone`; where parameters are scanned, and
        with what weighs on a body and has several, also at the best points of a scan beside what is known.
        """
        added = Candidate(tuple(k for k in candidate.effects if k not in known.candidate.effects))
        begin, weak = self._begin(added), self._begin(added, NEAR)
        points = [weak, begin] if np.abs(begin - weak).max(initial=0.0) > 0.0 else [begin]
        starts = [*points, *([alone] if alone is not None else [])]

        def begin_at(points: Iterable[Float[np.ndarray, " e"]]) -> list[tuple[Any, Array]]:
            return [(self._put(candidate, known, point), known.delta) for point in points]

        marches = [March(point) for point in begin_at(starts)]
        scanned = any(p.scan for k in added.effects for p in self.scene.parameters[k])
        loads = [k for k in added.effects if self.pairs[k][0].port == "model" and self._weighs((k,))]
        if scanned or any(len(self.scene.parameters[k]) > 1 for k in loads):
            scan = begin_at(self.starts(added))
            if loads:
                self.scene.begin_around(known.candidate, known.p)
                found = self._race(candidate, known, scan, SCAN)
                marches += [March(end) for end in found.ends] if found is not None else []
            else:
                marches += self.glance(candidate, known, [March(point) for point in scan], 1, scanned=False)[:SCANNED]
        return marches

    def glance(
        self, candidate: Candidate, known: Screened, marches: Sequence[March], steps: int, scanned: bool = True
    ) -> list[March]:
        """Fits beside what is known after so many steps; those first that promise the least cost after one more.

        Parameters that are `scanned` may stay where they are.
        """
        self.scene.begin_around(known.candidate, known.p)
        for march in marches:
            self._advance(march, candidate, known.sigma, steps, steps + 1, scanned, np.inf)
        return sorted((march for march in marches if march.here), key=lambda march: march.promised)

    def _begin(self, candidate: Candidate, share: float = 1.0) -> Float[np.ndarray, " e"]:
        """A candidate's x where a fit begins."""
        parameters = [p for k in candidate.effects for p in self.scene.parameters[k]]
        return begin_point(parameters, [m for k in candidate.effects for m in self.scene.margin[k]], share)

    def _put(self, candidate: Candidate, known: Screened, start: Float[np.ndarray, " e"]) -> Float[np.ndarray, " k"]:
        """A candidate's p with the numbers of what is known of it; the others, in their order, begin at `start`."""
        p = np.zeros(self.d + self.slots)
        p[: self.d] = known.p[: self.d]
        held, used = dict(self.offsets(known.candidate)), 0
        for k, place in self.offsets(candidate):
            size = place.stop - place.start
            p[place] = known.p[held[k]] if k in held else start[used : used + size]
            used += 0 if k in held else size
        return p
