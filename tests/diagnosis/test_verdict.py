import dataclasses

import numpy as np
import pytest

from bayessim_jax.diagnosis.bench import Candidate
from bayessim_jax.diagnosis.finals import _recall
from bayessim_jax.diagnosis.procedure import _is_too_narrow
from bayessim_jax.diagnosis.verdict import (
    Entry,
    Thresholds,
    are_kin,
    decide,
    error_left,
    falls_short,
    find_shortsighted,
    is_outdone,
    is_refuted,
    is_worse,
    may_be_named,
    predicts_more,
)
from bayessim_jax.diagnosis.whiteness import Misfit
from bayessim_jax.inference.scores import Errors
from bayessim_jax.inference.shooting import Shots

WINDOWS = 30


class OneParameterEach:
    def columns(self, candidate):
        return list(candidate.effects)


def entry(names, mean, left, p=0.001, spread=1.0, seed=0):
    scores = mean + spread * np.random.default_rng(seed).normal(size=WINDOWS)
    misfit = Misfit(p, np.full((WINDOWS, 1), left), np.ones(1), np.ones(WINDOWS, bool))
    return Entry(Candidate(tuple(range(len(names)))), list(range(len(names))), names, None, scores, misfit)


class Laws(OneParameterEach):
    """Three effects of one joint, each with one parameter."""

    pairs = ("load_dependent_friction", "coulomb_friction", "armature")
    slots = 10

    def name(self, k):
        return f"{self.pairs[k]}@joint/a"

    def seats(self, candidate):
        return {}

    def entry(self, *effects, mean, left):
        found = entry([self.name(k) for k in effects], mean, left)
        found.candidate = Candidate(effects)
        return found


def verdict(*entries, none=None):
    none = none or entry([], 0.0, 1.0)
    ranked = sorted(entries, key=lambda e: -e.score)
    return decide(OneParameterEach(), none, ranked, np.arange(WINDOWS), Thresholds(), [])


def test_one_candidate_that_explains_is_named():
    found = verdict(entry(["a@x"], 100.0, 0.002), entry(["b@x"], 50.0, 0.4, seed=1))
    assert found.verdict == "explained" and not found.beside_a_rest
    assert found.best.names == ["a@x"]
    assert 0.9 < found.probabilities[0] < 1.0


@pytest.mark.parametrize(
    ("best", "rival", "names", "told"),
    [
        (0.02, 0.0015, ["b@x"], ["a@x", "b@x"]),
        (0.02, 0.004, ["b@x"], ["a@x"]),  # not ten times less
        (0.0008, 0.00001, ["b@x"], ["a@x"]),  # no more than the form of a law
        (0.02, 0.0015, ["b@x", "c@x"], ["a@x"]),  # more effects
    ],
)
def test_what_scores_worse_and_leaves_far_less_ties(best, rival, names, told):
    found = verdict(entry(["a@x"], 100.0, best), entry(names, 90.0, rival, seed=1))
    assert sorted(name for each in found.confusion for name in each.names) == told


@pytest.mark.parametrize(
    ("ahead", "other", "left", "names", "gone"),
    [
        (0.2, 0.01, 0.01, ["b@x"], True),
        (0.2, 0.05, 0.01, ["b@x"], False),  # not ten times better
        (0.02, 0.001, 0.01, ["b@x"], False),  # the best is good enough
        (0.2, 0.01, 0.4, ["b@x"], False),  # the other explains no pieces
        (0.2, 0.01, 0.01, ["b@x", "c@x"], False),  # more effects
        (0.2, float("nan"), 0.01, ["b@x"], False),  # not looked at
    ],
)
def test_what_predicts_far_ahead_much_worse_than_another_is_shortsighted(ahead, other, left, names, gone):
    best, rival = entry(["a@x"], 100.0, 0.002), entry(names, 90.0, left, seed=1)
    best.ahead, rival.ahead = ahead, other
    assert find_shortsighted([best, rival], entry([], 0.0, 1.0), Thresholds()) == ([best] if gone else [])


