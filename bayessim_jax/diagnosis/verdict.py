"""From candidates and their scores to one of four verdicts, the sets that tie, and how probable each is."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import permutations

import numpy as np
from jaxtyping import Bool, Float, Int

from bayessim_jax.diagnosis.bench import Bench, Candidate
from bayessim_jax.diagnosis.whiteness import FALSE_ALARMS, Misfit
from bayessim_jax.inference.scores import Errors, nrmse
from bayessim_jax.inference.shooting import Fit, Shots

__all__ = [
    "CONTAINS",
    "Diagnosis",
    "Entry",
    "Thresholds",
    "are_kin",
    "are_siblings",
    "can_stand_for",
    "contains",
    "contenders",
    "decide",
    "error_left",
    "error_of_sum",
    "explains",
    "falls_short",
    "find_shortsighted",
    "has_special_case",
    "is_outdone",
    "is_refuted",
    "is_worse",
    "is_worth",
    "leaves_much",
    "may_be_astray",
    "may_be_named",
    "most_left",
    "predicts_more",
    "share_left",
    "ties",
]

CONTAINS = {
    "stribeck_friction": ("coulomb_friction",),
    "asymmetric_friction": ("coulomb_friction",),
    "load_dependent_friction": ("coulomb_friction",),
    "lugre_friction": ("coulomb_friction", "stribeck_friction"),
    "hysteresis": ("coulomb_friction", "joint_spring"),
    "back_emf": ("actuator_gain",),
    "gain_drop": ("actuator_gain",),
    "gain_drift": ("actuator_gain",),
    "joint_flexibility": ("armature",),
    "backlash": ("armature",),
}
"""Effects that have others as special cases: where both do as well, the simpler one is the finding."""
TWINS = {
    "viscous_friction": ("back_emf",),
    "back_emf": ("viscous_friction",),
    "lugre_friction": ("hysteresis",),
    "hysteresis": ("lugre_friction",),
    "sensor_offset": ("link_offset", "base_tilt"),
    "link_offset": ("sensor_offset", "base_tilt", "payload"),
    "payload": ("link_offset",),
    "base_tilt": ("sensor_offset", "link_offset"),
}
"""Effects that look the same at one joint: brakes, what bends before it yields, what turns the zero of an angle, and
what moves a centre of mass where the mass is unknown.

Where one is found, the others are tried.
"""
SAME = 0.001
"""Share of what one of two twins leaves, by which the other may leave another share of the misfit and say the same."""
MIMICRY = 0.05
"""Chance that what looks like an effect is something else that is in no library."""
VISIBLE = 0.5
"""Error of predictions over what cannot be predicted, from which a share of it says something."""
CHAOTIC = 0.5
"""Share of a channel's error beyond noise that noise in the initial states may make for it to say something."""
LARGE = 1e6
"""Most that an error of predictions ahead counts, over the noise, squared; what is not finite counts as much."""
SEVERAL = 4
"""Windows left out, from which one of them alone takes no answer away."""
BOOTSTRAPS, FEW = 1000, 6
"""Draws of the bootstrap; recordings, below which windows are drawn instead."""


