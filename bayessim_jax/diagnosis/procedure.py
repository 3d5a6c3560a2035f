"""The diagnosis: detect, name, decide. Arrays in, a verdict out; what reads cases and writes files stands above it."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import cached_property, partial
from itertools import count, islice, product
from typing import Any, TypeVar
from zlib import crc32

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from bayessim_jax.beliefs.margins import Margins
from bayessim_jax.diagnosis.bench import SLOTS, Bench, Candidate
from bayessim_jax.diagnosis.response import Motion, cross_validate
from bayessim_jax.diagnosis.scene import Scene
from bayessim_jax.diagnosis.screen import LEAST_SHARE, Begun, March, Screen, Screened
from bayessim_jax.diagnosis.simulated_scene import SimulatedScene
from bayessim_jax.diagnosis.verdict import (
    Diagnosis,
    Entry,
    Thresholds,
    are_kin,
    are_siblings,
    can_stand_for,
    contains,
    contenders,
    decide,
    error_left,
    explains,
    find_shortsighted,
    has_special_case,
    is_worth,
    may_be_astray,
    may_be_named,
    most_left,
    share_left,
)
from bayessim_jax.diagnosis.whiteness import FALSE_ALARMS, judge_misfit
from bayessim_jax.effects import Scales
from bayessim_jax.inference.direct import estimate_noise, noise_floor
from bayessim_jax.inference.replay import Restarted
from bayessim_jax.inference.shooting import Fit, Shots
from bayessim_jax.systems.mjcf import MjcfSystem

__all__ = ["Problem", "detect", "is_hidden", "is_mismatch", "name_effects"]

T, R = TypeVar("T"), TypeVar("R")

SCREENED = 30
"""Windows with which every candidate is tried at first."""
SHOWN = 0.1
"""Power of the misfit over that of the noise that windows have to show, for what candidates leave to tell much."""
FINALISTS, LEADERS, PAIRS = 7, 2, 4
"""Single effects that are simulated at most, at least, and pairs."""
LOST = 0.8
"""Share of the misfit that the best of them leaves along the motion, from where on their order there says nothing."""
NEAR, ALIKE, VARIED = 0.75, 2, 2
"""Share of the best pair's gain from which pairs with other effects are simulated, so many with each, and in all."""
RACED, PLACES = 40, 2
"""Candidates, and places of each effect, that go on after their first steps along the motion."""
FINISHED = 14
"""Single effects that are fitted to the end along the motion."""
STUCK = 2.0
"""Nats by which an effect with a special case explains less than that one, more than its parameters cost, where it is
begun from that one's numbers."""
GLANCED = 4
"""Partners of a leader that are fitted to the end."""
GLANCING, FIRST_STEPS, BEGUN = 7, 1, 3
"""Steps of the solver by which partners are ranked, those by which many of them are at first, and from how many points
each of them goes on then."""
WIDEST = 4
"""Effects of a set."""
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
TELLING = 20.0
"""Nats by which a pair explains more along the motion than the best single effect, from where on it is simulated even
if it leaves as much of the misfit there: that may be the screen's own error."""
TURNED = 4
"""Pairs of which the order is looked at, where it matters."""
GENERAL = 8
"""Pairs that are begun from the numbers of a special case of them."""
DRY = ("coulomb_friction", "stribeck_friction")
"""Laws of dry friction that are special cases of others."""
KIN = 2
"""Relatives of the best pair's members, of which partners are looked for as well."""
WORTH = 0.5
"""Share of the best effect's gain from which another is simulated."""
EDGE = 3.0
"""Standard deviations of a parameter's prior, as a normal variable, from where on it is driven there."""
DOUBT = 0.05
"""Probability that a model fails in a window, where the simulator without effects then predicts."""
WORKERS = 2
"""Candidates that are tried at the same time."""
ROUNDS, STEPS = 4, 8
"""Of a fit and its noise after the first fit, at most, and of the solver in each."""
ENOUGH = 0.5
"""Share of the windows that have to be known to have a full past, for the others not to count against a memory."""
FOLDS = 4
"""Groups of recordings, each scored by fits to the others."""


