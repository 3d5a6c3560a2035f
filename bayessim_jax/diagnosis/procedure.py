"""The diagnosis: detect, name, decide. Arrays in, a verdict out; what reads cases and writes files stands above it."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from bayessim_jax.beliefs.margins import Margins
from bayessim_jax.diagnosis.bench import SLOTS, Bench, Candidate
from bayessim_jax.diagnosis.whiteness import FALSE_ALARMS, Misfit, judge_misfit
from bayessim_jax.effects import Scales, at
from bayessim_jax.inference.direct import noise_floor
from bayessim_jax.inference.shooting import Fit, Shots
from bayessim_jax.systems.mjcf import MjcfSystem

__all__ = ["CONTAINS", "Diagnosis", "Entry", "Problem", "Thresholds", "detect", "enter", "name_effects", "share_left"]

CONTAINS = {
    "stribeck_friction": ("coulomb_friction",),
    "asymmetric_friction": ("coulomb_friction",),
    "load_dependent_friction": ("coulomb_friction",),
    "lugre_friction": ("coulomb_friction", "stribeck_friction"),
    "gain_drop": ("actuator_gain",),
    "gain_drift": ("actuator_gain",),
    "payload": ("link_offset",),
}
"""Effects that have others as special cases: where both do as well, the simpler one is the finding."""


SCREENED, STEPS = 16, 5
"""Windows and solver steps with which every candidate is tried at first."""
HEAVY = frozenset({"sensor_delay", "hysteresis"})
"""Effects that cost several times what the others do: they are tried on a bench of their own."""
FINALISTS, LEADERS, PAIRS = 10, 3, 4
"""Effects that are fitted to the end, those of them whose relatives are too, and pairs."""
WORTH = 0.3
"""Share of the best effect's first gain from which another is fitted to the end by itself, not in pairs alone."""
FOLDS = 4
"""Groups of recordings, each scored by fits to the others."""


@dataclass(frozen=True)
class Thresholds:
    """What decides; set on made-up worlds by `scripts/set_thresholds.py`, with whole families of effects left out."""

    negligible: float = 0.02
    """Share of the baseline's residual variance: what a candidate that removes less is not worth."""
    left: float = 0.05
    """Share of the baseline's misfit that an explanation may leave."""
    tie: float = 2.0
    """Standard errors within which two candidates predict held-out windows alike."""
    least: float = 4.0
    """Nats in all by which a candidate has to be worse to be out of the confusion set."""


@dataclass
class Entry:
    """A candidate, fitted to all windows that choose, and scored on windows that its fit did not see."""

    candidate: Candidate
    names: list[str]
    fit: Fit
    scores: Float[np.ndarray, " windows"]
    """Log predictive density of every window, its initial state profiled out."""
    misfit: Misfit
    variance: Float[np.ndarray, " obs"]
    """Of held-out residuals."""

    @property
    def score(self) -> float:
        """Sum over windows."""
        return float(self.scores.sum())


@dataclass
class Diagnosis:
    """What was found."""

    verdict: str
    bench: Bench
    """On which the candidates that came to the end were fitted."""
    baseline: Entry
    entries: list[Entry]
    """Candidates that came to the end, best first."""
    confusion: list[Entry] = field(default_factory=list)
    screened: list[tuple[str, float]] = field(default_factory=list)
    """Every candidate and how much it gained on the windows it was fitted to."""

    @property
    def best(self) -> Entry:
        """What the verdict names, or the best there was."""
        return self.confusion[0] if self.confusion else self.entries[0] if self.entries else self.baseline