@dataclass(frozen=True)
class Thresholds:
    """What decides."""

    negligible: float = 0.02
    """Power of a misfit over that of the noise, below which it is none."""
    left: float = 0.03
    """Share of the baseline's misfit that an explanation may leave."""
    ahead: float = 0.3
    """Share of the baseline's error of predictions ahead that an explanation of the misfit may leave."""
    both: float = 0.001
    """The one share times the other: what leaves something of both has found something else."""
    several: float = 0.0001
    """The same for more effects than one, which come near to more that is none of them."""
    most: float = 0.1
    """The same product, above which an effect explains nothing, though no misfit of pieces can be detected."""
    bulk: float = 0.5
    """Share of the misfit alone, above which it does not where predictions ahead cannot tell, either."""
    foreseen: float = 0.003
    """Share of the baseline's error of predictions ahead, below which what pieces leave is the sensors' own."""
    chief: float = 0.03
    """The same for one effect by which all but a rest is foreseen, that no set of candidates explains."""
    slight: float = 0.01
    """Error on recordings left out, as `nrmse`, up to which there is no more than a rest beside that effect."""
    enough: float = 0.015
    """Share that effects may leave before larger sets are tried."""
    rest: float = 0.002
    """The same for one effect, where what it leaves shows."""
    rest_ahead: float = 0.02
    """Share of the error of predictions ahead, above which pairs are tried, too, where what is left shows."""
    apart: float = 0.05
    """The same for the share that is left of one channel's misfit: another joint's, which is hardly moved."""
    doubtful: float = 0.1
    """Share of the error of predictions ahead, above which they are tried, too."""
    lacking: float = 0.05
    """Share of it, above which two effects or more are tried with another one."""
    farther: float = 0.1
    """Times the error of predictions ahead of a candidate that another one has, which makes it shortsighted."""
    worth: float = 0.4
    """Share of what fewer effects leave, below which more effects are worth it."""
    worth_ahead: float = 0.9
    """The same of the error of predictions ahead, where fewer effects leave more than `rest_ahead` of it."""
    trace: float = 1e-5
    """Share of a misfit, below which what effects leave is the form of their laws, and no other effect."""
    tie: float = 2.0
    """Standard errors within which two candidates predict held-out windows alike."""
    blur: float = 0.005
    """Share of what the best candidate gains by which others may be worse and tie, where it is not wholly right, and by
    which a special case may be worse and be the finding."""
    form: float = 0.001
    """Share of the misfit that a special case may leave and be the finding: the form of laws is no better known."""
    clearer: float = 0.1
    """Times the share that the best candidate leaves, where that is more than the form of a law: what leaves no more
    and scores worse ties with it."""
    least: float = 4.0
    """Nats in all by which a candidate has to be worse to be out of the confusion set."""
    ceiling: float = 0.9
    """Share of what a force without a name gains on recordings left out that an answer has to gain there."""
    held: float = 0.03
    """Share of the baseline's squared error beyond noise that an answer may leave on recordings left out."""
    visible: float = 4.0
    """Times what noise allows, from which what is left there counts."""
    coincidence: float = 5.0
    """Nats by which its numbers may be a greater coincidence than another's that does as well."""


@dataclass(eq=False)
class Entry:
    """A candidate, fitted to all windows that choose, and scored on windows that its fit did not see."""

    candidate: Candidate
    told: list[int]
    """Its effects without what is only the time step of the simulator: those that are named."""
    names: list[str]
    """Of these."""
    fit: Fit
    scores: Float[np.ndarray, " windows"]
    """Log predictive density of every window, its initial state profiled out."""
    misfit: Misfit
    ahead: float = float("nan")
    """Share of the baseline's error that predictions as long as the horizon still have beyond the noise.

    Known of candidates that may be named.
    """
    unexcused: float = float("nan")
    """The same of the whole error, nothing excused."""
    guesses: bool = False
    """Whether fits find, window by window, what one of its effects remembers unseen."""
    log_share: float = 0.0
    """Log of the share of its prior that the candidate's numbers are found in: the evidence over the best likelihood.

    Source: MacKay 1992
    """
    seats: Mapping[str, str] = field(default_factory=dict)
    """Names of effects, and the same at the joint that their actuator drives or whose zero they turn."""

    @property
    def counts(self) -> Counter[str]:
        """How often each name is among its effects: two stops of one joint bear one name."""
        return Counter(self.names)

    @property
    def title(self) -> str:
        """Its names in one line, for people."""
        return " + ".join(self.names) or "the time step alone"

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
    probabilities: list[float] = field(default_factory=list)
    """Of every set in the confusion set."""
    screened: list[tuple[str, float]] = field(default_factory=list)
    """Every candidate and how much it gained on the windows it was fitted to."""
    beside_a_rest: bool = False
    """What is named leaves a rest in short pieces, which no candidate explains."""
    taken_back: Entry | None = None
    """An answer that was taken back, since it predicts recordings left out too badly."""
    sooner: float | None = None
    """p-value of no mismatch with every command a row earlier, where that leaves next to nothing of the misfit."""

    @property
    def names_something(self) -> bool:
        """Whether the verdict gives one answer or several."""
        return self.verdict in ("explained", "ambiguous")

    def take_back(self) -> None:
        """Leave the misfit unexplained by what had been found."""
        self.verdict, self.taken_back, self.confusion, self.probabilities = "unexplained", self.best, [], []

    @property
    def best(self) -> Entry:
        """What the verdict names, or had named, or the best there was."""
        best = self.confusion[0] if self.confusion else self.taken_back
        return best or (self.entries[0] if self.entries else self.baseline)

    @property
    def answer(self) -> Entry:
        """What is simulated from now on: what the verdict names, and where it names nothing the simulator as it is."""
        return self.best if self.names_something else self.baseline