@dataclass
class _Work:
    """Everything that the steps share."""

    key: PRNGKeyArray
    bench: Bench
    group: Int[np.ndarray, " windows"]
    floor: Array
    say: Callable[[str], None]
    remembered: Bool[np.ndarray, " windows"] | None = None
    """Windows before which as much was recorded as effects remember, unless that is so for few."""
    done: dict[Candidate, Entry] = field(default_factory=dict)
    """What was simulated and fitted already."""

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


@dataclass(frozen=True)
class Problem:
    """What a diagnosis is about: a system, what is believed of it, what may be missing, and windows of recordings."""

    system: MjcfSystem | Restarted
    margins: Margins
    pairs: tuple[tuple[Any, str], ...]
    """Effects and places."""
    scales: Mapping[str, Scales]
    shots: Shots
    group: Int[np.ndarray, " windows"]
    """The recording of each window."""
    motion: Motion | None
    """The smoothed motion in the same windows; None for a system without a model, which is simulated instead."""
    step: float = 0.0
    ahead: Shots | None = None
    """Windows as long as predictions are to be, to which nothing is fitted."""

    @cached_property
    def every(self) -> Screen:
        """All pairs, to be held against some of the windows."""
        return self.screen(self.pairs)

    def screen(self, pairs: Sequence[tuple[Any, str]], slots: int = SLOTS) -> Screen:
        """Pairs to be held against some of the windows."""
        count = len(self.group)
        rows = np.unique(np.linspace(0, count - 1, min(SCREENED, count)).astype(int))
        every = (self.motion, self.shots.inputs, self.shots.y, self.shots.measured)
        motion, inputs, y, measured = jax.tree.map(lambda x: jax.device_put(np.asarray(x)[rows]), every)
        shots = dataclasses.replace(self.shots, inputs=inputs, y=y, measured=measured)
        if isinstance(self.system, Restarted):
            return Screen(SimulatedScene(Bench(self.system, self.margins, pairs, self.scales, shots, slots=slots)))
        assert motion is not None
        return Screen(Scene(self.system, self.margins, pairs, self.scales, shots, motion, self.step, slots))

    def bench(self, pairs: Sequence[tuple[Any, str]], slots: int = SLOTS) -> Bench:
        """A bench for these pairs."""
        return Bench(self.system, self.margins, pairs, self.scales, self.shots, self.step, slots)


