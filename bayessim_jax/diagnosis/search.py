"""The search along the recorded motion: which effects, and which sets of them, are worth simulating."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import count, product
from typing import TypeVar

import numpy as np
from jaxtyping import PRNGKeyArray

from bayessim_jax.diagnosis.bench import Candidate
from bayessim_jax.diagnosis.screen import Begun, March, Screen, Screened
from bayessim_jax.diagnosis.verdict import are_kin, contains
from bayessim_jax.diagnosis.whiteness import FALSE_ALARMS

__all__ = ["PAIRS", "Growth", "finalists", "find_pairs", "rank", "varied", "with_room"]

T, R = TypeVar("T"), TypeVar("R")

FINALISTS, LEADERS, PAIRS = 7, 2, 4
"""Single effects that are simulated at most, at least, and pairs."""
WORTH = 0.5
"""Share of the best effect's gain from which another is simulated."""
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
TURNED = 4
"""Pairs of which the order is looked at, where it matters."""
GENERAL = 8
"""Pairs that are begun from the numbers of a special case of them."""
DRY = ("coulomb_friction", "stribeck_friction")
"""Laws of dry friction that are special cases of others."""
KIN = 2
"""Relatives of the best pair's members, of which partners are looked for as well."""


def rank(
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


def finalists(screen: Screen, nothing: Screened, ranked: Sequence[Screened]) -> list[Screened]:
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


class Growth:
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


def find_pairs(key: PRNGKeyArray, growth: Growth, nothing: Screened, ranked: Sequence[Screened]) -> list[Screened]:
    """Pairs with every other effect, the best first: of leading single effects, of the best pair's members and kin.

    A special case may do best by itself, and with a partner that makes up for what it lacks, and hide its general case.
    """
    first = growth.screens[0]
    found: list[Screened] = []
    leaders = with_room(
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


def varied(ranked: Sequence[Screened], least: float) -> list[Screened]:
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


def with_room(items: Sequence[T], first: int, count: Callable[[T], int], gain: Callable[[T], float]) -> list[T]:
    """The first ones, and others that come near the very first with fewer parameters: these leave room for one more."""
    leads = list(items[:first])
    for item in items[first:]:
        if count(item) < min(map(count, leads)) and gain(item) > WORTH * gain(items[0]):
            leads.append(item)
    return leads


def _search(screen: Screen, candidate: Candidate, known: Screened) -> Screened | None:
    """A candidate fitted along the motion from all points that it is begun from beside what is known."""
    begun = screen.begin_candidate(candidate, known)
    raced = screen.resume_candidate(begun, known) if begun is not None else None
    return screen.finish_candidate(raced, known) if raced is not None else None


def _each(screens: Sequence[Screen], items: Sequence[T], do: Callable[[Screen, T], R]) -> list[R]:
    """`do` for every item, by as many threads as screens; which screen does what is fixed, so that runs repeat."""

    def share(i: int) -> list[R]:
        return [do(screens[i], item) for item in items[i :: len(screens)]]

    with ThreadPoolExecutor(len(screens)) as pool:
        shares = list(pool.map(share, range(len(screens))))
    return [shares[i % len(screens)][i // len(screens)] for i in range(len(items))]


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


def _is_of_another_motor(one: str, other: str) -> bool:
    """Whether two names are of one effect on two actuators: unknown masses trade one motor's gain for another's."""
    (effect, place), (same, elsewhere) = (name.split("@", 1) for name in (one, other))
    return effect == same and place != elsewhere and place.startswith("actuator/") and elsewhere.startswith("actuator/")


def _follow_each_other(screen: Screen, one: int, other: int) -> bool:
    """Whether two effects change the same commands one after the other."""
    acting = all(screen.pairs[k][0].port == "act" for k in (one, other))
    return acting and screen.pairs[one][1] == screen.pairs[other][1]


def _score(found: Screened) -> float:
    return found.score