def share_left(after: Misfit, before: Misfit) -> float:
    """Share of a misfit that a candidate leaves in the windows judged, both in units of the smaller noise."""
    own, was = (power.sum() for power in _powers(after, before))
    return float(max(own, 0.0) / max(was, 1e-12))


def most_left(after: Misfit, before: Misfit, measured: Bool[np.ndarray, "windows rows obs"]) -> float:
    """The same of the channel of which it leaves most, among those with as much misfit as noise before."""
    own, was = _powers(after, before)
    there = was > np.maximum(measured[after.judged & before.judged].sum((0, 1)), 1)
    return float((np.maximum(own, 0.0)[there] / was[there]).max()) if there.any() else 0.0


def _powers(after: Misfit, before: Misfit) -> tuple[Float[np.ndarray, " obs"], Float[np.ndarray, " obs"]]:
    """Of two misfits in every channel, over the windows judged in both, in units of the smaller noise."""
    noise, judged = np.minimum(after.noise, before.noise), after.judged & before.judged
    own, was = ((m.excess * (m.noise / noise) ** 2)[judged].sum(0) for m in (after, before))
    return own, was


def error_left(
    shots: Shots,
    predicted: Float[np.ndarray, "windows rows obs"],
    base: Float[np.ndarray, "windows rows obs"],
    noise: Float[np.ndarray, " obs"],
    spread: Float[np.ndarray, "windows rows obs"] | float = 0.0,
    whole: bool = False,
) -> float:
    """Share of the error of one prediction of windows that another one still has, beyond what cannot be predicted.

    That is the sensors' noise and, by their noise in the initial states, `spread`, a variance. A channel in which that
    spread makes up for most of what the second prediction errs beyond noise tells nothing. A window in which the first
    errs more than the second, because motion there is chaotic, counts as not improved. NaN where the second errs hardly
    more than cannot be predicted. An error of more than a thousand times the noise counts as that, unless `whole`.
    """
    measured, y, large = np.asarray(shots.measured), np.asarray(shots.y), LARGE

    def total(squares: np.ndarray, there: np.ndarray, axes: tuple[int, int]) -> np.ndarray:
        finite = np.nan_to_num(squares, nan=large, posinf=large)
        return np.where(there, np.minimum(finite, large), 0.0).sum(axes)

    by_chance = np.broadcast_to(spread / noise**2, y.shape)
    missed, was_missed = (((y - p) / noise) ** 2 for p in (predicted, base))
    if whole:
        large = max(large, np.nanmax(np.where(measured & np.isfinite(was_missed), was_missed, 0.0)))
    chance, wrong = (total(squares, measured, (0, 1)) for squares in (by_chance, was_missed - 1.0))
    told = measured & (chance <= CHAOTIC * wrong)
    own, was, noisy = (total(squares, told, (1, 2)) for squares in (missed, was_missed, 1.0 + by_chance))
    least = np.minimum(noisy, was)
    gap = (was - least).sum()
    if not gap > VISIBLE * least.sum():
        return float("nan")
    # an error below what chaos excuses in one window says nothing of another one; noise alone is as often below
    luck = 3.0 * np.sqrt(2.0 * told.sum((1, 2)))
    return float(max(np.maximum(np.minimum(own, was) - least, -luck).sum(), 0.0) / gap)