def detect(
    key: PRNGKeyArray, problem: Problem, baseline: Fit, known: Float[np.ndarray, "windows rows obs"] | float = 0.0
) -> tuple[Bench, Entry]:
    """The simulator without effects, tested for a mismatch from its fit to the problem's windows.

    `known` is what is known of its errors: what they explain is no mismatch.
    """
    nothing, bench = Candidate(), problem.bench(())
    work = _Work(key, bench, problem.group, noise_floor(bench.shots), _quiet)
    x = bench.starts(nothing, baseline.z)[0]
    fit = bench.fit(nothing, x, baseline.delta, baseline.sigma, steps=8)
    return bench, _enter(work, nothing, work.settle(nothing, fit), known=known)


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
    screens = [screen, *(screen.twin() for _ in range(1, WORKERS))]
    say(f"holding {len(problem.pairs)} candidates against the recorded motion")
    nothing = screen.begin(start.z[: screen.d], start.sigma)
    ranked, begun = _rank(screens, nothing, say)
    listed = [(screen.name(each.candidate), each.likelihood - nothing.score) for each in begun]
    if not ranked:
        return Diagnosis("unexplained", *detect(key, problem, _still(problem, start)), [])
    before = screen.misfit(key, nothing)
    remain = lambda found: share_left(screen.misfit(key, found), before)  # noqa: E731
    lost = before.p_value >= FALSE_ALARMS or remain(ranked[0]) > LOST
    singles = ranked if lost else _finalists(screen, nothing, ranked)
    work = _begin_work(key, problem, say)
    none = _without(work, problem, detected)
    finish = partial(_finish, work, none, remain, ahead=problem.ahead, thresholds=thresholds)
    entries = finish(singles)
    if entries and not go_on(work.bench, entries[0]):
        return Diagnosis("unexplained", work.bench, none, entries, screened=listed)
    left = share_left(entries[0].misfit, none.misfit) if entries else 1.0
    explained = bool(entries) and explains(entries[0], none, thresholds)
    # where nothing is predicted ahead, what shows in the windows themselves is all that tells of another effect
    shows = explained and problem.ahead is None and entries[0].misfit.p_value < FALSE_ALARMS
    doubtful = explained and (entries[0].ahead > thresholds.doubtful or _is_cornered(entries[0], screen.d))
    if (
        left > thresholds.enough
        or not explained
        or shows
        or doubtful
        or _leave_a_rest(entries, none, np.asarray(problem.shots.measured), thresholds)
    ):
        say("one effect is not enough: trying pairs")
        worth = thresholds.worth * remain(ranked[0]) if explained else np.inf
        growth = _Growth(screens, begun)
        found = _pair(key, growth, nothing, ranked)
        # without a model there is no motion to hold candidates against: what was simulated already is in its order
        chosen = found[:PAIRS] if isinstance(problem.system, Restarted) else _varied(found, nothing.score)
        pairs = [pair for pair in chosen if remain(pair) < worth or pair.score > ranked[0].score + TELLING]
        if pairs:
            alone = {k for pair in pairs for k in pair.candidate.effects}
            best = {k for entry in entries[:2] for k in entry.candidate.effects}
            singly = [found for found in ranked if found.candidate.effects[0] in alone | best]
            kept = [*pairs, *singly, *growth.parts(pairs[0], {found.candidate for found in singly})]
            entries = finish(kept)
            while entries and _is_too_narrow(entries, none, thresholds):
                leads = [_settled(screen, entry, kept) for entry in _widest(work.bench, none, entries)]
                grown = [(found, known) for known in leads for found in growth.extend(known)]
                wider = [found for found, known in grown if remain(found) < thresholds.worth * remain(known)]
                if not wider:
                    break
                say(f"{len(leads[0].candidate.effects)} effects are not enough: trying another one")
                wider = sorted(wider, key=lambda found: -found.score)[:PAIRS]
                kept = [*wider, *kept]
                entries = finish(kept)
            spared = _spare(work, screen, entries, kept) if entries else []
            if spared:
                say("trying what is left without each of its effects")
                entries = finish([*spared, *kept])
    return decide(work.bench, none, entries, work.group, thresholds, listed)


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
    return _with_room(alike, 1, lambda e: len(bench.columns(e.candidate)), lambda e: e.score - none.score)


def _settled(screen: Screen, entry: Entry, kept: Sequence[Screened]) -> Screened:
    """What was found in simulation, fitted along the motion again."""
    # a twin may not have been along the motion before; the corrections of the best that was do as a beginning
    known = next((found for found in kept if found.candidate == entry.candidate), kept[0])
    return screen.settle(entry.candidate, entry.fit.z, known.delta, entry.fit.sigma) or known


def _spare(work: _Work, screen: Screen, entries: Sequence[Entry], kept: Sequence[Screened]) -> list[Screened]:
    """The best set without each of its effects, where that has not been simulated: sets grow towards what they lack.

    What mimicked the rest first may be of no use beside the rest.
    """
    best = entries[0]
    effects = best.candidate.effects
    if len(effects) <= 2:
        return []
    whole = _settled(screen, best, kept)
    parts = [screen.part(whole, tuple(k for k in effects if k != spared)) for spared in effects]
    ended = [screen.settle(p.candidate, p.p, p.delta, p.sigma) for p in parts if p.candidate not in work.done]
    return [each for each in ended if each is not None]


