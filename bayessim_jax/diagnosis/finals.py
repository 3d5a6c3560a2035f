"""The finals: candidates simulated, fitted with their initial states, and scored on recordings that fits leave out."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import cached_property, partial
from itertools import islice
from typing import TypeVar
from zlib import crc32

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from bayessim_jax.diagnosis.bench import Bench, Candidate
from bayessim_jax.diagnosis.problem import WORKERS, Problem
from bayessim_jax.diagnosis.response import cross_validate
from bayessim_jax.diagnosis.screen import LEAST_SHARE, Screened
from bayessim_jax.diagnosis.verdict import (
    Entry,
    Thresholds,
    are_siblings,
    can_stand_for,
    contenders,
    error_left,
    find_shortsighted,
    has_special_case,
    may_be_astray,
    may_be_named,
    share_left,
)
from bayessim_jax.diagnosis.whiteness import FALSE_ALARMS, judge_misfit
from bayessim_jax.inference.direct import estimate_noise, noise_floor
from bayessim_jax.inference.shooting import Fit, Shots

__all__ = ["Finals", "Work", "enter", "without_effects"]

T, R = TypeVar("T"), TypeVar("R")

SIMPLE, AGAIN = 2, 4
"""Parameters of a candidate that is simulated from one point only, and how many others, and rivals, are from more."""
RIVALS = 6
"""Candidates that explain the misfit, too, whose predictions ahead are looked at where those of the best are bad."""
SHORT = 0.01
"""Share of the misfit that a candidate leaves in simulation beyond what it does along the motion, from where on it is
simulated from more points."""
HOPELESS = 0.25
"""Share that it leaves along the motion, from where on it is not, if another one explains the misfit."""
TURNS = 3
"""How often rivals are fitted from the best one's numbers, where one of them then is the best."""
DOUBT = 0.05
"""Probability that a model fails in a window, where the simulator without effects then predicts."""
ROUNDS, STEPS = 4, 8
"""Of a fit and its noise after the first fit, at most, and of the solver in each."""
ENOUGH = 0.5
"""Share of the windows that have to be known to have a full past, for the others not to count against a memory."""
FOLDS = 4
"""Groups of recordings, each scored by fits to the others."""


@dataclass(frozen=True)
class Work:
    """A bench, and what fits on it are scored with."""

    key: PRNGKeyArray
    bench: Bench
    group: Int[np.ndarray, " windows"]
    """The recording of each window."""
    floor: Array
    """Of the noise."""
    remembered: Bool[np.ndarray, " windows"] | None = None
    """Windows before which as much was recorded as effects remember, unless that is so for few."""
    say: Callable[[str], None] = lambda text: None

    @classmethod
    def on(cls, key: PRNGKeyArray, problem: Problem, say: Callable[[str], None]) -> Work:
        """On the bench of all that may be missing."""
        bench = problem.bench(problem.pairs)
        return cls(key, bench, problem.group, noise_floor(bench.shots), _remembered(bench, bench.shots), say)

    @cached_property
    def folds(self) -> Bool[Array, "folds windows"]:
        """Windows that are scored by fits to the others."""
        return _folds(self.group)

    def settle(self, candidate: Candidate, fit: Fit) -> Fit:
        """Fit a candidate and its noise in turn."""
        free = self.bench.used(candidate)
        for _ in range(ROUNDS):
            sigma = estimate_noise(self.bench.shots, fit, self.floor, free, LEAST_SHARE)
            change = np.abs(np.log(np.asarray(sigma) / np.asarray(fit.sigma))).max()
            how = {"steps": STEPS, "damping": fit.damping, "known": fit}
            fit = self.bench.fit(candidate, fit.z, fit.delta, sigma, **how)
            if change < 0.03:
                break
        return fit