def are_kin(one: str, other: str) -> bool:
    """Whether of two names at one place, `stribeck_friction@joint/hinge`, one has the other as a special case."""
    return contains(one, other) or contains(other, one)


def decide(
    bench: Bench,
    none: Entry,
    entries: list[Entry],
    group: Int[np.ndarray, " windows"],
    thresholds: Thresholds,
    screened: list[tuple[str, float]],
) -> Diagnosis:
    """One of four verdicts on a simulator whose misfit was detected; `entries` come best first.

    The confusion set is what explains the misfit and predicts held-out windows as well as the best candidate; of these
    the ones with the fewest effects, of effects that contain one another the special case, and none that does so only
    with numbers that are a coincidence where others need none: a ripple with one cycle per turn is a tilt. What scores
    better by more than that is none. Where what the simulator's time step does explains the misfit alone, nothing is
    missing.
    """
    result = Diagnosis("unexplained", bench, none, entries, screened=screened)
    if not entries or entries[0].score - none.score < thresholds.least:
        return result
    tied = contenders(entries, none, thresholds)
    tied = [entry for entry in tied if explains(entry, none, thresholds) and is_worth(entry, entries, none, thresholds)]
    if not tied:
        tied = _find_chief(entries, none, thresholds)
        result.beside_a_rest = bool(tied)
    if not tied:
        return result
    if any(not entry.names for entry in tied):
        result.verdict = "no_mismatch"
        return result
    best = {tuple(entry.names): entry for entry in sorted(tied, key=lambda entry: entry.score)}
    fewest = min(map(len, best))
    least = [entry for names, entry in best.items() if len(names) == fewest]
    shown_less = [entry for entry in least if any(_shows_more(other, entry, none, thresholds) for other in least)]
    least = [entry for entry in least if entry not in shown_less]
    sets = [entry for entry in least if not any(has_special_case(entry, other) for other in least)]
    temper = thresholds.least / _resolution(entries[0], none, thresholds)

    def is_coincidence(entry: Entry, other: Entry) -> bool:
        better = max(temper * (entry.score - other.score), 0.0)
        return other.log_share - entry.log_share > thresholds.coincidence + better

    coincidences = [entry for entry in sets if any(is_coincidence(entry, other) for other in sets)]
    sets = [entry for entry in sets if entry not in coincidences]
    result.confusion = sorted(sets, key=lambda e: (len(bench.columns(e.candidate)), -e.score))
    result.probabilities = _weigh(result, [*shown_less, *coincidences], group, temper, thresholds)
    result.verdict = "explained" if len(sets) == 1 else "ambiguous"
    return result


def may_be_named(entry: Entry, entries: Sequence[Entry], none: Entry, thresholds: Thresholds) -> bool:
    """Whether a candidate ties for the best of `entries`, which comes first, or is a part of one that does."""
    return any(entry.counts <= other.counts for other in _tied(entries, none, thresholds))


def contenders(entries: Sequence[Entry], none: Entry, thresholds: Thresholds) -> list[Entry]:
    """What ties for the best, which comes first, and smaller sets that explain as much as it does."""
    tied = _tied(entries, none, thresholds)
    # what more effects explain has to be worth them: another law of the same effect leaves a rest, too
    return tied + [entry for entry in entries if entry not in tied and _suffices(entry, tied, none, thresholds)]


def _tied(entries: Sequence[Entry], none: Entry, thresholds: Thresholds) -> list[Entry]:
    """What predicts as well as the best, which comes first, or leaves far less of the misfit.

    And special cases of these that leave next to nothing, or hardly more than these where these leave something.

    What these leave says less of physics than of how a sign is rounded, in the library and in a machine. Where sensors
    are coarse nothing is left of any of them; then they also have to predict held-out windows nearly as well.
    """
    best = entries[0]
    tied = [entry for entry in entries if ties(entry, best, none, thresholds)]
    tied += [e for e in entries if e not in tied and _is_clearer(e, best, none, thresholds)]
    near = best.score - thresholds.blur * (best.score - none.score)
    simpler = (e for e in entries if e.score >= near and share_left(e.misfit, none.misfit) <= thresholds.form)
    tied += [e for e in simpler if e not in tied and any(has_special_case(other, e) for other in tied)]
    tied += [e for e in entries if e not in tied and any(_does_as_well(e, o, none, thresholds) for o in tied)]
    return tied + [e for e in entries if e not in tied and any(_is_same(e, other, none, thresholds) for other in tied)]