@pytest.mark.parametrize(
    ("answer", "flexible", "wanted"),
    [
        (0.5, 0.1, True),  # gains 5 of 9
        (0.15, 0.1, False),  # nearly as good
        (0.1, 0.5, False),  # better
        (1.3, 1.1, True),  # both worse than nothing, the answer more so
        (0.98, 0.96, False),  # not to be told apart
    ],
)
def test_an_answer_that_a_force_without_a_name_outdoes_is_taken_back(answer, flexible, wanted):
    rng, measured = np.random.default_rng(0), np.ones((WINDOWS, 20, 2), bool)
    scale = np.array([2.0, 0.1])
    errors = [Errors(size * scale * rng.normal(size=measured.shape), measured) for size in (1.0, answer, flexible)]
    assert is_outdone(*errors, scale, Thresholds()) == wanted
    lost = Errors(np.full_like(errors[2].error, 0.0), np.zeros_like(measured), WINDOWS)
    assert not is_outdone(*errors[:2], lost, scale, Thresholds())
    found = verdict(entry(["a@x"], 100.0, 0.002), entry(["b@x"], 50.0, 0.4, seed=1))
    found.take_back()
    assert found.verdict == "unexplained" and found.best.names == ["a@x"] and found.confusion == []


@pytest.mark.parametrize(
    ("ratios", "wanted"),
    [
        ([0.4, 0.5] + [5.0] * 6, True),  # better in most windows, though these are small ones
        ([0.4, 0.5] * 4, False),
        ([0.5, 2.0] * 4, False),
        ([5.0], False),  # one window says nothing
    ],
)
def test_one_predicts_more_that_errs_less_in_most_windows(ratios, wanted):
    large = np.arange(len(ratios), 0, -1.0)[:, None, None] ** 2
    one = uniform_errors(0.1, len(ratios))
    other = Errors(one.error * np.sqrt(ratios)[:, None, None], one.measured)
    one, other = (Errors(e.error * large, e.measured) for e in (one, other))
    assert predicts_more(one, other, np.ones(2)) == wanted


@pytest.mark.parametrize(
    ("answer", "wanted"),
    [
        ([0.3, 0.2, 0.25, 0.15, 0.3, 0.2, 0.1, 0.12], True),
        ([0.3, 0.05, 0.09, 0.08, 0.2, 0.1, 0.07, 0.12], False),  # in some windows more, in others less
        ([0.11, 0.105, 0.12, 0.11, 0.13, 0.11, 0.105, 0.02], False),  # a little more in most windows, not in one
        ([0.02] * 8, False),
    ],
)
def test_an_answer_that_predicts_worse_than_without_it_is_worse(answer, wanted):
    baseline = uniform_errors(0.1)
    errors = Errors(np.broadcast_to(np.array(answer)[:, None, None], baseline.error.shape), baseline.measured)
    assert is_worse(baseline, errors, np.ones(2)) == wanted


@pytest.mark.parametrize(
    ("unexcused", "rival", "guesses", "gone"),
    [
        (0.04, 0.001, True, True),
        (0.04, 0.001, False, False),  # what it remembers, the state tells
        (0.04, 0.02, True, False),  # not ten times better
        (0.01, 0.0001, True, False),  # good enough
    ],
)
def test_what_guesses_its_memory_window_by_window_gives_way_to_what_needs_none(unexcused, rival, guesses, gone):
    best, other = entry(["hysteresis@x"], 100.0, 0.002), entry(["b@x"], 90.0, 0.01, seed=1)
    best.ahead, best.unexcused, best.guesses, other.unexcused = 0.001, unexcused, guesses, rival
    assert find_shortsighted([best, other], entry([], 0.0, 1.0), Thresholds()) == ([best] if gone else [])


@pytest.mark.parametrize(
    ("answer", "flexible", "wanted"),
    [(0.004, 0.006, False), (0.0155, 0.0185, True), (0.004, 0.003, True), (0.004, np.nan, False)],
)
def test_what_is_named_beside_a_rest_leaves_a_slight_one_that_is_no_force(answer, flexible, wanted):
    sizes = {"baseline": 0.1, "augmented": answer, "flexible": flexible}
    judging = {name: uniform_errors(size) for name, size in sizes.items()}
    assert is_refuted(judging, 0.002, np.ones(2), Thresholds(), beside_a_rest=True) == wanted
    assert not is_refuted(judging, 0.01, np.ones(2), Thresholds(), beside_a_rest=False)