class _Growth:
    """Sets of effects that grow by one effect at a time along the motion; none is tried twice."""

    def __init__(self, screens: Sequence[Screen], begun: Sequence[Begun]) -> None:
        self.screens = screens
        self.seen: set[Candidate] = set()
        self.alone = {each.candidate.effects[0]: screens[0].own(each) for each in begun}

    def extend(self, known: Screened) -> list[Screened]:
        """The best sets of the known effects and another one, or with one of them on each actuator by itself."""
        first = self.screens[0]
        wider = {known.candidate + Candidate((k,)): k for k in first.reach(known)}
        larger = len(known.candidate.effects) + 1
        tried = [
            s
            for s, k in wider.items()
            if len(s.effects) == larger
            and s not in self.seen
            and first.takes(s)
            and not any(_are_one_law(first, k, other) for other in known.candidate.effects)
        ]
        self.seen.update(tried)
        many = len(tried) > RACED
        glanced = self._glance(known, self._begin(known, tried, wider), FIRST_STEPS if many else GLANCING)
        if many:
            going = [list(glanced)[i] for i in _promising(first, [wider[s] for s in glanced])]
            glanced = self._glance(known, {s: glanced[s] for s in going}, GLANCING)
        best = list(glanced)[:GLANCED]
        # a glance may miss what its general case shows
        best += [
            s
            for s in tried
            if s not in best and any(_is_special_case(self.screens[0], wider[s], wider[b]) for b in best)
        ]

        grown = [(s, known) for s in best]
        split = [(s, first.part(known, kept)) for s, kept in first.scene.apart(known.candidate)]
        split = [(s, kept) for s, kept in split if s not in self.seen and first.takes(s)]
        self.seen.update(s for s, _ in split)

        every = _each(self.screens, [*grown, *split], lambda screen, item: _search(screen, *item))
        return [each for each in every if each is not None]

    def parts(self, known: Screened, but: Collection[Candidate]) -> list[Screened]:
        """Every effect of a set by itself, from its numbers there: beside another one it may be found by chance."""
        first = self.screens[0]
        parts = [first.part(known, (k,)) for k in known.candidate.effects]
        ended = [first.settle(p.candidate, p.p, p.delta, p.sigma) for p in parts if p.candidate not in but]
        return [each for each in ended if each is not None]

    def _begin(
        self, known: Screened, tried: Sequence[Candidate], added: Mapping[Candidate, int]
    ) -> dict[Candidate, list[March]]:
        """Fits of candidates that add an effect to what is known, before they move."""
        found = _each(self.screens, tried, lambda screen, s: screen.beside(s, known, self.alone.get(added[s])))
        return dict(zip(tried, found, strict=True))

    def _glance(
        self, known: Screened, marches: Mapping[Candidate, Sequence[March]], steps: int
    ) -> dict[Candidate, list[March]]:
        """The best fits of every candidate after so many steps; the best candidates first."""

        def glance(screen: Screen, s: Candidate) -> list[March]:
            return screen.glance(s, known, marches[s], steps)[:BEGUN]

        found = _each(self.screens, list(marches), glance)
        begun = [(s, each) for s, each in zip(marches, found, strict=True) if each]
        return dict(sorted(begun, key=lambda item: item[1][0].promised))


def _search(screen: Screen, candidate: Candidate, known: Screened) -> Screened | None:
    """A candidate fitted along the motion from all points that it is begun from beside what is known."""
    begun = screen.begin_candidate(candidate, known)
    raced = screen.resume_candidate(begun, known) if begun is not None else None
    return screen.finish_candidate(raced, known) if raced is not None else None


def _quiet(text: str) -> None:
    """Say nothing."""


def _begin_work(key: PRNGKeyArray, problem: Problem, say: Callable[[str], None]) -> _Work:
    """The bench on which candidates are simulated, and nothing done."""
    bench = problem.bench(problem.pairs)
    return _Work(key, bench, problem.group, noise_floor(bench.shots), say, _remembered(bench, bench.shots))


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