def _is_clearer(entry: Entry, best: Entry, none: Entry, thresholds: Thresholds) -> bool:
    """Whether a candidate leaves far less of the misfit than the best one, which leaves something, with as few effects.

    A score forgives windows in which a candidate fails altogether; where a rival does not fail, they tell against it.
    """
    left, its = share_left(best.misfit, none.misfit), share_left(entry.misfit, none.misfit)
    return len(entry.names) <= len(best.names) and left > thresholds.form and its <= thresholds.clearer * left


def _shows_more(entry: Entry, rival: Entry, none: Entry, thresholds: Thresholds) -> bool:
    """Whether a candidate explains far more than one that ties with it, in pieces and ahead: it is no rival then.

    Where recordings are many, what tells the two apart may be little of what both gain.
    """
    return _is_clearer(entry, rival, none, thresholds) and entry.ahead <= thresholds.worth * rival.ahead


def _does_as_well(entry: Entry, other: Entry, none: Entry, thresholds: Thresholds) -> bool:
    """Whether a special case explains the misfit, and a law that has it leaves something and hardly less: not its own.

    What both leave is in neither of them, and says which bends to it. A constraint that brakes a joint within
    milliseconds, as MuJoCo's `frictionloss` does, is dry friction, and no bristle holds it.
    """
    left, its = share_left(other.misfit, none.misfit), share_left(entry.misfit, none.misfit)
    hardly_less = left > thresholds.form and left > thresholds.worth * its
    return hardly_less and has_special_case(other, entry) and explains(entry, none, thresholds)


def _is_same(entry: Entry, other: Entry, none: Entry, thresholds: Thresholds) -> bool:
    """Whether a set has a twin in another one's place and leaves the same: what tells them apart is no misfit.

    Nor is it where both leave next to nothing, but something, beside other effects: one of the twins has a number more,
    which bends to the form of these.
    """
    mine, its = _apart(entry, other)
    left, same = (share_left(e.misfit, none.misfit) for e in (entry, other))
    shows = len(entry.names) > 1 and all(e.misfit.p_value < FALSE_ALARMS for e in (entry, other))
    alike = abs(left - same) <= SAME * same or (shows and max(left, same) <= thresholds.form)
    return len(mine) == len(its) == 1 and _are_twins(*mine, *its) and alike


def explains(entry: Entry, none: Entry, thresholds: Thresholds) -> bool:
    """In the residuals of pieces of windows, or, where the sensors' own errors are what is left there, ahead.

    What explains pieces and predicts hardly better than without it has found a small thing beside a larger one. What is
    not judged where its past is unknown is excused there already, and has to explain the pieces that are judged.
    """
    foreseen = entry.ahead <= thresholds.foreseen and bool(entry.misfit.judged.all())
    left, both = share_left(entry.misfit, none.misfit), thresholds.both if len(entry.names) < 2 else thresholds.several
    vague = left > thresholds.bulk if np.isnan(entry.ahead) else left * entry.ahead > thresholds.most
    if foreseen or (entry.misfit.p_value >= FALSE_ALARMS and not vague):
        return True
    return left <= thresholds.left and not (entry.ahead > thresholds.ahead or left * entry.ahead > both)


def _find_chief(entries: Sequence[Entry], none: Entry, thresholds: Thresholds) -> list[Entry]:
    """The best effect by itself, and what ties with it, where predictions ahead leave next to nothing to explain.

    Precise sensors show in short pieces what a machine has besides, and what they do themselves: that rest must not be
    what any other candidate explains. Effects with a memory are excused where their past is unknown, and are left out.
    """
    alone = [entry for entry in entries if len(entry.names) == 1]
    if not alone:
        return []
    rest = thresholds.worth * share_left(alone[0].misfit, none.misfit)
    if any(share_left(entry.misfit, none.misfit) <= rest for entry in entries):
        return []
    tied = [entry for entry in alone if ties(entry, alone[0], none, thresholds)]
    return tied if all(e.ahead <= thresholds.chief and e.misfit.judged.all() for e in tied) else []