def uniform_errors(size, windows=8):
    errors = np.full((windows, 5, 2), 1.0 if np.isnan(size) else size)
    return Errors(errors, np.full(errors.shape, np.isfinite(size)))


@pytest.mark.parametrize(
    ("baseline", "answer", "floor", "wanted"),
    [
        (0.9, 0.4, 0.07, True),
        (0.9, 0.15, 0.07, False),  # a thirtieth of the squared error
        (0.05, 0.02, 0.01, False),  # near what noise allows
        (0.9, float("nan"), 0.07, False),  # nothing was left out
    ],
)
def test_an_answer_that_leaves_much_error_on_recordings_left_out_is_taken_back(baseline, answer, floor, wanted):
    assert falls_short(uniform_errors(baseline), uniform_errors(answer), np.ones(2), floor, Thresholds()) == wanted


@pytest.mark.parametrize(("astray", "windows", "wanted"), [(1, 8, False), (2, 8, True), (1, 3, True)])
def test_one_window_of_several_in_which_the_answer_goes_astray_takes_nothing_back(astray, windows, wanted):
    answer = uniform_errors(0.02, windows)
    answer.error[:astray] = 2.0
    assert falls_short(uniform_errors(0.9, windows), answer, np.ones(2), 0.01, Thresholds()) == wanted


def test_candidates_that_predict_alike_are_a_confusion_set():
    found = verdict(entry(["a@x"], 100.0, 0.002), entry(["b@x"], 100.0, 0.002, seed=1))
    assert found.verdict == "ambiguous"
    assert {tuple(e.names) for e in found.confusion} == {("a@x",), ("b@x",)}
    assert sum(found.probabilities) < 1.0
    assert min(found.probabilities) > 0.01


@pytest.mark.parametrize(
    ("share", "better", "wanted"),
    [
        (-12.0, 0.0, "ambiguous"),
        (-20.0, 0.0, "explained"),
        (-20.0, 0.3, "ambiguous"),  # the windows say more than the numbers are a coincidence
        (-30.0, 0.3, "explained"),
    ],
)
def test_what_does_as_well_by_a_coincidence_of_its_numbers_is_no_rival(share, better, wanted):
    plain, contrived = entry(["a@x"], 100.0, 0.002, p=0.4), entry(["b@x"], 100.0, 0.002, p=0.4, seed=1)
    contrived.scores += plain.scores.mean() - contrived.scores.mean() + better
    plain.log_share, contrived.log_share = -10.0, share
    found = verdict(plain, contrived)
    assert found.verdict == wanted
    assert ["a@x"] in [each.names for each in found.confusion]
    assert sum(found.probabilities) == pytest.approx(0.95, abs=0.01)


@pytest.mark.parametrize(("p", "wanted"), [(0.001, "ambiguous"), (0.4, "explained")])
def test_small_differences_say_nothing_where_the_best_is_not_wholly_right(p, wanted):
    """The second is worse by 0.3 % of what the best gains: far more than chance, and little against what both leave."""
    best, second = entry(["a@x"], 1000.0, 0.002, p=p), entry(["b@x"], 997.0, 0.002, p=p)
    found = verdict(best, second)
    assert found.verdict == wanted
    assert found.best.names == ["a@x"]
    if wanted == "ambiguous":
        assert found.probabilities[0] > found.probabilities[1] > 0.02


def test_what_leaves_the_misfit_explains_nothing():
    assert verdict(entry(["a@x"], 100.0, 0.2)).verdict == "unexplained"
    assert verdict(entry(["a@x"], 100.0, 0.2, p=0.4)).verdict == "explained"
    assert verdict(entry(["a@x"], 0.0, 0.0)).verdict == "unexplained"
    assert verdict().verdict == "unexplained"


def ahead(found, share, judged=True):
    """An entry that leaves a share of the error of predictions ahead."""
    found.ahead = share
    found.misfit = dataclasses.replace(found.misfit, judged=np.arange(WINDOWS) >= (0 if judged else 5))
    return found