@dataclass
class Finals:
    """Candidates simulated and fitted from where the screen found them, and scored across recordings.

    The best of those with many parameters that leave more than `remain` says of the motion are fitted from their usual
    values, too, and from the numbers of parts of them: what fits there may be far from what fits in simulation, where
    joints stick and slip for instance. Where numbers trade for each other, candidates are fitted from far along that,
    too. Rivals of the best and parts of it are fitted from its numbers, and where one of them is then the best or ties
    with it, so are its own: none must win by a better start. Special cases and twins of what may be the answer are
    tried in their places, and siblings of the best one's effects where it is a set that leaves something. What was
    fitted before is taken as it was, and what turns out to be shortsighted is left out.
    """

    work: Work
    none: Entry
    """The simulator without effects."""
    remain: Callable[[Screened], float]
    """Share of the misfit that a candidate leaves along the motion."""
    ahead: Shots | None
    thresholds: Thresholds
    done: dict[Candidate, Entry] = field(default_factory=dict)
    """What was simulated and fitted already."""

    def hold(self, candidates: Sequence[Screened]) -> list[Entry]:
        """The finals of these candidates: the best first."""
        work, before = self.work, dict(self.done)
        work.say(f"simulating {sum(c.candidate not in before for c in candidates)} candidates; compiling takes a while")
        entries = self._begin(candidates, before)
        self._begin_elsewhere(entries, candidates, before)
        self._trade(entries, before)
        entries = self._face_rivals(entries, before)
        self.done |= {entry.candidate: entry for entry in entries}
        if self.ahead is not None and entries:
            for entry in _look_ahead(work.bench, self.none, entries, self.ahead, self.thresholds):
                work.say(f"{entry.title}: predicts far ahead much worse than others")
                entries.remove(entry)
        return entries

    def _begin(self, candidates: Sequence[Screened], before: Mapping[Candidate, Entry]) -> list[Entry]:
        """Every candidate from where the screen found it."""

        def begin(found: Screened) -> Entry | None:
            return before.get(found.candidate) or self._fit(found.candidate, found.p, found.sigma)

        entries: list[Entry] = []
        with ThreadPoolExecutor(WORKERS) as pool:
            for entry in pool.map(begin, candidates):
                if entry is not None:
                    entries.append(entry)
                    if entry.candidate not in before:
                        self.work.say(f"{entry.title}: score {entry.score:.1f}")
        return sorted(entries, key=lambda entry: -entry.score)

    def _begin_elsewhere(
        self, entries: list[Entry], candidates: Sequence[Screened], before: Mapping[Candidate, Entry]
    ) -> None:
        """Those with many parameters that leave more than the motion promised, from other points."""
        bench, none = self.work.bench, self.none
        screened = {found.candidate: found for found in candidates}
        explained = bool(entries) and share_left(entries[0].misfit, none.misfit) <= self.thresholds.left

        def falls_short(entry: Entry) -> bool:
            promised = self.remain(screened[entry.candidate])
            hopeless = explained and promised > HOPELESS
            return not hopeless and share_left(entry.misfit, none.misfit) > promised + SHORT

        def from_elsewhere(entry: Entry) -> Entry:
            parts = (e for e in entries if set(e.candidate.effects) < set(entry.candidate.effects))
            points = [_with_numbers_of(bench, part, entry.candidate, entry.fit.z) for part in parts]
            return self._improve(entry, [*points, *bench.starts(entry.candidate, jnp.zeros(bench.d))], entry.fit.sigma)

        fresh = [e for e in entries if e.candidate not in before]
        left = [e for e in fresh if e.misfit.p_value < FALSE_ALARMS and len(bench.columns(e.candidate)) > SIMPLE]
        self._again(entries, list(islice(filter(falls_short, left), AGAIN)), from_elsewhere)

    def _trade(self, entries: list[Entry], before: Mapping[Candidate, Entry]) -> None:
        """Those whose numbers trade for each other, from far along that."""
        bench = self.work.bench

        def from_traded(entry: Entry) -> Entry:
            for _ in range(TURNS):
                points = bench.traded(entry.candidate, entry.fit.z)
                last, entry = entry, self._improve(entry, points, entry.fit.sigma)
                if entry is last:
                    break
            return entry

        trading = [e for e in entries if e.candidate not in before and bench.traded(e.candidate, e.fit.z)]
        self._again(entries, trading[:AGAIN], from_traded)

    def _face_rivals(self, entries: list[Entry], before: Mapping[Candidate, Entry]) -> list[Entry]:
        """What may stand in the places of what ties, and rivals and parts of the best from its numbers."""
        bench, none = self.work.bench, self.none
        compared: set[tuple[Entry, Entry]] = set()

        def from_numbers_of(best: Entry, entry: Entry) -> Entry:
            return self._improve(entry, [_with_numbers_of(bench, best, entry.candidate, entry.fit.z)], best.fit.sigma)

        def stand_in(item: tuple[Candidate, Entry]) -> Entry | None:
            own, entry = item
            begun = _with_numbers_of(bench, entry, own, bench.starts(own, jnp.zeros(bench.d))[-1])
            return self._fit(own, begun, entry.fit.sigma)

        for _ in range(TURNS if entries else 0):
            entries = _recall(bench, none, entries, before, self.thresholds)
            best = entries[0]
            tied = contenders(entries, none, self.thresholds)
            if all(entry.candidate in before for entry in tied):
                break
            found = _at_once(stand_in, _replacements(bench, tied, entries))
            entries = sorted([*entries, *(e for e in found if e is not None)], key=lambda e: -e.score)
            rivals = [entry for entry in entries if _are_rivals(entry, best, none, self.thresholds)]
            rivals += [entry for entry in entries if entry.counts < best.counts]
            rivals = [entry for entry in rivals if (best, entry) not in compared]
            compared |= {(best, entry) for entry in rivals}
            self._again(entries, rivals, partial(from_numbers_of, best))
            now_tied = {entry.candidate for entry in contenders(entries, none, self.thresholds)}
            if entries[0] is best and now_tied <= {entry.candidate for entry in tied}:
                break
        return entries

    def _fit(self, own: Candidate, p: Float[Array, " k"], sigma: Array) -> Entry | None:
        """A candidate and its noise fitted from a point, and its scores; None where no simulation there ends well."""
        work, none = self.work, self.none
        fit = work.bench.fit(own, p, jnp.zeros_like(none.fit.delta), jnp.maximum(sigma, work.floor))
        if not np.isfinite(float(fit.cost)):
            return None
        entry = enter(work, own, work.settle(own, fit))
        entry.scores = np.logaddexp(np.log1p(-DOUBT) + entry.scores, np.log(DOUBT) + none.scores)
        return entry

    def _improve(self, entry: Entry, points: Sequence[Array], sigma: Array) -> Entry:
        """The same, or what is better of the same begun from other points."""
        others = (self._fit(entry.candidate, p, sigma) for p in points)
        return max([entry, *(other for other in others if other is not None)], key=lambda e: e.score)

    def _again(self, entries: list[Entry], chosen: Sequence[Entry], improve: Callable[[Entry], Entry]) -> None:
        """Some of the entries improved, each in the place of what it was, and the best first."""
        for before, entry in zip(chosen, _at_once(improve, chosen), strict=True):
            if entry is not before:
                entries[entries.index(before)] = entry
                self.work.say(f"{entry.title}: score {entry.score:.1f}, begun elsewhere")
        entries.sort(key=lambda entry: -entry.score)


