"""The diagnosis: detect, name, decide."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence

import numpy as np
from jaxtyping import Bool, Float, PRNGKeyArray

from bayessim_jax.diagnosis.bench import Bench, Candidate
from bayessim_jax.diagnosis.finals import Finals, Work, enter, without_effects
from bayessim_jax.diagnosis.problem import Problem
from bayessim_jax.diagnosis.screen import Screen, Screened
from bayessim_jax.diagnosis.search import PAIRS, Growth, finalists, find_pairs, rank, varied, with_room
from bayessim_jax.diagnosis.verdict import (
    Diagnosis,
    Entry,
    Thresholds,
    contenders,
    decide,
    explains,
    is_worth,
    most_left,
    share_left,
)
from bayessim_jax.diagnosis.whiteness import FALSE_ALARMS
from bayessim_jax.inference.direct import noise_floor
from bayessim_jax.inference.replay import Restarted
from bayessim_jax.inference.shooting import Fit

__all__ = ["detect", "is_hidden", "is_mismatch", "name_effects"]

SHOWN = 0.1
"""Power of the misfit over that of the noise that windows have to show, for what candidates leave to tell much."""
LOST = 0.8
"""Share of the misfit that the best of them leaves along the motion, from where on their order there says nothing."""
WIDEST = 4
"""Effects of a set."""
TELLING = 20.0
"""Nats by which a pair explains more along the motion than the best single effect, from where on it is simulated even
if it leaves as much of the misfit there: that may be the screen's own error."""
EDGE = 3.0
"""Standard deviations of a parameter's prior, as a normal variable, from where on it is driven there."""


def detect(
    key: PRNGKeyArray, problem: Problem, baseline: Fit, known: Float[np.ndarray, "windows rows obs"] | float = 0.0
) -> tuple[Bench, Entry]:
    """The simulator without effects, tested for a mismatch from its fit to the problem's windows.

    `known` is what is known of its errors: what they explain is no mismatch.
    """
    nothing, bench = Candidate(), problem.bench(())
    work = Work(key, bench, problem.group, noise_floor(bench.shots))
    x = bench.starts(nothing, baseline.z)[0]
    fit = bench.fit(nothing, x, baseline.delta, baseline.sigma, steps=8)
    return bench, enter(work, nothing, work.settle(nothing, fit), known=known)


def is_mismatch(problem: Problem, detected: Entry, thresholds: Thresholds | None = None) -> bool:
    """Whether the simulator's misfit is neither chance nor too small against the noise to matter."""
    thresholds = thresholds or Thresholds()
    size = detected.misfit.size(np.asarray(problem.shots.measured))
    return detected.misfit.p_value < FALSE_ALARMS and size > thresholds.negligible


def is_hidden(key: PRNGKeyArray, problem: Problem, detected: Entry) -> bool:
    """Whether noise hides in the problem's windows most of what the simulator lacks, which was detected in others."""
    screen = problem.every
    nothing = screen.begin(detected.fit.z[: screen.d], detected.fit.sigma)
    return screen.misfit(key, nothing).size(np.asarray(screen.scene.shots.measured)) < SHOWN


def name_effects(
    key: PRNGKeyArray,
    problem: Problem,
    detected: Entry,
    *,
    thresholds: Thresholds | None = None,
    say: Callable[[str], None] = lambda text: None,
    go_on: Callable[[Bench, Entry], bool] = lambda bench, best: True,
) -> Diagnosis:
    """Find what a simulator lacks whose misfit was detected.

    First every effect at every place along the recorded motion (`diagnosis.screen`), or, in a system without a model,
    simulated from few points; then the best of them are simulated on a bench of their own, pairs where one is not
    enough, and larger sets where the best pair is worth both of its effects and is not enough either. `go_on` is asked
    with the best single effect before that, and may end the search.
    """
    thresholds = thresholds or Thresholds()
    screen, start = problem.every, detected.fit
    say(f"holding {len(problem.pairs)} candidates against the recorded motion")
    nothing = screen.begin(start.z[: screen.d], start.sigma)
    screens = problem.screens()
    ranked, begun = rank(screens, nothing, say)
    growth = Growth(screens, begun)
    listed = [(screen.name(each.candidate), each.likelihood - nothing.score) for each in begun]
    if not ranked:
        return Diagnosis("unexplained", *detect(key, problem, problem.still(start)), [])
    before = screen.misfit(key, nothing)
    remain = lambda found: share_left(screen.misfit(key, found), before)  # noqa: E731
    lost = before.p_value >= FALSE_ALARMS or remain(ranked[0]) > LOST
    singles = ranked if lost else finalists(screen, nothing, ranked)
    work = Work.on(key, problem, say)
    none = without_effects(work, problem, detected)
    finals = Finals(work, none, remain, problem.ahead, thresholds)
    entries = finals.hold(singles)
    if entries and not go_on(work.bench, entries[0]):
        return Diagnosis("unexplained", work.bench, none, entries, screened=listed)
    if _is_not_enough(problem, entries, none, thresholds):
        say("one effect is not enough: trying pairs")
        entries = _hold_sets(key, problem, finals, growth, entries, nothing, ranked)
    return decide(work.bench, none, entries, work.group, thresholds, listed)


def _is_not_enough(problem: Problem, entries: Sequence[Entry], none: Entry, thresholds: Thresholds) -> bool:
    """Whether the best single effect leaves reason to look for another one beside it."""
    if not entries or not explains(entries[0], none, thresholds):
        return True
    best = entries[0]
    return (
        share_left(best.misfit, none.misfit) > thresholds.enough
        # where nothing is predicted ahead, what shows in the windows themselves is all that tells of another effect
        or (problem.ahead is None and best.misfit.p_value < FALSE_ALARMS)
        or best.ahead > thresholds.doubtful
        or _is_cornered(best, problem.margins.size)
        or _leave_a_rest(entries, none, np.asarray(problem.shots.measured), thresholds)
    )