@pytest.mark.parametrize(
    ("share", "judged", "other", "wanted"),
    [
        (0.02, True, 0.19, "explained"),
        (0.05, True, 0.19, "unexplained"),  # predictions miss something, too
        (0.02, False, 0.19, "unexplained"),  # excused for what it may remember
        (0.02, True, 0.05, "unexplained"),  # another candidate explains the rest of pieces
        (float("nan"), True, 0.19, "unexplained"),
    ],
)
def test_one_effect_by_which_all_but_a_rest_is_foreseen_is_named(share, judged, other, wanted):
    alone, pair = ahead(entry(["a@x"], 100.0, 0.2), share, judged), entry(["a@x", "b@x"], 120.0, other)
    found = verdict(pair, alone, entry(["c@x"], 60.0, 0.3, seed=1))
    assert found.verdict == wanted
    if wanted == "explained":
        assert found.best.names == ["a@x"] and found.beside_a_rest
        assert found.probabilities[0] < 0.8, "the rest counts against it"


def test_two_effects_that_foresee_alike_but_for_a_rest_are_a_confusion_set():
    pair = entry(["a@x", "b@x"], 120.0, 0.19)
    found = verdict(pair, *(ahead(entry([name], 100.0, 0.2, seed=k), 0.02) for k, name in enumerate(["a@x", "c@x"])))
    assert found.verdict == "ambiguous"
    assert {tuple(e.names) for e in found.confusion} == {("a@x",), ("c@x",)}


def test_what_explains_pieces_and_predicts_no_better_explains_nothing():
    found = entry(["a@x"], 100.0, 0.002)
    for ahead, wanted in ((0.95, "unexplained"), (0.2, "explained")):
        found.ahead = ahead
        assert verdict(found).verdict == wanted
    some = entry(["a@x"], 100.0, 0.02)
    for ahead, wanted in ((0.2, "unexplained"), (0.02, "explained")):
        some.ahead = ahead
        assert verdict(some).verdict == wanted
    rough = entry(["a@x"], 100.0, 0.3)
    for ahead, wanted in (
        (0.002, "explained"),
        (0.02, "explained"),
        (0.05, "unexplained"),
    ):  # all but a rest is foreseen at 3 %
        rough.ahead = ahead
        assert verdict(rough).verdict == wanted


@pytest.mark.parametrize(
    ("left", "ahead", "wanted"),
    [
        (0.6, 0.9, "unexplained"),
        (0.6, 0.1, "explained"),
        (0.6, float("nan"), "unexplained"),  # a trace of a misfit of an elbow that whirls was called drag
        (0.4, float("nan"), "explained"),
    ],
)
def test_what_leaves_most_of_both_explains_nothing_though_pieces_cannot_tell(left, ahead, wanted):
    weak = entry(["a@x"], 10.0, left, p=0.3)
    weak.ahead = ahead
    assert verdict(weak).verdict == wanted


def test_what_is_excused_where_its_past_is_unknown_has_to_explain_what_is_judged():
    """A jolt, taken for bristles: they leave a third of the misfit in pieces; the moves of initial states hide it."""
    for left, wanted in ((0.3, "unexplained"), (0.002, "explained")):
        bristles = entry(["lugre_friction@x"], 100.0, left)
        bristles.ahead = 0.0
        judged = np.arange(WINDOWS) > 5
        bristles.misfit = dataclasses.replace(bristles.misfit, judged=judged)
        assert verdict(bristles).verdict == wanted


def test_what_noise_in_initial_states_costs_ahead_is_no_error_of_a_candidate():
    rng, shape = np.random.default_rng(0), (40, 50, 2)
    noise, started = np.array([0.1, 0.2]), rng.normal(size=(40, 1, 1)) * np.linspace(0.0, 1.0, 50)[:, None]
    y = started + noise * rng.normal(size=shape)
    shots = Shots(None, y, np.ones(shape, bool), np.ones(2))
    spread = np.broadcast_to(np.linspace(0.0, 1.0, 50)[:, None] ** 2, shape)
    base, right = np.full(shape, 3.0), np.zeros(shape)
    assert error_left(shots, right, base, noise) > 0.015
    assert error_left(shots, right, base, noise, spread) < 0.01
    assert error_left(shots, base, base, noise, spread) == pytest.approx(1.0)
    assert np.isnan(error_left(shots, right, right, noise, spread))