@dataclass
class _Work:
    """Everything that the steps share."""

    key: PRNGKeyArray
    bench: Bench
    group: Int[np.ndarray, " windows"]
    chosen: Bool[np.ndarray, " windows"]
    floor: Array
    say: Callable[[str], None]

    def mask(self, which: Bool[np.ndarray, " windows"]) -> Array:
        """What was measured in some of the windows."""
        return self.bench.shots.measured & jnp.asarray(which)[:, None, None]

    def noise(self, squares: np.ndarray, which: np.ndarray, fitted: int) -> Array:
        """Noise from the squared residuals of some windows."""
        measured = np.asarray(self.bench.shots.measured)[which]
        counts = measured.sum((0, 1))
        states = self.bench.shots.spread.size * which.sum()
        share = max(1.0 - (fitted + states) / max(counts.sum(), 1), 0.2)
        sigma = np.sqrt(squares[which].sum(0) / np.maximum(counts * share, 1))
        return jnp.maximum(jnp.asarray(sigma), self.floor)

    def settle(self, candidate: Candidate, fit: Fit, which: np.ndarray, rounds: int = 4, steps: int = 12) -> Fit:
        """Fit a candidate and its noise in turn."""
        mask = self.mask(which)
        free = self.bench.d + len(self.bench.columns(candidate))
        for _ in range(rounds):
            squares = np.asarray((self.bench.look(candidate, fit, mask)[0] ** 2).sum(1))
            sigma = self.noise(squares, which, free)
            change = float(jnp.abs(jnp.log(sigma / fit.sigma)).max())
            fit = self.bench.fit(candidate, fit.z, fit.delta, sigma, mask, steps=steps)
            if change < 0.03:
                break
        return fit

    def likelihood(self, candidate: Candidate, fit: Fit, which: np.ndarray) -> float:
        """Log likelihood at the fit's own noise, up to a constant."""
        squares = np.asarray((self.bench.look(candidate, fit, self.mask(which))[0] ** 2).sum((0, 1)))
        counts = np.asarray(self.bench.shots.measured)[which].sum((0, 1))
        variance = np.maximum(squares / np.maximum(counts, 1), np.asarray(self.floor) ** 2)
        return float(-0.5 * (counts * np.log(variance)).sum())


@dataclass(frozen=True)
class Problem:
    """What a diagnosis is about: a system, what is believed of it, what may be missing, and windows of recordings."""

    system: MjcfSystem
    margins: Margins
    pairs: tuple[tuple[Any, str], ...]
    """Effects and places."""
    scales: Mapping[str, Scales]
    shots: Shots
    group: Int[np.ndarray, " windows"]
    """The recording of each window."""
    chosen: Bool[np.ndarray, " windows"]
    """Windows that choose; the others are never looked at."""
    step: float = 0.0

    def bench(self, pairs: Sequence[tuple[Any, str]], which: Any = slice(None), slots: int = SLOTS) -> Bench:
        """A bench for some of the pairs, with some of the windows."""
        shots = dataclasses.replace(
            self.shots,
            inputs=jax.tree.map(lambda x: x[which], self.shots.inputs),
            y=self.shots.y[which],
            measured=self.shots.measured[which],
        )
        return Bench(self.system, self.margins, pairs, self.scales, shots, self.step, slots)


def detect(key: PRNGKeyArray, problem: Problem, baseline: Fit, folds: int = FOLDS) -> tuple[Bench, Entry]:
    """The simulator without effects: fitted, scored across recordings, and tested for a mismatch.

    `baseline` is its fit to the problem's windows, where this begins.
    """
    nothing, bench = Candidate(), problem.bench(())
    work = _Work(key, bench, problem.group, problem.chosen, noise_floor(bench.shots), _quiet)
    x = bench.starts(nothing, baseline.z)[0]
    fit = bench.fit(nothing, x, baseline.delta, baseline.sigma, work.mask(problem.chosen), steps=8)
    return bench, _enter(work, nothing, work.settle(nothing, fit, problem.chosen), folds)