def _at_once(do: Callable[[T], R], items: Sequence[T]) -> list[R]:
    """`do` for every item, for as many at once as there are workers."""
    with ThreadPoolExecutor(WORKERS) as pool:
        return list(pool.map(do, items))


def without_effects(work: Work, problem: Problem, detected: Entry) -> Entry:
    """The simulator without effects on a bench that holds some; its fit and test are the ones of whole windows."""
    nothing, start = Candidate(), problem.still(detected.fit)
    x = work.bench.starts(nothing, start.z[: work.bench.d])[0]
    fit = work.bench.fit(nothing, x, start.delta, start.sigma)
    entry = enter(work, nothing, work.settle(nothing, fit))
    entry.misfit = dataclasses.replace(entry.misfit, p_value=detected.misfit.p_value)
    entry.fit = dataclasses.replace(fit, z=x.at[: work.bench.d].set(start.z[: work.bench.d]))
    return entry


def _are_rivals(entry: Entry, best: Entry, none: Entry, thresholds: Thresholds) -> bool:
    """Whether a candidate is a special case of the best one, or explains as much with one effect in another's place."""
    replaced = (best.counts - entry.counts).total() == (entry.counts - best.counts).total() == 1
    return replaced and (share_left(entry.misfit, none.misfit) <= thresholds.left or has_special_case(best, entry))


def _stand_ins(bench: Bench, candidate: Candidate, siblings: bool = False) -> list[Candidate]:
    """Sets with one effect replaced by a special case or a twin of it, as far as there is room for their parameters.

    Or by another law that has a special case in common with it, if `siblings` are asked for.
    """

    def stands(one: str, other: str) -> bool:
        return can_stand_for(one, other) or (siblings and are_siblings(one, other))

    seats = [bench.seats(Candidate((k,))).get(bench.name(k), bench.name(k)) for k in range(len(bench.pairs))]
    found = [
        Candidate(tuple(sorted({*candidate.effects, k} - {effect})))
        for effect in candidate.effects
        for k in range(len(bench.pairs))
        if k not in candidate.effects and stands(seats[k], seats[effect])
    ]
    return [each for each in found if len(bench.columns(each)) <= bench.slots]