def test_an_error_of_any_size_against_the_noise_is_counted_whole_where_it_is_asked():
    """The encoder of a rail shows 0.3 μm, and a simulator is 10 mm off: a billion times the noise, squared."""
    shape = (20, 50, 1)
    shots = Shots(None, np.zeros(shape), np.ones(shape, bool), np.ones(1))
    base, noise = np.full(shape, 1e-2), np.full(1, 3e-7)
    assert error_left(shots, 0.1 * base, base, noise, whole=True) == pytest.approx(0.01, rel=1e-3)
    assert error_left(shots, 0.1 * base, base, noise) == pytest.approx(1.0)
    lost = np.where(np.arange(20)[:, None, None] < 5, np.nan, 0.1 * base)
    assert error_left(shots, lost, base, noise, whole=True) == pytest.approx(0.25 + 0.75 * 0.01, rel=1e-3)


def test_what_chaos_excuses_in_one_window_excuses_nothing_in_another():
    """Half of the windows cannot be predicted, and nobody does much worse there; in the others a third is left."""
    rng, shape = np.random.default_rng(0), (40, 50, 1)
    y = 0.1 * rng.normal(size=shape)
    shots = Shots(None, y, np.ones(shape, bool), np.ones(1))
    chaotic = np.arange(40)[:, None, None] < 20
    base, half = np.full(shape, 3.0), np.where(chaotic, 0.3, np.sqrt(3.0)) * np.ones(shape)
    spread = np.where(chaotic, 4.0, 0.0) * np.ones(shape)
    left = error_left(shots, half, base, np.full(1, 0.1), spread)
    assert left == pytest.approx(20 * 3.0 / (20 * 5.0 + 20 * 9.0), rel=0.1)


def test_a_joint_that_nobody_can_predict_says_nothing_of_an_effect_at_another():
    """An arm whose shoulder drifts by what initial states are off, in each window otherwise, and its wrist's sensor."""
    rng, shape = np.random.default_rng(0), (28, 50, 2)
    off = rng.normal(size=(28, 1, 1)) * np.array([2.0, 0.0])
    y = off + 0.1 * rng.normal(size=shape)
    shots = Shots(None, y, np.ones(shape, bool), np.ones(2))
    base, right = np.broadcast_to([0.0, 0.5], shape), np.zeros(shape)
    spread = np.broadcast_to([3.0, 0.0], shape)
    assert error_left(shots, right, base, np.full(2, 0.1), spread) < 0.01
    half = np.broadcast_to([0.0, 0.25], shape)
    assert error_left(shots, half, base, np.full(2, 0.1), spread) == pytest.approx(0.25, rel=0.1)


def test_a_tie_with_what_does_not_explain_is_no_confusion():
    assert verdict(entry(["a@x"], 100.0, 0.002), entry(["b@x"], 100.0, 0.3, seed=1)).verdict == "explained"


@pytest.mark.parametrize(
    ("left", "ahead", "told"),
    [
        (0.0005, 0.002, "stribeck_friction@joint/a"),  # 26 times less, and a fifth of the error ahead
        (0.0005, 0.009, "coulomb_friction@joint/a"),  # no better ahead
        (0.005, 0.002, "coulomb_friction@joint/a"),  # not ten times less
    ],
)
def test_a_law_that_shows_far_more_than_its_rivals_is_the_finding(left, ahead, told):
    """Levels of friction that fall with speed, in many recordings: the scores differ by less than half a percent."""
    law = entry(["stribeck_friction@joint/a"], 1000.0, left, seed=1)
    special = entry(["coulomb_friction@joint/a"], 999.0, 0.013, seed=1)
    sibling = entry(["asymmetric_friction@joint/a"], 999.0, 0.0128, seed=1)
    law.ahead, special.ahead, sibling.ahead = ahead, 0.011, 0.011
    found = verdict(law, special, sibling)
    assert found.verdict == "explained"
    assert found.best.names == [told]