def is_refuted(
    judging: Mapping[str, Errors],
    floor: float,
    scale: Float[np.ndarray, " obs"],
    thresholds: Thresholds,
    beside_a_rest: bool,
) -> bool:
    """Whether recordings left out contradict an answer.

    Where it is one `beside_a_rest`, that has to be slight, and a force without a name must not find it to be forces.
    """
    baseline, answer, flexible = judging["baseline"], judging["augmented"], judging.get("flexible")
    if falls_short(baseline, answer, scale, floor, thresholds) or is_worse(baseline, answer, scale):
        return True
    if beside_a_rest and nrmse(answer, scale) > thresholds.slight:
        return True
    if flexible is None:
        return False
    if beside_a_rest and predicts_more(flexible, answer, scale):
        return True
    return is_outdone(baseline, answer, flexible, scale, thresholds)


def is_outdone(
    baseline: Errors, answer: Errors, flexible: Errors, scale: Float[np.ndarray, " obs"], thresholds: Thresholds
) -> bool:
    """Whether a force without a name gains much more than an answer in predictions of recordings left out.

    Beyond what chance makes of it: by two standard errors of the windows' mean squares, in units of `scale`.
    """
    squares = _squares((baseline, answer, flexible), scale)
    if squares.shape[1] < 2:
        return False
    was, now, best = np.sqrt(squares.mean(1))
    more = squares[1] - squares[2]
    return bool(more.sum() > 2.0 * error_of_sum(more) and was - now < thresholds.ceiling * (was - best))


def predicts_more(one: Errors, other: Errors, scale: Float[np.ndarray, " obs"]) -> bool:
    """Whether one errs less than another in most windows, by two standard errors of the log ratio of mean squares."""
    squares = _squares((one, other), scale)
    more = np.log(squares[1] / squares[0])
    return len(more) >= 2 and bool(more.sum() > 2.0 * error_of_sum(more))


def is_worse(baseline: Errors, answer: Errors, scale: Float[np.ndarray, " obs"]) -> bool:
    """Whether an answer errs more on recordings left out than the simulator without it, in all and in most windows."""
    was, now = _squares((baseline, answer), scale).sum(1)
    return bool(now > was) and predicts_more(baseline, answer, scale)


def _squares(every: Sequence[Errors], scale: Float[np.ndarray, " obs"]) -> Float[np.ndarray, "simulator windows"]:
    """Mean squares of windows that all of some simulators predict, in units of `scale`."""
    there = np.all([errors.measured.any((1, 2)) for errors in every], axis=0)
    return np.array([((e.error[there] / scale) ** 2).sum((1, 2)) / e.measured[there].sum((1, 2)) for e in every])


def leaves_much(baseline: float, answer: float, floor: float, thresholds: Thresholds) -> bool:
    """Whether an answer leaves much of an error; errors as `nrmse`, `floor` what noise alone leaves."""
    left = max(answer**2 - floor**2, 0.0) / max(baseline**2 - floor**2, 1e-12)
    return answer > thresholds.visible * floor and left > thresholds.held


def falls_short(
    baseline: Errors, answer: Errors, scale: Float[np.ndarray, " obs"], floor: float, thresholds: Thresholds
) -> bool:
    """Whether an answer leaves much of the error on recordings left out.

    In more windows than one, where there are some: where motion passes by a saddle, the best simulator may go astray.
    """

    def does(windows: Bool[np.ndarray, " windows"]) -> bool:
        was, now = (nrmse(Errors(e.error[windows], e.measured[windows]), scale) for e in (baseline, answer))
        return leaves_much(was, now, floor, thresholds)

    size = ((answer.error / scale) ** 2).sum((1, 2))
    every = np.ones(len(size), bool)
    return does(every) and (len(size) < SEVERAL or does(np.arange(len(size)) != np.argmax(size)))


