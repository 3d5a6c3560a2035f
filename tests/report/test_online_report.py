import re
from dataclasses import replace

import numpy as np
import pytest

from bayessim_jax.report.online import render
from bayessim_jax.report.words import headline
from tests.browser import CHROMIUM, open_in_chromium
from tests.report.made_up import made_up


@pytest.fixture(scope="module")
def page():
    return render(made_up(rounds=16))


def test_the_page_shows_the_papers_rounds_and_needs_nothing_else(page):
    captions = re.findall(r"<figcaption>(Round \d+)", page)
    assert captions == ["Round 1", "Round 5", "Round 15", "Round 16", "Round 16"]
    assert not re.search(r'(src|href)="(?!#)|url\((?!#)|<script|@import', page)
    assert page.count('role="img"') == page.count("<figure") == 9


def test_rounds_that_do_not_exist_are_not_shown():
    captions = re.findall(r"<figcaption>(Round \d+)", render(made_up(rounds=3)))
    assert captions == ["Round 1", "Round 3", "Round 3"]


def test_text_is_escaped():
    run = made_up(rounds=1)
    run.settings["system"] = "<script>alert(1)</script>"
    run.names[0] = "<b>&"
    for line in run.lines:
        for key in ("mean", "sd", "rank_true"):
            line[key] = {"<b>&": 0.5, "mass": 0.3}
    page = render(run)
    assert "<script" not in page
    assert "<b>" not in page
    assert "&lt;b&gt;&amp;" in page


def test_every_round_is_in_the_table_with_its_numbers(page):
    rows = re.findall(r"<tr><td>(\d+)</td>", page)
    assert rows == [str(r) for r in range(1, 17)]


def test_what_to_do_next_follows_from_the_run():
    done = render(made_up(rounds=3))
    assert "bayessim online cartpole --out runs/cartpole-seed3 --resume --rounds 6" in done
    assert "--seeds 8" in done
    run = made_up(rounds=3, seeds=2, overfit=True)
    run.settings["rounds"] = 30
    cut = render(run)
    assert "--resume</code>" in cut
    assert "--simulations 400" in cut
    assert "--seeds 8" not in cut


def test_the_caption_of_the_coverage_says_how_the_posterior_was_corrected():
    run = made_up(rounds=1)
    both = "corrected by those of the other half", "its width, which is chosen on these"
    for change, told in (({}, both[1:]), ({"history": 1}, both[:1]), ({"proposal": "paper"}, ())):
        page = render(replace(run, settings=run.settings | change))
        assert tuple(words for words in both if words in page) == told


@pytest.mark.parametrize("seeds", [1, 3])
def test_a_ground_that_changes_is_told_and_the_geometry_that_it_makes_apparent(seeds):
    run = made_up(rounds=4, seeds=seeds)
    settings = {**run.settings, "target": "vehicle", "change": {"round": 3.0, "terrain": "ice", "lag": 0.2}}
    apparent = 0.75 * np.repeat(run.truths[:, None], 4, axis=1)
    page = render(replace(run, settings=settings, apparent=apparent))
    assert "the target changes before round 3: terrain = ice, lag = 0.2." in page
    assert "apparent" in page
    assert "log q(θ*), raw units of θ" not in page
    if seeds == 1:
        assert f"(true {run.truths[0, 0]:.2f}" in headline(run)
        assert ", apparent " in headline(replace(run, apparent=apparent))


@pytest.mark.parametrize("options", [{"known": False}, {"seeds": 9}, {"d": 4}, {"d": 1}], ids=str)
def test_every_kind_of_run_has_a_report(options):
    page = render(made_up(rounds=2, **options))
    assert ("truth" in re.sub("<[^>]*>", "", page).lower()) == options.get("known", True)
    assert ("simulation-based calibration" in page.lower()) == ("seeds" in options)


@pytest.mark.skipif(CHROMIUM is None, reason="Chromium is not installed")
def test_chromium_shows_the_figures_without_errors(page, tmp_path):
    dom, errors = open_in_chromium(page, tmp_path)
    assert errors == []
    assert dom.count('role="img"') == 9
    assert "length [m]" in dom
    # the same look finds an error where there is one: the page's policy forbids scripts
    _, errors = open_in_chromium(page.replace("</main>", "<script>nothing()</script></main>"), tmp_path)
    assert errors