def test_a_special_case_stands_for_what_contains_it():
    coulomb, stribeck = entry(["coulomb_friction@joint/a"], 100.0, 0.0), entry(["stribeck_friction@joint/a"], 100, 0.0)
    found = verdict(coulomb, stribeck)
    assert [e.names for e in found.confusion] == [coulomb.names]
    assert found.probabilities[0] == pytest.approx(0.95, abs=0.01)
    apart = verdict(entry(["coulomb_friction@joint/b"], 100.0, 0.0), stribeck)
    assert apart.verdict == "ambiguous"
    rotor, gap = entry(["armature@joint/a"], 100.0, 0.0), entry(["backlash@actuator/m"], 100.0, 0.0, seed=1)
    assert verdict(rotor, gap).verdict == "ambiguous"
    gap.seats = {"backlash@actuator/m": "backlash@joint/a"}
    assert verdict(rotor, gap).best.names == rotor.names
    assert are_kin("coulomb_friction@joint/a", "stribeck_friction@joint/a")
    assert not are_kin("coulomb_friction@joint/a", "coulomb_friction@joint/b")


@pytest.mark.parametrize(
    ("other", "left", "sets"),
    [
        ("viscous_friction@joint/a", 0.0020001, 2),
        ("viscous_friction@joint/a", 0.0021, 1),  # not the same
        ("viscous_friction@joint/b", 0.0020001, 1),  # not there
        ("quadratic_drag@joint/a", 0.0020001, 1),  # no twin
    ],
)
def test_twins_that_leave_the_same_are_told_together(other, left, sets):
    """Scores tell the two apart by far more than chance, and no misfit does."""
    best, second = entry(["back_emf@actuator/m"], 1000.0, 0.002), entry([other], 900.0, left)
    best.seats = {"back_emf@actuator/m": "back_emf@joint/a"}
    found = verdict(best, second)
    assert len(found.confusion) == sets
    assert found.probabilities == pytest.approx([0.95 / sets] * sets, abs=0.01)


@pytest.mark.parametrize(
    ("beside", "left", "p", "sets"),
    [
        (["gain_drift@joint/a"], 0.0004, 0.001, 2),
        (["gain_drift@joint/a"], 0.0014, 0.001, 1),  # the twin leaves more than the form of a law
        (["gain_drift@joint/a"], 0.0004, 0.3, 1),  # nothing shows that could bend the twin
        ([], 0.0004, 0.001, 1),  # nothing beside it does
    ],
)
def test_twins_beside_others_are_told_together_where_both_leave_next_to_nothing(beside, left, p, sets):
    best = entry(["back_emf@joint/a", *beside], 1000.0, 0.0002, p)
    found = verdict(best, entry(["viscous_friction@joint/a", *beside], 900.0, left, p))
    assert len(found.confusion) == sets


def test_a_set_stands_for_all_that_it_is_left_of():
    def friction(at_a, at_b, *more, seed=0):
        return entry([f"{at_a}@joint/a", f"{at_b}@joint/b", *more], 100.0, 0.0, seed=seed)

    plain = friction("coulomb_friction", "coulomb_friction")
    both, more = (
        friction("stribeck_friction", "asymmetric_friction", seed=1),
        friction("coulomb_friction", "lugre_friction", "armature@joint/a", seed=2),
    )
    crossed = entry(["coulomb_friction@joint/a", "stribeck_friction@joint/a"], 100.0, 0.0, seed=3)
    found = verdict(plain, both, more)
    assert [e.names for e in found.confusion] == [plain.names]
    assert found.probabilities[0] == pytest.approx(0.95, abs=0.01)
    # two laws of one joint are no law of the other's
    assert len(verdict(plain, crossed).confusion) == 2


@pytest.mark.parametrize(
    ("left", "score", "general", "simpler", "told"),
    [
        (0.0009, 996.0, "stribeck_friction@joint/a", "coulomb_friction@joint/a", True),
        (0.0009, 996.0, "hysteresis@joint/a", "coulomb_friction@joint/a", True),
        (0.0009, 996.0, "hysteresis@joint/a", "joint_spring@joint/a", True),
        (0.0009, 996.0, "back_emf@actuator/a", "actuator_gain@actuator/a", True),
        (0.0011, 996.0, "stribeck_friction@joint/a", "coulomb_friction@joint/a", False),
        (0.0, 990.0, "stribeck_friction@joint/a", "coulomb_friction@joint/a", False),
        (0.0009, 996.0, "stribeck_friction@joint/b", "coulomb_friction@joint/a", False),
    ],
)
def test_what_tells_a_law_from_its_special_case_is_more_than_their_form(left, score, general, simpler, told):
    """Nobody knows how a machine rounds a sign; but where coarse sensors leave nothing to see, scores still tell."""
    found = verdict(entry([general], 1000.0, 0.0001, p=0.5), entry([simpler], score, left, seed=1))
    assert (found.verdict, found.best.names) == ("explained", [simpler if told else general])