def name_effects(
    key: PRNGKeyArray,
    problem: Problem,
    none: Entry,
    *,
    thresholds: Thresholds | None = None,
    say: Callable[[str], None] = lambda text: None,
) -> Diagnosis:
    """Find what a simulator lacks whose misfit was detected.

    First every effect at every place, a few steps each on a part of the windows, on one bench that holds them all;
    then the best of them on a bench of their own, to the end, and in pairs where one is not enough.
    """
    thresholds = thresholds or Thresholds()
    say(f"trying {len(problem.pairs)} candidates; compiling takes a while")
    ranked = _screen(problem, none.fit, say)
    order, gains = [k for k, _ in ranked], dict(ranked)
    leaders = order[:LEADERS]
    kept = [k for i, k in enumerate(order) if i < FINALISTS or any(_are_kin(problem, k, j) for j in leaders)]
    worthy = [k for k in kept if gains[k] > WORTH * gains[order[0]] or any(_are_kin(problem, k, j) for j in leaders)]
    bench = problem.bench([problem.pairs[k] for k in kept])
    work = _Work(key, bench, problem.group, problem.chosen, noise_floor(bench.shots), say)
    entries = _finish(work, none.fit, [Candidate((kept.index(k),)) for k in dict.fromkeys([*leaders, *worthy])], FOLDS)
    if entries and share_left(entries[0], none) > thresholds.left:
        entries = _extend(work, entries, FOLDS)
    listed = [(f"{problem.pairs[k][0].name}@{at(problem.pairs[k][1])}", gain) for k, gain in ranked]
    return _decide(work, none, entries, listed, thresholds)


def _quiet(text: str) -> None:
    """Say nothing."""


def _are_kin(problem: Problem, one: int, other: int) -> bool:
    """Whether of two pairs at one place the one has the other as a special case."""
    (effect, place), (relative, where) = problem.pairs[one], problem.pairs[other]
    kin = effect.name in CONTAINS.get(relative.name, ()) or relative.name in CONTAINS.get(effect.name, ())
    return kin and place == where


def _screen(problem: Problem, start: Fit, say: Callable[[str], None]) -> list[tuple[int, float]]:
    """Every pair and what it lowers the cost by in a few steps, the best first."""
    rows = np.flatnonzero(problem.chosen)
    rows = rows[np.unique(np.linspace(0, len(rows) - 1, SCREENED).astype(int))]
    groups = [
        [k for k, (effect, _) in enumerate(problem.pairs) if (effect.name in HEAVY) == heavy] for heavy in (False, True)
    ]
    with ThreadPoolExecutor(len(groups)) as pool:  # each compiles a program of its own
        parts = pool.map(lambda numbers: _screen_group(problem, start, rows, numbers, say), groups)
        found = [item for part in parts for item in part]
    return sorted(found, key=lambda item: -item[1])


def _screen_group(
    problem: Problem, start: Fit, rows: np.ndarray, numbers: Sequence[int], say: Callable[[str], None]
) -> list[tuple[int, float]]:
    """Some of the pairs, on one bench."""
    if not numbers:
        return []
    nothing, found = Candidate(), []
    bench = problem.bench([problem.pairs[k] for k in numbers], rows)
    delta, mask = start.delta[rows], bench.shots.measured
    before = bench.fit(nothing, bench.starts(nothing, start.z[: bench.d])[0], delta, start.sigma, mask, steps=3)
    for i, k in enumerate(numbers):
        candidate = Candidate((i,))
        if not bench.fits(candidate):
            continue
        costs = [
            float(bench.fit(candidate, x, before.delta, start.sigma, mask, steps=STEPS).cost)
            for x in bench.starts(candidate, start.z[: bench.d])
        ]
        costs = [cost for cost in costs if np.isfinite(cost)]
        if costs:
            found.append((k, float(before.cost) - min(costs)))
        if i % 20 == 19:
            say(f"tried {i + 1} of {len(numbers)}")
    return found