def find_shortsighted(entries: Sequence[Entry], none: Entry, thresholds: Thresholds) -> list[Entry]:
    """Candidates that predict far ahead much worse than another one with as few effects that explains pieces, too.

    What bends to what short pieces show, whatever makes it, is found out by what it says of the time after. Nor is what
    an effect remembers unseen, found window by window, an excuse where another one needs none.
    """
    sound = [entry for entry in entries if share_left(entry.misfit, none.misfit) <= thresholds.left]

    def is_outseen(entry: Entry) -> bool:
        rivals = [o for o in sound if len(o.names) <= len(entry.names)]
        if entry.ahead > thresholds.lacking and any(o.ahead <= thresholds.farther * entry.ahead for o in rivals):
            return True
        known = [o for o in rivals if not o.guesses]
        return may_be_astray(entry, thresholds) and any(
            o.unexcused <= thresholds.farther * entry.unexcused for o in known
        )

    return [entry for entry in entries if is_outseen(entry)]


def may_be_astray(entry: Entry, thresholds: Thresholds) -> bool:
    """Whether what a candidate guesses of every window leaves much of the time ahead."""
    return entry.guesses and entry.unexcused > thresholds.rest_ahead


def _suffices(entry: Entry, tied: Sequence[Entry], none: Entry, thresholds: Thresholds) -> bool:
    """Whether a candidate explains the misfit, and those that tie for the best add effects to it without much gain."""
    return explains(entry, none, thresholds) and all(
        entry.counts < other.counts and not _leaves_less(other, entry, none, thresholds) for other in tied
    )


def is_worth(entry: Entry, entries: Sequence[Entry], none: Entry, thresholds: Thresholds) -> bool:
    """Whether what a set adds to a part of it leaves much less, and predicts windows better that fits have not seen.

    A little less is what any further effect leaves.
    """
    parts = [other for other in entries if other.counts < entry.counts]
    return all(_leaves_less(entry, part, none, thresholds) and entry.score >= part.score for part in parts)


def _leaves_less(entry: Entry, part: Entry, none: Entry, thresholds: Thresholds) -> bool:
    """Of the misfit of pieces, or, where the part leaves much of the error ahead, of both; and less of that error.

    What is found in short pieces alone bends to how they begin, and beside a trace of a misfit to the form of a law.
    """
    if _leaves_a_trace(part, none, thresholds):
        return False
    if part.ahead > thresholds.rest_ahead and entry.ahead > thresholds.worth_ahead * part.ahead:
        return False
    mine, its = share_left(entry.misfit, none.misfit), share_left(part.misfit, none.misfit)
    both = part.ahead > thresholds.doubtful and mine * entry.ahead <= thresholds.worth * its * part.ahead
    return mine <= thresholds.worth * its or both


def _leaves_a_trace(entry: Entry, none: Entry, thresholds: Thresholds) -> bool:
    """Whether next to nothing is left of the misfit, and no doubt of the time ahead."""
    return share_left(entry.misfit, none.misfit) <= thresholds.trace and not entry.ahead > thresholds.doubtful


def ties(entry: Entry, best: Entry, none: Entry, thresholds: Thresholds) -> bool:
    """Whether a candidate predicts held-out windows as well as the best one, within the error of the difference.

    Where the best one leaves something, too, small differences say who mimics what is left rather than who is right.
    """
    difference = best.scores - entry.scores
    return float(difference.sum()) <= max(
        thresholds.tie * error_of_sum(difference), _resolution(best, none, thresholds)
    )


def error_of_sum(values: Float[np.ndarray, " windows"]) -> float:
    """Standard error of a sum over windows; 0 where there is one."""
    return float(values.std(ddof=1) * np.sqrt(len(values))) if len(values) > 1 else 0.0


def _resolution(best: Entry, none: Entry, thresholds: Thresholds) -> float:
    """Nats below which a difference of scores says nothing."""
    blur = thresholds.blur * (best.score - none.score) if best.misfit.p_value < FALSE_ALARMS else 0.0
    return max(thresholds.least, blur)