@pytest.mark.parametrize(
    ("left", "general", "simpler", "told"),
    [
        (0.006, 0.004, "coulomb_friction@joint/a", True),
        (0.012, 0.004, "coulomb_friction@joint/a", False),  # worth its parameters
        (0.002, 0.0009, "coulomb_friction@joint/a", False),  # no more than the form of a law
        (0.04, 0.02, "coulomb_friction@joint/a", False),  # the special case does not explain it
        (0.006, 0.004, "viscous_friction@joint/a", False),
    ],
)
def test_a_law_that_leaves_hardly_less_than_its_special_case_is_not_what_is_there(left, general, simpler, told):
    """Though held-out scores tell them apart: friction as a constraint brakes within milliseconds, as bristles do."""
    law = "lugre_friction@joint/a"
    found = verdict(entry([law], 1000.0, general), entry([simpler], 900.0, left, seed=1))
    assert (found.verdict, found.best.names) == ("explained", [simpler if told else law])


def test_what_the_time_step_does_is_fitted_and_not_named():
    """A pair with a delay shorter than a step is told by the other's name, once; the delay by itself is nothing."""
    late = [entry(["a@x"], 100.0, 0.002), entry(["a@x"], 99.0, 0.002), entry(["b@x"], 99.5, 0.002)]
    for k, each in enumerate(late):
        each.candidate = Candidate((k, 9))
    alone = entry(["a@x"], 60.0, 0.02)
    found = verdict(*late, alone)
    assert found.verdict == "ambiguous"
    assert [each.names for each in found.confusion] == [["a@x"], ["b@x"]]
    assert found.best.candidate == Candidate((0, 9))
    assert sum(found.probabilities) < 1.0
    assert verdict(entry([], 100.0, 0.002), entry(["a@x"], 50.0, 0.4)).verdict == "no_mismatch"


def test_more_effects_have_to_be_worth_it():
    single, small = entry(["a@x"], 100.0, 0.025), entry(["a@x", "b@y"], 120.0, 0.015)
    assert verdict(single, small).best.names == ["a@x"]
    assert verdict(single, entry(["a@x", "b@y"], 120.0, 0.002)).best.names == ["a@x", "b@y"]
    assert verdict(single, entry(["c@x", "b@y"], 120.0, 0.02)).best.names == ["c@x", "b@y"]
    assert verdict(entry(["a@x"], 100.0, 0.2), small).best.names == ["a@x", "b@y"]
    assert verdict(single, entry(["a@x", "b@y"], 100.0, 0.025)).best.names == ["a@x"]
    assert verdict(entry(["a@x"], 100.0, 0.05), entry(["a@x", "b@y"], 120.0, 0.025)).verdict == "unexplained"


@pytest.mark.parametrize(
    ("left", "doubt", "wanted"),
    [
        (2e-6, 1e-5, ["a@x"]),
        (2e-6, 0.2, ["a@x", "b@x"]),  # predictions ahead miss something
        (2e-4, 1e-5, ["a@x", "b@x"]),
    ],
)
def test_beside_a_trace_of_a_misfit_no_other_effect_is_worth_it(left, doubt, wanted):
    alone, pair = entry(["a@x"], 100.0, left), entry(["a@x", "b@x"], 150.0, 0.1 * left)
    alone.ahead, pair.ahead = doubt, 0.1 * doubt
    assert verdict(pair, alone).best.names == wanted


@pytest.mark.parametrize(("part", "both", "wanted"), [(0.25, 0.1, ["a@x", "b@x"]), (0.05, 0.02, ["a@x"])])
def test_where_predictions_still_miss_much_another_effect_is_worth_what_it_gains_there(part, both, wanted):
    alone, pair = ahead(entry(["a@x"], 100.0, 0.001), part), ahead(entry(["a@x", "b@x"], 150.0, 0.0005), both)
    assert verdict(pair, alone).best.names == wanted


