import math

import pytest

from bayessim_jax.report.words import collapses, headline, number, plus_minus, worries
from tests.report.made_up import made_up


@pytest.mark.parametrize(
    ("mean", "sd", "text"),
    [
        (0.41234, 0.00617, "0.4123 ± 0.0062 m"),
        (12.3, 4.0, "12.3 ± 4.0 m"),
        (-0.5, 0.25, "−0.50 ± 0.25 m"),
        (1234.0, 56.0, "1234 ± 56 m"),
        (0.5, 0.0, "0.500 m"),
        (math.nan, 1.0, "– m"),
    ],
)
def test_plus_minus(mean, sd, text):
    assert plus_minus(mean, sd, "m") == text


@pytest.mark.parametrize(
    ("value", "text"), [(0.0, "0"), (3.14159, "3.14"), (-2.0, "−2.00"), (1.5e-7, "1.50e−07"), (math.inf, "–")]
)
def test_number(value, text):
    assert number(value) == text


def test_the_first_sentence_tells_what_was_learned():
    run = made_up(rounds=16)
    mean, truth = run.vectors("mean")[0, -1, 0], run.truths[0, 0]
    text = headline(run)
    assert text.startswith("After 16 rounds length is 0.6")
    assert f"{mean:.3f} ± " in text
    assert f"(true {truth:.3f})" in text
    assert "return on the target is 47" in text
    assert "(true" not in headline(made_up(known=False))


def test_several_seeds_are_summed_up():
    text = headline(made_up(seeds=9, rounds=4))
    assert "9 seeds, each with its own truth" in text
    assert "above the prior" in text
    assert "0.500 below the prior" in headline(made_up(seeds=3, rounds=2, gain_over_prior=-0.5))
    assert headline(made_up(seeds=3, rounds=4, known=False)).count("over the seeds") == 2


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"overconfident": True, "coverage90": 0.6}, "over-confident: only 60%"),
        ({"overfit": True}, "over-fitted after its best epoch"),
        ({"strangeness": 12.0}, "unlike what is simulated: it lies 12 standard deviations"),
        ({"prior_share": 1.0}, "no usable posterior"),
        ({"diverged": 2}, "8 simulations gave numbers that are not finite"),
        ({"diverged_target": 1}, "4 recordings of the target held numbers that are not finite"),
        ({"masked": 3}, "12 steps of the learner's simulations"),
        ({"nonfinite": 1}, "4 updates"),
        ({"gain_over_prior": -0.5}, "confidently wrong"),
        ({"gain_over_prior": None}, "confidently wrong"),
        ({"level_true": 0.999}, "outside the 99 %"),
    ],
)
def test_each_reason_for_distrust_is_told(change, word):
    calm = {"level_true": 0.4, "gain_over_prior": 2.0, "coverage90": 0.9}
    assert worries(made_up(rounds=4, **calm)) == []
    assert [text for text in worries(made_up(rounds=4, **calm | change)) if word in text]


def test_a_collapse_is_a_reason_for_distrust_where_nothing_corrects_it():
    run = made_up(rounds=4, seeds=3, collapsed=True, level_true=0.4, gain_over_prior=2.0, coverage90=0.9)
    assert collapses(run).startswith("The posterior of the networks alone collapsed in 4 rounds: down to 70%")
    assert worries(run) == []
    run.settings["proposal"] = "paper"
    assert [text for text in worries(run) if "collapsed in 4 rounds" in text and "Nothing widens it" in text]


def test_seeds_that_miss_their_truth_too_often_are_told():
    assert not worries(made_up(seeds=10, rounds=2, level_true=0.8))
    assert "Only 0 of 10" in worries(made_up(seeds=10, rounds=2, level_true=0.95))[0]


def test_a_run_that_stopped_early_says_so():
    run = made_up(rounds=4, level_true=0.4, gain_over_prior=2.0)
    run.settings["rounds"] = 30
    assert worries(run) == ["The run stopped after 4 rounds of 30."]


def test_a_run_that_never_inferred_claims_nothing():
    told = headline(made_up(rounds=4, log_q_validation=None))
    assert told.startswith(
        "After 4 rounds of domain randomization over length and mass nothing was inferred. The policy"
    )
    assert "±" not in told