def _hold_sets(
    key: PRNGKeyArray,
    problem: Problem,
    finals: Finals,
    growth: Growth,
    entries: list[Entry],
    nothing: Screened,
    ranked: Sequence[Screened],
) -> list[Entry]:
    """Pairs, and larger sets where the best pair is worth both of its effects and is not enough either.

    From the single effects, as they were `ranked` along the motion, and the `entries` that were simulated.
    """
    work, none, thresholds, remain = finals.work, finals.none, finals.thresholds, finals.remain
    explained = bool(entries) and explains(entries[0], none, thresholds)
    worth = thresholds.worth * remain(ranked[0]) if explained else np.inf
    found = find_pairs(key, growth, nothing, ranked)
    # without a model there is no motion to hold candidates against: what was simulated already is in its order
    chosen = found[:PAIRS] if isinstance(problem.system, Restarted) else varied(found, nothing.score)
    pairs = [pair for pair in chosen if remain(pair) < worth or pair.score > ranked[0].score + TELLING]
    if not pairs:
        return entries
    alone = {k for pair in pairs for k in pair.candidate.effects}
    best = {k for entry in entries[:2] for k in entry.candidate.effects}
    singly = [found for found in ranked if found.candidate.effects[0] in alone | best]
    kept = [*pairs, *singly, *growth.parts(pairs[0], {found.candidate for found in singly})]
    entries = finals.hold(kept)
    while entries and _is_too_narrow(entries, none, thresholds):
        leads = [_settled(problem.every, entry, kept) for entry in _widest(work.bench, none, entries)]
        grown = [(found, known) for known in leads for found in growth.extend(known)]
        wider = [found for found, known in grown if remain(found) < thresholds.worth * remain(known)]
        if not wider:
            break
        work.say(f"{len(leads[0].candidate.effects)} effects are not enough: trying another one")
        wider = sorted(wider, key=lambda found: -found.score)[:PAIRS]
        kept = [*wider, *kept]
        entries = finals.hold(kept)
    spared = _spare(finals.done, problem.every, entries, kept) if entries else []
    if spared:
        work.say("trying what is left without each of its effects")
        entries = finals.hold([*spared, *kept])
    return entries


def _leave_a_rest(
    entries: Sequence[Entry], none: Entry, measured: Bool[np.ndarray, "windows rows obs"], thresholds: Thresholds
) -> bool:
    """Whether more shows of what every contender leaves than its form: in pieces, ahead or in one channel."""

    def leaves(entry: Entry) -> bool:
        of_all, of_one = share_left(entry.misfit, none.misfit), most_left(entry.misfit, none.misfit, measured)
        return of_all > thresholds.rest or entry.ahead > thresholds.rest_ahead or of_one > thresholds.apart

    tied = contenders(entries, none, thresholds)
    return all(entry.misfit.p_value < FALSE_ALARMS and leaves(entry) for entry in tied)


def _is_cornered(entry: Entry, d: int) -> bool:
    """Whether a candidate drives a parameter to the edge of its prior, and leaves something that shows."""
    return entry.misfit.p_value < FALSE_ALARMS and bool((np.abs(np.asarray(entry.fit.z)[:d]) > EDGE).any())


def _is_too_narrow(entries: Sequence[Entry], none: Entry, thresholds: Thresholds) -> bool:
    """Whether the best set has as many effects as any that was tried, is worth them all, and is not enough."""
    best = entries[0]
    size = len(best.candidate.effects)
    if size < max(len(entry.candidate.effects) for entry in entries) or size >= WIDEST:
        return False
    left = share_left(best.misfit, none.misfit)
    lacking = not explains(best, none, thresholds) or left > thresholds.enough or best.ahead > thresholds.lacking
    return lacking and is_worth(best, entries, none, thresholds)


def _widest(bench: Bench, none: Entry, entries: Sequence[Entry]) -> list[Entry]:
    """The best set, and others of as many effects that leave room for more."""
    size = len(entries[0].candidate.effects)
    alike = [entry for entry in entries if len(entry.candidate.effects) == size]
    return with_room(alike, 1, lambda e: len(bench.columns(e.candidate)), lambda e: e.score - none.score)


def _settled(screen: Screen, entry: Entry, kept: Sequence[Screened]) -> Screened:
    """What was found in simulation, fitted along the motion again."""
    # a twin may not have been along the motion before; the corrections of the best that was do as a beginning
    known = next((found for found in kept if found.candidate == entry.candidate), kept[0])
    return screen.settle(entry.candidate, entry.fit.z, known.delta, entry.fit.sigma) or known


def _spare(
    done: Collection[Candidate], screen: Screen, entries: Sequence[Entry], kept: Sequence[Screened]
) -> list[Screened]:
    """The best set without each of its effects, where that has not been simulated: sets grow towards what they lack.

    What mimicked the rest first may be of no use beside the rest.
    """
    best = entries[0]
    effects = best.candidate.effects
    if len(effects) <= 2:
        return []
    whole = _settled(screen, best, kept)
    parts = [screen.part(whole, tuple(k for k in effects if k != spared)) for spared in effects]
    ended = [screen.settle(p.candidate, p.p, p.delta, p.sigma) for p in parts if p.candidate not in done]
    return [each for each in ended if each is not None]