def test_a_set_that_wins_in_few_recordings_is_less_probable():
    steady, rest = np.full(WINDOWS, 100.0), np.full(WINDOWS, 100.0)
    rest[:2] -= 4.0
    first, second = entry(["a@x"], 0.0, 0.0, p=0.4), entry(["b@x"], 0.0, 0.0, p=0.4)
    first.scores, second.scores = steady, rest
    found = verdict(first, second)
    assert found.verdict == "ambiguous"
    assert 0.8 < found.probabilities[0] < 0.95


@pytest.mark.parametrize(
    ("part", "both", "wanted"),
    [
        (0.045, 0.051, ["a@x"]),  # it mends pieces, and nothing ahead
        (0.045, 0.039, ["a@x", "b@x"]),
        (0.015, 0.017, ["a@x", "b@x"]),  # too little is left ahead to tell
        (0.045, np.nan, ["a@x", "b@x"]),
    ],
)
def test_another_effect_has_to_tell_of_the_time_ahead(part, both, wanted):
    alone = entry(["a@x"], 90.0, 0.004)
    pair = entry(["a@x", "b@x"], 100.0, 0.0006, seed=1)
    alone.ahead, pair.ahead = part, both
    found = verdict(alone, pair)
    assert found.verdict == "explained" and found.best.names == wanted


def test_a_set_is_widened_only_where_it_is_worth_its_effects_and_is_not_enough():
    none = entry([], 0.0, 1.0)
    alone, other = entry(["a@x"], 100.0, 0.5), entry(["b@x"], 90.0, 0.6, seed=1)
    cases = ((0.1, 0.2, True), (0.01, 0.2, True), (0.02, 0.02, True), (0.01, 0.005, False), (0.4, 0.2, False))
    for left, ahead, wanted in cases:
        pair = entry(["a@x", "b@x"], 200.0, left, seed=2)
        pair.ahead = ahead
        assert _is_too_narrow([pair, alone, other], none, Thresholds()) is wanted
    assert not _is_too_narrow([alone, pair], none, Thresholds())
    most = entry(["a@x", "b@x", "c@x", "d@x"], 300.0, 0.2, seed=3)
    assert not _is_too_narrow([most, alone], none, Thresholds())


def test_what_ties_for_the_best_or_is_a_part_of_that_may_be_named():
    best, second = entry(["a@x", "b@x"], 100.1, 0.002), entry(["c@x"], 100.0, 0.002, seed=1)
    part, other = entry(["b@x"], 60.0, 0.002), entry(["d@x"], 70.0, 0.002)
    every = [best, second, other, part]
    asked = [may_be_named(each, every, entry([], 0.0, 1.0), Thresholds()) for each in every]
    assert asked == [True, True, False, True]


def test_a_special_case_that_was_tried_before_is_there_when_its_law_is_looked_at_again():
    laws, none = Laws(), entry([], 0.0, 1.0)
    law, special = laws.entry(0, 2, mean=100.0, left=1e-4), laws.entry(1, 2, mean=100.0, left=1e-4)
    before = {each.candidate: each for each in (law, special)}
    assert _recall(laws, none, [law], before, Thresholds()) == [law, special]
    assert _recall(laws, none, [law], {law.candidate: law}, Thresholds()) == [law]


def test_the_same_effect_twice_at_one_place_is_not_that_effect_once():
    """Two stops of one joint bear one name, and are no special case of one of them beside a spring."""
    spring, stops = ["joint_spring@joint/a", "soft_stop@joint/a"], ["soft_stop@joint/a", "soft_stop@joint/a"]
    first, twice = entry(spring, 100.0, 0.0001), entry(stops, 99.9, 0.0002, spread=0.0)
    stop, scale = entry(["soft_stop@joint/a"], 60.0, 0.5), entry(["soft_stop@joint/a", "b@y"], 99.95, 0.0001)
    found = verdict(first, scale, twice, stop)
    assert first in found.confusion and scale in found.confusion