def _replacements(bench: Bench, tied: Sequence[Entry], entries: Sequence[Entry]) -> list[tuple[Candidate, Entry]]:
    """What may stand in the places of sets that tie, the best first, and the set whose numbers each begins from.

    As far as it is not among the `entries`.

    Of the best all, so that none is named for want of another law beside its other effects, and siblings where it has
    several and leaves something: which of laws that all do comes out best may be chance. Of the others few.
    """
    best = tied[0]
    vague = len(best.names) > 1 and best.misfit.p_value < FALSE_ALARMS
    found: dict[Candidate, Entry] = {}
    for entry in tied:
        for each in _stand_ins(bench, entry.candidate, siblings=vague and entry is best):
            found.setdefault(each, entry)
    tried = {entry.candidate for entry in entries}
    fresh = [(each, entry) for each, entry in found.items() if each not in tried]
    return fresh[: max(AGAIN, sum(entry is best for _, entry in fresh))]


def _recall(
    bench: Bench, none: Entry, entries: list[Entry], before: Mapping[Candidate, Entry], thresholds: Thresholds
) -> list[Entry]:
    """The same with what was tried before in the places of sets that tie, the best first."""
    while True:
        tied = contenders(entries, none, thresholds)
        known = [before[s] for s, _ in _replacements(bench, tied, entries) if s in before]
        if not known:
            return entries
        entries = sorted([*entries, *known], key=lambda e: -e.score)


def _with_numbers_of(bench: Bench, best: Entry, other: Candidate, start: Float[Array, " k"]) -> Float[Array, " k"]:
    """Another candidate's point with the numbers of the best, as far as they have the same names."""
    found = dict(zip(bench.columns(best.candidate), np.asarray(best.fit.z)[bench.d :].tolist(), strict=False))
    mine = bench.columns(other)
    replaced = {bench.parameters[i].name: bench.each[i].value(z) for i, z in found.items() if i not in mine}
    point = np.array(start)
    point[: bench.d] = best.fit.z[: bench.d]
    for j, i in enumerate(mine):
        if i in found:
            point[bench.d + j] = found[i]
        elif bench.parameters[i].name in replaced:
            point[bench.d + j] = bench.each[i].standard(replaced[bench.parameters[i].name])
    return jnp.asarray(point)


def _look_ahead(
    bench: Bench, none: Entry, entries: Sequence[Entry], ahead: Shots, thresholds: Thresholds
) -> list[Entry]:
    """How far candidates that may be named predict long windows better than the simulator without effects.

    Where the best does badly, what explains the misfit beside it is looked at, too. Returns who is shortsighted.
    """
    gone: list[Entry] = []
    for _ in range(TURNS):
        left = [entry for entry in entries if entry not in gone]
        _foresee(bench, none, [e for e in left if may_be_named(e, left, none, thresholds)], ahead)
        if not (left[0].ahead > thresholds.lacking or may_be_astray(left[0], thresholds)):
            break
        unseen = [e for e in left if np.isnan(e.ahead) and share_left(e.misfit, none.misfit) <= thresholds.left]
        _foresee(bench, none, [left[0], *unseen[:RIVALS]], ahead)
        found = find_shortsighted(left, none, thresholds)
        gone += found
        if not found:
            break
    return gone


def _foresee(bench: Bench, none: Entry, entries: Sequence[Entry], ahead: Shots) -> None:
    """Predict long windows with candidates of which the first is the best.

    Initial states are off by what the best candidate's fit moved them. With them goes what it remembers unseen, unless
    that excuses all that is missed: then it is no excuse.
    """
    best, remembered = entries[0], _remembered(bench, ahead)
    there = ahead.measured if remembered is None else ahead.measured & remembered[:, None, None]
    with ThreadPoolExecutor(WORKERS) as pool:
        base, *predicted = pool.map(lambda e: bench.replay(e.candidate, e.fit.z, ahead), [none, *entries])
    usual = best.fit.usual_move
    recorded = np.where(np.arange(len(usual)) < bench.shots.spread.size, usual, 0.0)
    moves = [usual, recorded] if (recorded != usual).any() else [usual]
    spreads = [np.nan_to_num(bench.scatter(best.candidate, best.fit.z, ahead, m, predicted[0])) for m in moves]
    for entry, here in zip(entries, predicted, strict=True):
        known = dataclasses.replace(ahead, measured=there) if _recalls(bench, entry.candidate) else ahead
        left = [error_left(known, here, base, entry.misfit.noise, spread) for spread in spreads]
        entry.ahead = left[0] if not np.isnan(left[0]) else left[-1]
        entry.unexcused = error_left(known, here, base, entry.misfit.noise, whole=True)