def _fit(work: _Work, candidate: Candidate, start: Fit, known: Fit | None = None, own: Candidate | None = None) -> Any:
    """The best fit from a candidate's starts, with `known` values for the effects of `own`."""
    bench, mask, best = work.bench, work.mask(work.chosen), None
    for x in bench.starts(candidate, start.z[: bench.d]):
        if known is not None and own is not None:
            columns = bench.columns(candidate)
            for j, column in enumerate(bench.columns(own)):
                x = x.at[bench.d + columns.index(column)].set(known.z[bench.d + j])
        fit = bench.fit(candidate, x, start.delta, start.sigma, mask, steps=12)
        if np.isfinite(float(fit.cost)) and (best is None or float(fit.cost) < float(best.cost)):
            best = fit
    return best


def _finish(work: _Work, start: Fit, candidates: Sequence[Candidate], folds: int) -> list[Entry]:
    """Candidates, fitted to the end and scored across recordings, best first."""
    entries = []
    for candidate in candidates:
        fit = _fit(work, candidate, start)
        if fit is not None:
            entries.append(_enter(work, candidate, work.settle(candidate, fit, work.chosen), folds))
            work.say(f"{' + '.join(entries[-1].names)}: score {entries[-1].score:.1f}")
    return sorted(entries, key=lambda entry: -entry.score)


def _extend(work: _Work, entries: list[Entry], folds: int) -> list[Entry]:
    """Pairs of the best effects with every other one on the bench."""
    bench, found, seen = work.bench, [], set()
    for entry in entries[:2]:
        for k in range(len(bench.pairs)):
            pair = entry.candidate + Candidate((k,))
            if pair in seen or len(pair.effects) < 2 or not bench.fits(pair):
                continue
            seen.add(pair)
            fit = _fit(work, pair, entry.fit, entry.fit, entry.candidate)
            if fit is not None:
                fit = work.settle(pair, fit, work.chosen, rounds=1, steps=6)
                found.append((pair, fit, work.likelihood(pair, fit, work.chosen)))
    work.say(f"tried {len(found)} pairs")
    found.sort(key=lambda item: -item[2] + len(bench.columns(item[0])))
    for pair, fit, _ in found[:PAIRS]:
        entries.append(_enter(work, pair, work.settle(pair, fit, work.chosen), folds))
        work.say(f"{' + '.join(entries[-1].names)}: score {entries[-1].score:.1f}")
    return sorted(entries, key=lambda entry: -entry.score)


def enter(key: PRNGKeyArray, problem: Problem, bench: Bench, candidate: Candidate, start: Fit, folds: int = 2) -> Entry:
    """Fit one candidate of another bench from a baseline's fit, and score it as all candidates are."""
    chosen = problem.chosen
    work = _Work(key, bench, problem.group, chosen, noise_floor(bench.shots), _quiet)
    x = bench.starts(Candidate(), start.z[: bench.d])[0]
    fit = bench.fit(candidate, x, start.delta, start.sigma, work.mask(chosen), steps=10)
    return _enter(work, candidate, work.settle(candidate, fit, chosen, rounds=3, steps=8), folds)


def _enter(work: _Work, candidate: Candidate, fit: Fit, folds: int) -> Entry:
    """Score a candidate on windows that its fit has not seen, recording by recording or in as many folds."""
    bench, chosen = work.bench, work.chosen
    labels = sorted(set(work.group[chosen].tolist()))
    units = work.group if len(labels) > 1 else np.arange(len(work.group))
    labels = sorted(set(units[chosen].tolist()))
    parts = [labels[i::folds] for i in range(min(folds, len(labels)))]
    measured = np.asarray(bench.shots.measured)
    scores = np.zeros(len(chosen))
    left = np.zeros(measured.shape)
    for part in parts:
        out = chosen & np.isin(units, part)
        kept = chosen & ~out
        if not kept.any():
            kept = chosen
        trained = work.settle(candidate, fit, kept, rounds=1, steps=6)
        judged = bench.fit(candidate, trained.z, fit.delta, trained.sigma, work.mask(out), steps=6, only_states=True)
        r = np.asarray(bench.look(candidate, judged, work.mask(out))[0])
        r = np.where(np.isfinite(r), r, 1e6)
        sigma = np.asarray(trained.sigma)
        logs = np.where(measured, -0.5 * (r / sigma) ** 2 - np.log(sigma), 0.0)
        scores = np.where(out, logs.sum((1, 2)), scores)
        left = np.where(out[:, None, None], r, left)
    misfit_key = jax.random.fold_in(work.key, sum(2**k for k in candidate.effects) % (2**31))
    mask = work.mask(chosen)
    residual, slopes = bench.look(candidate, fit, mask)
    misfit = judge_misfit(misfit_key, np.asarray(residual), slopes, np.asarray(mask))
    counts = measured[chosen].sum((0, 1))
    variance = (np.where(measured, left, 0.0)[chosen] ** 2).sum((0, 1)) / np.maximum(counts, 1)
    return Entry(candidate, bench.names(candidate), fit, scores, misfit, variance)