def _each(screens: Sequence[Screen], items: Sequence[T], do: Callable[[Screen, T], R]) -> list[R]:
    """`do` for every item, by as many threads as screens; which screen does what is fixed, so that runs repeat."""

    def share(i: int) -> list[R]:
        return [do(screens[i], item) for item in items[i :: len(screens)]]

    with ThreadPoolExecutor(len(screens)) as pool:
        shares = list(pool.map(share, range(len(screens))))
    return [shares[i % len(screens)][i // len(screens)] for i in range(len(items))]


def _rank(
    screens: Sequence[Screen], nothing: Screened, say: Callable[[str], None]
) -> tuple[list[Screened], list[Begun]]:
    """The best single effects, and all that could be begun; both the best first."""
    singles = [Candidate((k,)) for k in screens[0].reach(nothing) if screens[0].takes(Candidate((k,)))]
    done = count(1)

    def begin(screen: Screen, candidate: Candidate) -> Begun | None:
        begun = screen.begin_candidate(candidate, nothing)
        k = next(done)
        if k % 40 == 0:
            say(f"{k} of {len(singles)}")
        return begun

    def ranked(found: Iterable[Begun | None]) -> list[Begun]:
        finite = [begun for begun in found if begun and np.isfinite(begun.likelihood)]
        return sorted(finite, key=lambda begun: -begun.likelihood)

    begun = ranked(_each(screens, singles, begin))
    ahead = [begun[i] for i in _promising(screens[0], [each.candidate.effects[0] for each in begun])]
    raced = _each(screens, ahead, lambda screen, begun: screen.resume_candidate(begun, nothing))
    going = {each.candidate for each in ahead}
    every = ranked([*raced, *(each for each in begun if each.candidate not in going)])
    ended = _each(screens, every[:FINISHED], lambda screen, begun: screen.finish_candidate(begun, nothing))
    found = _generalize(screens, nothing, [e for e in ended if e is not None])
    return sorted(found, key=lambda e: -e.score), every


def _generalize(screens: Sequence[Screen], nothing: Screened, ended: Sequence[Screened]) -> list[Screened]:
    """The same, effects that came to less than a special case of theirs begun anew from that one's numbers."""

    def count(each: Screened) -> int:
        return screens[0].scene.count(each.candidate)

    stuck: dict[int, Screened] = {}
    for i, each in enumerate(ended):
        own = each.candidate.effects[0]
        simpler = [
            other
            for other in ended
            if _is_special_case(screens[0], other.candidate.effects[0], own)
            and other.score - each.score > max(count(each) - count(other), 0) + STUCK
        ]
        if simpler:
            stuck[i] = max(simpler, key=lambda other: other.score)

    def finish(screen: Screen, i: int) -> Screened | None:
        begun = screen.begin_from(ended[i].candidate, stuck[i], nothing)
        return begun and screen.finish_candidate(begun, nothing)

    again = dict(zip(stuck, _each(screens, list(stuck), finish), strict=True))
    return [max(filter(None, (each, again.get(i))), key=lambda e: e.score) for i, each in enumerate(ended)]


def _is_special_case(screen: Screen, effect: int, other: int) -> bool:
    """Whether an effect is a special case of another one at the same joint."""
    scene = screen.scene
    names = (f"{scene.pairs[k][0].name}@{scene.sites[k].joint}" for k in (other, effect))
    return effect != other and scene.sites[effect].joint >= 0 and contains(*names)


def _are_one_law(screen: Screen, effect: int, other: int) -> bool:
    """Whether of two laws of dry friction at one joint one has the other as a special case."""
    return any(
        screen.pairs[special][0].name in DRY and _is_special_case(screen, special, general)
        for special, general in ((effect, other), (other, effect))
    )


def _promising(screen: Screen, ranked: Sequence[int]) -> list[int]:
    """Ranks that go on: the best ones, and the best places of every effect. Some explain little at first."""
    places: dict[str, int] = {}
    found = []
    for rank, k in enumerate(ranked):
        name = screen.pairs[k][0].name
        places[name] = places.get(name, 0) + 1
        if rank < RACED or places[name] <= PLACES:
            found.append(rank)
    return found


def _finalists(screen: Screen, nothing: Screened, ranked: Sequence[Screened]) -> list[Screened]:
    """The best single effects, those that come near them, relatives of the first, and the first on other actuators."""
    best = ranked[0].score - nothing.score

    def name(found: Screened) -> str:
        return screen.name(found.candidate)

    return [
        found
        for i, found in enumerate(ranked)
        if i < LEADERS
        or (i < FINALISTS and found.score - nothing.score > WORTH * best)
        or are_kin(name(found), name(ranked[0]))
        or _is_of_another_motor(name(found), name(ranked[0]))
    ]


def _is_of_another_motor(one: str, other: str) -> bool:
    """Whether two names are of one effect on two actuators: unknown masses trade one motor's gain for another's."""
    (effect, place), (same, elsewhere) = (name.split("@", 1) for name in (one, other))
    return effect == same and place != elsewhere and place.startswith("actuator/") and elsewhere.startswith("actuator/")


def _pair(key: PRNGKeyArray, growth: _Growth, nothing: Screened, ranked: Sequence[Screened]) -> list[Screened]:
    """Pairs with every other effect, the best first: of leading single effects, of the best pair's members and kin.

    A special case may do best by itself, and with a partner that makes up for what it lacks, and hide its general case.
    """
    first = growth.screens[0]
    found: list[Screened] = []
    leaders = _with_room(
        ranked, LEADERS, lambda each: first.scene.count(each.candidate), lambda each: each.score - nothing.score
    )
    for known in leaders:
        found += growth.extend(known)
    best = max(found, key=lambda item: item.score, default=None)
    if best is None:
        return []
    led = [known.candidate for known in leaders]
    members = [Candidate((k,)) for k in best.candidate.effects]
    for member in members:
        if member not in led:
            found += growth.extend(first.part(best, member.effects))
    if first.misfit(key, best).p_value < FALSE_ALARMS:
        names = [first.name(member) for member in members]
        kin = [each for each in ranked if any(are_kin(first.name(each.candidate), name) for name in names)]
        for known in [each for each in kin if each.candidate not in [*led, *members]][:KIN]:
            found += growth.extend(known)
        found += _with_general_laws(growth.screens, sorted(found, key=_score, reverse=True))
    # of those that were begun twice the better one
    ranked = sorted({each.candidate: each for each in sorted(found, key=_score)}.values(), key=_score, reverse=True)
    turned = _each(growth.screens, ranked[:TURNED], _turn)
    return sorted([*turned, *ranked[TURNED:]], key=_score, reverse=True)


def _turn(screen: Screen, pair: Screened) -> Screened:
    """A pair with the effects of one actuator in the order that explains more: a limit before a loss or after it."""
    effects = pair.candidate.effects
    if not _follow_each_other(screen, *effects):
        return pair
    turned, same = Candidate(effects[::-1]), screen.part(pair, effects[::-1])
    found = [screen.settle(turned, same.p, same.delta, same.sigma)]
    # other numbers fit in the other order: also from those of each by itself
    for k in effects:
        part = screen.part(pair, (k,))
        known = screen.settle(part.candidate, part.p, part.delta, part.sigma)
        found.append(known and _search(screen, turned, known))
    best = max(filter(None, found), key=_score, default=pair)
    return best if best.score > pair.score + STUCK else pair


def _follow_each_other(screen: Screen, one: int, other: int) -> bool:
    """Whether two effects change the same commands one after the other."""
    acting = all(screen.pairs[k][0].port == "act" for k in (one, other))
    return acting and screen.pairs[one][1] == screen.pairs[other][1]


def _with_general_laws(screens: Sequence[Screen], ranked: Sequence[Screened]) -> list[Screened]:
    """The best pairs with an effect that has one of theirs as a special case in its place, begun from their numbers.

    As far as that explained less before: a general law beside another effect may be stuck, or have looked worse than
    others when candidates were glanced at.
    """
    first, tried = screens[0], {each.candidate: each.score for each in ranked}
    begin: dict[Candidate, tuple[Screened, int]] = {}
    for pair in ranked:
        own = set(pair.candidate.effects)
        for s, k in product(pair.candidate.effects, range(len(first.pairs))):
            if k in own or not _is_special_case(first, s, k):
                continue
            wider = Candidate(tuple(sorted(own - {s} | {k})))
            if wider not in begin and tried.get(wider, -np.inf) < pair.score and first.takes(wider):
                begin[wider] = pair, s

    def finish(screen: Screen, item: tuple[Candidate, tuple[Screened, int]]) -> Screened | None:
        wider, (pair, s) = item
        rest = screen.part(pair, tuple(k for k in pair.candidate.effects if k != s))
        begun = screen.begin_from(wider, pair, rest)
        return begun and screen.finish_candidate(begun, rest)

    return [each for each in _each(screens, list(begin.items())[:GENERAL], finish) if each is not None]


def _score(found: Screened) -> float:
    return found.score


def _varied(ranked: Sequence[Screened], least: float) -> list[Screened]:
    """The best pairs, and of those that come near the very best some with effects that are in none of these.

    What explains most along the motion is not what explains most in simulation where several do.
    """
    chosen = list(ranked[:PAIRS])
    common = {k for found in chosen for k in found.candidate.effects}
    for found in ranked[PAIRS:]:
        new = set(found.candidate.effects) - common
        alike = sum(bool(new & set(other.candidate.effects)) for other in chosen)
        near = found.score - least > NEAR * (ranked[0].score - least)
        if new and near and alike < ALIKE and len(chosen) < PAIRS + VARIED:
            chosen.append(found)
    return chosen


def _with_room(items: Sequence[T], first: int, count: Callable[[T], int], gain: Callable[[T], float]) -> list[T]:
    """The first ones, and others that come near the very first with fewer parameters: these leave room for one more."""
    leads = list(items[:first])
    for item in items[first:]:
        if count(item) < min(map(count, leads)) and gain(item) > WORTH * gain(items[0]):
            leads.append(item)
    return leads


def _still(problem: Problem, fit: Fit) -> Fit:
    """A fit to other windows as where a fit to a problem's windows begins."""
    return dataclasses.replace(fit, delta=jnp.zeros((len(problem.group), fit.delta.shape[-1])))


def _without(work: _Work, problem: Problem, detected: Entry) -> Entry:
    """The simulator without effects on a bench that holds some; its fit and test are the ones of whole windows."""
    nothing, start = Candidate(), _still(problem, detected.fit)
    x = work.bench.starts(nothing, start.z[: work.bench.d])[0]
    fit = work.bench.fit(nothing, x, start.delta, start.sigma)
    entry = _enter(work, nothing, work.settle(nothing, fit))
    entry.misfit = dataclasses.replace(entry.misfit, p_value=detected.misfit.p_value)
    entry.fit = dataclasses.replace(fit, z=x.at[: work.bench.d].set(start.z[: work.bench.d]))
    return entry


def _replace(work: _Work, entries: list[Entry], pairs: Iterable[tuple[Entry, Entry]]) -> None:
    """Entries that were fitted again in the place of what they were, and the best first."""
    for before, entry in pairs:
        if entry is not before:
            entries[entries.index(before)] = entry
            work.say(f"{entry.title}: score {entry.score:.1f}, begun elsewhere")
    entries.sort(key=lambda entry: -entry.score)


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


def _finish(
    work: _Work,
    none: Entry,
    remain: Callable[[Screened], float],
    candidates: Sequence[Screened],
    *,
    ahead: Shots | None,
    thresholds: Thresholds,
) -> list[Entry]:
    """Candidates simulated and fitted from where the screen found them, and scored across recordings, best first.

    The best of those with many parameters that leave more than `remain` says of the motion are fitted from their usual
    values, too, and from the numbers of parts of them: what fits there may be far from what fits in simulation, where
    joints stick and slip for instance. Where numbers trade for each other, candidates are fitted from far along that,
    too. Rivals of the best and parts of it are fitted from its numbers, and where one of them is then the best or ties
    with it, so are its own: none must win by a better start. Special cases and twins of what may be the answer are
    tried in their places, and siblings of the best one's effects where it is a set that leaves something. What was
    fitted before is taken as it was, and what turns out to be shortsighted is left out.
    """
    bench, before = work.bench, dict(work.done)
    work.say(f"simulating {sum(c.candidate not in before for c in candidates)} candidates; compiling takes a while")

    def enter(own: Candidate, p: Float[Array, " k"], sigma: Array) -> Entry | None:
        fit = bench.fit(own, p, jnp.zeros_like(none.fit.delta), jnp.maximum(sigma, work.floor))
        if not np.isfinite(float(fit.cost)):
            return None
        entry = _enter(work, own, work.settle(own, fit))
        entry.scores = np.logaddexp(np.log1p(-DOUBT) + entry.scores, np.log(DOUBT) + none.scores)
        return entry

    def begin(found: Screened) -> Entry | None:
        return before.get(found.candidate) or enter(found.candidate, found.p, found.sigma)

    def improve(entry: Entry, points: Sequence[Array], sigma: Array) -> Entry:
        others = (enter(entry.candidate, p, sigma) for p in points)
        return max([entry, *(other for other in others if other is not None)], key=lambda e: e.score)

    def from_elsewhere(entry: Entry) -> Entry:
        parts = (e for e in entries if set(e.candidate.effects) < set(entry.candidate.effects))
        points = [_with_numbers_of(bench, part, entry.candidate, entry.fit.z) for part in parts]
        return improve(entry, [*points, *bench.starts(entry.candidate, jnp.zeros(bench.d))], entry.fit.sigma)

    def from_traded(entry: Entry) -> Entry:
        for _ in range(TURNS):
            last, entry = entry, improve(entry, bench.traded(entry.candidate, entry.fit.z), entry.fit.sigma)
            if entry is last:
                break
        return entry

    def from_numbers_of(best: Entry, entry: Entry) -> Entry:
        return improve(entry, [_with_numbers_of(bench, best, entry.candidate, entry.fit.z)], best.fit.sigma)

    entries: list[Entry] = []
    with ThreadPoolExecutor(WORKERS) as pool:
        for entry in pool.map(begin, candidates):
            if entry is not None:
                entries.append(entry)
                if entry.candidate not in before:
                    work.say(f"{entry.title}: score {entry.score:.1f}")
        entries.sort(key=lambda entry: -entry.score)
        screened = {found.candidate: found for found in candidates}
        explained = bool(entries) and share_left(entries[0].misfit, none.misfit) <= thresholds.left

        def falls_short(entry: Entry) -> bool:
            promised = remain(screened[entry.candidate])
            hopeless = explained and promised > HOPELESS
            return not hopeless and share_left(entry.misfit, none.misfit) > promised + SHORT

        fresh = [e for e in entries if e.candidate not in before]
        left = [e for e in fresh if e.misfit.p_value < FALSE_ALARMS and len(bench.columns(e.candidate)) > SIMPLE]
        again = list(islice(filter(falls_short, left), AGAIN))
        _replace(work, entries, zip(again, pool.map(from_elsewhere, again), strict=True))
        trading = [e for e in entries if e.candidate not in before and bench.traded(e.candidate, e.fit.z)][:AGAIN]
        _replace(work, entries, zip(trading, pool.map(from_traded, trading), strict=True))
        compared: set[tuple[Entry, Entry]] = set()
        for _ in range(TURNS if entries else 0):
            entries = _recall(bench, none, entries, before, thresholds)
            best = entries[0]
            tied = contenders(entries, none, thresholds)
            if all(entry.candidate in before for entry in tied):
                break
            simpler = _replacements(bench, tied, entries)
            begun = [_with_numbers_of(bench, e, s, bench.starts(s, jnp.zeros(bench.d))[-1]) for s, e in simpler]
            found = pool.map(lambda pair, p: enter(pair[0], p, pair[1].fit.sigma), simpler, begun)
            entries = sorted([*entries, *(e for e in found if e is not None)], key=lambda e: -e.score)
            rivals = [entry for entry in entries if _are_rivals(entry, best, none, thresholds)]
            rivals += [entry for entry in entries if entry.counts < best.counts]
            rivals = [entry for entry in rivals if (best, entry) not in compared]
            compared |= {(best, entry) for entry in rivals}
            _replace(work, entries, zip(rivals, pool.map(partial(from_numbers_of, best), rivals), strict=True))
            now_tied = {entry.candidate for entry in contenders(entries, none, thresholds)}
            if entries[0] is best and now_tied <= {entry.candidate for entry in tied}:
                break
    work.done |= {entry.candidate: entry for entry in entries}
    if ahead is not None and entries:
        for entry in _look_ahead(bench, none, entries, ahead, thresholds):
            work.say(f"{entry.title}: predicts far ahead much worse than others")
            entries.remove(entry)
    return entries


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


def _folds(group: Int[np.ndarray, " windows"]) -> Bool[Array, "folds windows"]:
    """The windows of every group of recordings; of one recording alone, groups of its windows."""
    units = group if len(set(group.tolist())) > 1 else np.arange(len(group))
    labels = sorted(set(units.tolist()))
    return jax.device_put(np.array([np.isin(units, labels[i::FOLDS]) for i in range(min(FOLDS, len(labels)))]))


def _enter(work: _Work, candidate: Candidate, fit: Fit, known: Float[np.ndarray, "..."] | float = 0.0) -> Entry:
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