def _remembered(bench: Bench, shots: Shots) -> Bool[np.ndarray, " windows"] | None:
    """Windows before which so much was recorded as effects look back; None where these are few."""
    dt = bench.system.dt
    there = np.asarray(shots.inputs.time) > shots.inputs.past.shape[1] * dt - 0.5 * dt
    return there if there.mean() > ENOUGH else None


def _recalls(bench: Bench, candidate: Candidate, but_found: bool = False) -> bool:
    """Whether what a joint's motion has left in an effect when a recording begins matters, and is not known.

    `but_found`: nor found by fits.
    """
    effects = [bench.pairs[k][0] for k in candidate.effects]
    return any(getattr(e, "recalls", False) and (e.settles or not but_found) for e in effects)


def _folds(group: Int[np.ndarray, " windows"]) -> Bool[Array, "folds windows"]:
    """The windows of every group of recordings; of one recording alone, groups of its windows."""
    units = group if len(set(group.tolist())) > 1 else np.arange(len(group))
    labels = sorted(set(units.tolist()))
    return jax.device_put(np.array([np.isin(units, labels[i::FOLDS]) for i in range(min(FOLDS, len(labels)))]))


def enter(work: Work, candidate: Candidate, fit: Fit, known: Float[np.ndarray, "..."] | float = 0.0) -> Entry:
    """Score a candidate on windows that fits have not seen, recording by recording or in as many folds."""
    bench, spread = work.bench, work.bench.setup(candidate).spread
    measured = bench.shots.measured
    shared = jax.device_put(np.arange(spread.size) < bench.shots.spread.size)
    seen = (fit.r, fit.slopes, measured, fit.z, bench.free(candidate), fit.sigma)
    scores = cross_validate(*seen, work.floor, work.folds, fit.delta / spread, shared)
    scores = np.nan_to_num(scores, nan=-1e12)
    misfit_key = jax.random.fold_in(work.key, crc32(" ".join(map(bench.label, candidate.effects)).encode()))
    judged = work.remembered if _recalls(bench, candidate, but_found=True) else None
    misfit = judge_misfit(misfit_key, fit.misses, fit.along_states, np.asarray(measured), known, judged)
    share, seats = _log_share(bench, candidate, fit), bench.seats(candidate)
    told = bench.told(candidate, fit.z)
    names, guesses = [bench.name(k) for k in told], bench.unsettled(candidate) > 0
    return Entry(candidate, told, names, fit, scores, misfit, log_share=share, seats=seats, guesses=guesses)


def _log_share(bench: Bench, candidate: Candidate, fit: Fit) -> float:
    """Log of the share of its prior that a candidate's numbers are found in, or those of the law without one of them.

    A term whose sign is open and that is absent, a spring's cubic part for instance, is no coincidence, nor is a factor
    of 1, such as a resistance as it was believed beside the voltage that a motor induces: for the law that has neither
    the evidence is larger by the ratio of posterior to prior density there.

    Source: Dickey 1971
    """
    z, precision = np.asarray(fit.z), np.asarray(fit.precision)
    variance, simpler = np.diagonal(np.linalg.inv(precision)), [0.0]
    for k, i in enumerate(bench.columns(candidate), bench.d):
        parameter = bench.parameters[i]
        absent = parameter.neutral == (1.0 if parameter.log and not parameter.unit else 0.0)
        if absent and parameter.low < parameter.neutral < parameter.high:
            there = float(bench.each[i].standard(parameter.neutral))
            simpler.append(0.5 * (there**2 - (z[k] - there) ** 2 / variance[k] - np.log(variance[k])))
    return float(max(simpler) - 0.5 * z @ z - 0.5 * np.linalg.slogdet(precision)[1])