def share_left(entry: Entry, none: Entry) -> float:
    """Share of the baseline's misfit that a candidate leaves, both in units of the smaller noise."""
    noise = np.minimum(entry.misfit.noise, none.misfit.noise)
    own = (entry.misfit.excess * (entry.misfit.noise / noise) ** 2).sum()
    before = (none.misfit.excess * (none.misfit.noise / noise) ** 2).sum()
    return float(max(own, 0.0) / max(before, 1e-12))


def _decide(
    work: _Work, none: Entry, entries: list[Entry], screened: list[tuple[str, float]], thresholds: Thresholds
) -> Diagnosis:
    """One of four verdicts."""
    result = Diagnosis("unexplained", work.bench, none, entries, [], screened)
    if not entries:
        return result
    best = entries[0]
    removed = 1 - float((best.variance / np.maximum(none.variance, 1e-300)).min())
    if removed < thresholds.negligible or best.score - none.score < thresholds.least:
        result.verdict = "no_mismatch"
        return result
    tied = [entry for entry in entries if _ties(entry, best, work.chosen, thresholds)]
    fewest = min(len(entry.candidate.effects) for entry in tied)
    tied = [entry for entry in tied if len(entry.candidate.effects) == fewest]
    tied = [entry for entry in tied if not _contains_another(entry, tied)]
    explaining = [e for e in tied if share_left(e, none) <= thresholds.left or e.misfit.p_value >= FALSE_ALARMS]
    if not explaining:
        return result
    result.confusion = sorted(explaining, key=lambda e: (len(work.bench.columns(e.candidate)), -e.score))
    result.verdict = "explained" if len(result.confusion) == 1 else "ambiguous"
    return result


def _ties(entry: Entry, best: Entry, chosen: np.ndarray, thresholds: Thresholds) -> bool:
    """Whether a candidate predicts held-out windows as well as the best one, within the error of the difference.

    Differences beyond three times their median are cut there: one window that a candidate cannot follow at all says no
    more against it than any other that it cannot follow.
    """
    difference = (best.scores - entry.scores)[chosen]
    most = 3 * max(float(np.median(np.abs(difference))), 1e-9)
    difference = np.clip(difference, -most, most)
    error = difference.std(ddof=1) * np.sqrt(len(difference)) if len(difference) > 1 else 0.0
    return float(difference.sum()) <= max(thresholds.tie * error, thresholds.least)


def _contains_another(entry: Entry, tied: Sequence[Entry]) -> bool:
    """Whether another candidate among the ties is this one with an effect replaced by a special case of it."""

    def split(name: str) -> tuple[str, str]:
        effect, _, place = name.partition("@")
        return effect, place

    for other in tied:
        if other is entry or len(other.names) != len(entry.names):
            continue
        mine, theirs = set(entry.names) - set(other.names), set(other.names) - set(entry.names)
        if len(mine) != 1 or len(theirs) != 1:
            continue
        (effect, place), (simpler, where) = split(mine.pop()), split(theirs.pop())
        if simpler in CONTAINS.get(effect, ()) and place == where:
            return True
    return False