def contains(one: str, other: str) -> bool:
    """Whether the first effect has the second, at the same place, as a special case."""
    (effect, _, place), (simpler, _, where) = one.partition("@"), other.partition("@")
    return place == where and simpler in CONTAINS.get(effect, ())


def can_stand_for(one: str, other: str) -> bool:
    """Whether the first effect, at the same place, is a special case of the other or a twin of it."""
    return contains(other, one) or _are_twins(one, other)


def _are_twins(one: str, other: str) -> bool:
    """Whether two effects look the same at one place."""
    (effect, _, place), (found, _, where) = one.partition("@"), other.partition("@")
    return place == where and effect in TWINS.get(found, ())


def are_siblings(one: str, other: str) -> bool:
    """Whether two effects at the same place have a special case in common."""
    (effect, _, place), (another, _, where) = one.partition("@"), other.partition("@")
    common = set(CONTAINS.get(effect, ())) & set(CONTAINS.get(another, ()))
    return one != other and place == where and bool(common)


def has_special_case(entry: Entry, other: Entry) -> bool:
    """Whether another candidate is this one with effects replaced by special cases of them, each at its place."""
    return len(entry.names) == len(other.names) and entry.counts != other.counts and _is_left(other, entry)


def _is_left(part: Entry, whole: Entry) -> bool:
    """Whether a set is what is left of another one without some effects and with special cases of some."""
    less, more = _apart(part, whole)
    return any(all(map(contains, chosen, less)) for chosen in permutations(more, len(less)))


def _apart(one: Entry, other: Entry) -> tuple[list[str], list[str]]:
    """What each of two sets has that the other has not, at joints."""
    mine, its = (sorted((a.counts - b.counts).elements()) for a, b in ((one, other), (other, one)))
    return [one.seats.get(name, name) for name in mine], [other.seats.get(name, name) for name in its]


def _weigh(
    result: Diagnosis,
    outdone: Sequence[Entry],
    group: Int[np.ndarray, " windows"],
    temper: float,
    thresholds: Thresholds,
) -> list[float]:
    """How probable every set of the confusion set is.

    Weights of all candidates but the `outdone` by their held-out scores, tempered to what these can resolve, under the
    Bayesian bootstrap of the recordings, or of windows where these are few; what a set left out as needlessly complex
    has goes to the sets that stand for it, and twins that leave the same have as much as each other. Of that, the share
    of the misfit that a set explains, and the chance that nothing outside the library looks like it.

    Source: Yao et al. 2018, section 3.4 (pseudo-BMA+)
    """
    units = group if len(set(group.tolist())) >= FEW else np.arange(len(group))
    labels = sorted(set(units.tolist()))
    rivals = [entry for entry in result.entries if entry not in outdone]
    sums = np.array([[entry.scores[units == label].sum() for label in labels] for entry in rivals])
    draws = np.random.default_rng(0).dirichlet(np.ones(len(labels)), BOOTSTRAPS) * len(labels)
    z = temper * (draws @ sums.T)
    weights = np.exp(z - z.max(1, keepdims=True))
    weights = (weights / weights.sum(1, keepdims=True)).mean(0)
    own = np.array([weights[rivals.index(entry)] for entry in result.confusion])
    for entry, weight in zip(rivals, weights, strict=True):
        if entry not in result.confusion:
            stands = np.array([_is_left(chosen, entry) for chosen in result.confusion], float)
            own = own + (weight * stands / stands.sum() if stands.any() else 0.0)
    # what tells twins apart that leave the same is no misfit, and says nothing of which it is
    none, sets = result.baseline, result.confusion
    alike = [[one is other or _is_same(one, other, none, thresholds) for other in sets] for one in sets]
    same = np.array(alike, float)
    own = same @ own / same.sum(1)
    explained = [1.0 - share_left(entry.misfit, none.misfit) for entry in sets]
    return [float((1.0 - MIMICRY) * w * part) for w, part in zip(own, explained, strict=True)]
