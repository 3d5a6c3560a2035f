"""The report of a run of the outer loop."""

from __future__ import annotations

import shlex
from typing import Any

import numpy as np

from bayessim_jax.report import html
from bayessim_jax.report.beside import beside_animation
from bayessim_jax.report.curves import cost_over_rounds, estimates_plot, log_density_plot, return_plot
from bayessim_jax.report.drives import cost_plot, drive_animation, paths_plot, shown_rounds
from bayessim_jax.report.evidence import OnlineRun
from bayessim_jax.report.pairs import pair_plot
from bayessim_jax.report.trust import coverage_plot, rank_plot, truth_coverage_plot
from bayessim_jax.report.viewer import SCRIPT_HASH, script
from bayessim_jax.report.words import collapses, headline, invocation, number, plus_minus, title, worries

__all__ = ["render"]

SHOWN = (1, 5, 15)
SHOWN_OF_PLANNERS = (1, 2)
SEEDS_FOR_RANKS = 8


def render(run: OnlineRun) -> str:
    """The whole page as text."""
    name = title(run.settings)
    alarms = worries(run)
    good = "No sign of over-fitting, over-confidence or divergence was found in the last round."
    notices = [html.notice(text) for text in alarms] or [html.notice(good, good=True)]
    body = [
        f"<h1>{html.escape(name)}</h1>",
        f'<p class="soft">{html.escape(_circumstances(run))}</p>',
        f'<p class="lead">{html.escape(headline(run))}</p>',
        *(f'<p class="soft">{html.escape(_sentence(text))}</p>' for text in run.facts.get("remarks", [])),
        *notices,
        *([html.section("Control", *_control(run))] if run.drives else []),
        html.section("Posterior", *_posterior(run)),
        *([html.section("Target and simulator", beside_animation(run.beside))] if run.beside else []),
        html.section("Over rounds", *_over_rounds(run)),
        *([html.section("Calibration", *_calibration(run))] if run.inferred else []),
        html.section("What to do next", html.commands(_next(run, bool(alarms)))),
        html.section("Settings", _settings(run)),
        f"<footer>{html.escape(_origin(run))}</footer>",
    ]
    moving = run.scene is not None or run.beside is not None
    page = "\n".join(body)
    return html.page(name, page, script=script(), script_hash=SCRIPT_HASH) if moving else html.page(name, page)


def _control(run: OnlineRun) -> list[str]:
    """What a planner did on the target."""
    drives, scene = run.drives, run.scene
    assert drives is not None
    rounds = ", ".join(str(r) for r in shown_rounds(run.rounds))
    which = f" (seed {run.seeds[0]}, the first of {len(run.seeds)})" if len(run.seeds) > 1 else ""
    figures = []
    if scene is not None:
        caption = (
            f"The drives of rounds {rounds}{which}, each under what was believed before it; round 1 under the prior."
        )
        figures.append(
            html.figure(paths_plot(drives, scene.radius), "Paths around the circle, round by round.", caption)
        )
    caption = f"Mean cost of a step so far, while rounds {rounds} were recorded{which}."
    figures.append(html.figure(cost_plot(drives), "Mean cost of a step so far, over time.", caption))
    if scene is not None:
        caption = (
            f"Round {run.rounds}: a few of the plans that are weighed at each moment, their weighted mean, and the way "
            "taken. They were planned again along the recorded poses, and are drawn under the mean of the belief."
        )
        figures.append(drive_animation(scene, caption))
    return [html.figures(*figures)]


def _posterior(run: OnlineRun) -> list[str]:
    marks = "Shaded: 50 %, 90 % and 99 % credible sets; dashed, grey: the prior"
    marks += "; dashed, orange: the truth." if run.truths is not None else "."
    which = f" (seed {run.seeds[0]}, the first of {len(run.seeds)})" if len(run.seeds) > 1 else ""
    figures = []
    common = (run.names, run.units, run.low, run.high)
    shown = SHOWN_OF_PLANNERS if run.drives else SHOWN
    shown = shown if run.inferred else ()
    for index in sorted({r for r in shown if r <= run.rounds} | {run.rounds}):
        svg = pair_plot(run.draws[index - 1, 0], *common, run.truth_at(index), f"pair{index}")
        alt = f"Pair plot of the posterior after round {index}: {', '.join(run.names)}."
        figures.append(html.figure(svg, alt, f"Round {index}{which}. {marks}"))
    if run.inferred:
        svg = pair_plot(run.draws[-1, 0], *common, run.truth_at(run.rounds), "magnified", magnify=True)
        alt = f"Pair plot of the posterior after round {run.rounds}, magnified."
        figures.append(html.figure(svg, alt, f"Round {run.rounds}{which}, magnified to where the posterior lies."))
    least = "24rem" if len(run.names) <= 2 else "34rem"
    return [html.figures(*figures, least=least), _parameter_table(run)]


def _parameter_table(run: OnlineRun) -> str:
    header = ["parameter", "unit", "prior", "posterior", "5 % to 95 %", *(["truth"] if run.truths is not None else [])]
    rows = []
    for s, seed in enumerate(run.seeds):
        low, high = np.quantile(run.draws[-1, s], [0.05, 0.95], axis=0)
        mean, sd = run.vectors("mean")[s, -1], run.vectors("sd")[s, -1]
        for i, name in enumerate(run.names):
            label = name if len(run.seeds) == 1 else f"{name}, seed {seed}"
            prior = f"{number(run.low[i])} to {number(run.high[i])}"
            row = [label, run.units[i], prior, plus_minus(mean[i], sd[i]), f"{number(low[i])} to {number(high[i])}"]
            rows.append([*row, *([number(run.truths[s, i], 4)] if run.truths is not None else [])])
    shown = html.table(header, rows)
    return shown if len(rows) <= 8 else html.details("Every seed's posterior", shown)


def _over_rounds(run: OnlineRun) -> list[str]:
    figures = []
    target, simulated = run.series("return_target"), run.series("return_simulated")
    returned = np.isfinite(target).any() and not run.drives  # of a planner the cost says the same
    if returned or np.isfinite(simulated).any():
        caption = "Return of an episode: the deterministic policy on the target, and the exploring one in simulation."
        figures.append(html.figure(return_plot(target, simulated), "Return against rounds.", caption))
    changed = run.change[0] if run.change else None
    becomes = f"; the target changes before round {run.change[0]}: {run.change[1]}." if run.change else "."
    if run.drives:
        caption = f"Mean cost of a step on the target, in an episode after each round{becomes}"
        svg = cost_over_rounds(run.series("cost_target"), changed)
        figures.append(html.figure(svg, "Cost of a step against rounds.", caption))
    if run.truths is not None and run.apparent is None:
        log_prior = -float(np.log(run.high - run.low).sum())
        svg = log_density_plot(run.series("log_prob_true"), log_prior)
        caption = "Log density of the truth under the posterior, in raw units of θ; higher is better."
        figures.append(html.figure(svg, "Log-likelihood, log q of the true parameters, against rounds.", caption))
    shape = (run.names, run.units, run.low, run.high, run.truth_over_rounds(), run.apparent, changed)
    svg = estimates_plot(run.vectors("mean"), run.vectors("sd"), *shape)
    alt = "Posterior mean of each parameter against rounds."
    caption = f"What each round concluded{becomes}"
    if run.apparent is not None:
        caption += (
            " Wheels that slip look smaller, and further apart, than they are: dotted is the robot without slip that "
            "would move as the vehicle does once its wheels turn as asked."
        )
    figures.append(html.figure(svg, alt, caption, wide=True))
    return [html.figures(*figures), _rounds_table(run)]


def _rounds_table(run: OnlineRun) -> str:
    columns = {
        "log_prob_true": "log q(θ*)",
        "log_prob_true_scaled": "in prior's units",
        "gain_over_prior": "gain over prior",
        "return_target": "return, target",
        "cost_target": "cost of a step",
        "success_target": "success, target",
        "return_simulated": "return, simulated",
        "log_q_validation": "held-out log q",
        "coverage90": "coverage of 90 %",
        "seconds": "seconds",
        "simulations_per_second": "simulations/s",
    }
    kept = {key: label for key, label in columns.items() if np.isfinite(run.series(key)).any()}
    several = len(run.seeds) > 1
    rows = [
        [str(line["round"]), *([str(line["seed"])] if several else []), *(number(_value(line, key)) for key in kept)]
        for line in run.lines
    ]
    return html.details("Every round in numbers", html.table(["round", *["seed"] * several, *kept.values()], rows))


def _value(line: Any, key: str) -> float:
    value = line.get(key)
    return float("nan") if value is None else float(value)


def _calibration(run: OnlineRun) -> list[str]:
    flags = [np.nan_to_num(run.series(name)) > 0 for name in ("overfit", "overconfident")]
    svg = coverage_plot(run.series("coverage90"), run.series("log_q_train"), run.series("log_q_validation"), *flags)
    caption = (
        "Left: the share of simulated sets of recordings, none of which the networks of single recordings were fitted "
        f"to, whose true parameters lie inside their 90 % credible set{_corrected_by(run)}. Right: the score on "
        "simulations trained on and held out; a widening gap is over-fitting. Orange crosses mark rounds that raised a "
        "flag."
    )
    if run.corrected and (told := collapses(run)):
        caption += f" {told} The correction takes that out, at the price of a wider posterior."
    parts = [html.figure(svg, "Coverage on held-out simulations and fit scores against rounds.", caption, wide=True)]
    if run.truths is not None and len(run.seeds) > 1:
        caption = "How many seeds' credible sets hold their truth; the bands are what chance allows (95 %)."
        svg = truth_coverage_plot(run.series("level_true"))
        parts.append(html.figure(svg, "Share of seeds whose credible sets hold the truth, against rounds.", caption))
    if run.truths is not None and len(run.seeds) >= SEEDS_FOR_RANKS:
        caption = (
            "Simulation-based calibration: ranks of the truth among the draws of the last round, flat if calibrated."
        )
        svg = rank_plot(run.vectors("rank_true")[:, -1], run.names)
        parts.append(html.figure(svg, "Histograms of the truth's rank over seeds.", caption))
    return [html.figures(*parts)]


def _corrected_by(run: OnlineRun) -> str:
    """What the posteriors whose coverage is shown were corrected with."""
    if not run.corrected:
        return ""
    if run.settings.get("history") == 1:
        return ", corrected by those of the other half"
    return "; what corrects it was learned from other sets, all but its width, which is chosen on these"


def _next(run: OnlineRun, alarmed: bool) -> list[tuple[str, str]]:
    begin, out = invocation(run.settings), str(run.facts.get("folder", "RUN"))
    rounds, done = int(run.settings.get("rounds", run.rounds)), run.rounds
    resume = f"{begin} --out {shlex.quote(out)} --resume"

    def anew(flag: str, value: int) -> str:
        """The same run with another number, in a folder of its own."""
        folder = shlex.quote(f"{out}-{flag}{value}")
        return f"bayessim online --config {shlex.quote(f'{out}/config.toml')} --{flag} {value} --out {folder}"

    steps = []
    if done < rounds:
        steps.append(("Finish this run:", resume))
    else:
        steps.append(("Go on for as many rounds again:", f"{resume} --rounds {2 * rounds}"))
    if alarmed:
        more = 2 * int(run.settings.get("simulations", 200))
        steps.append(("Give the estimator more simulations a round:", anew("simulations", more)))
    if len(run.seeds) == 1 and run.truths is not None:
        steps.append(("See the spread over seeds, each with its own truth:", anew("seeds", 8)))
    read = f"xarray.open_datatree({out + '/posterior.nc'!r})['posterior']"
    steps.append(("Use the posterior in Python:", f"import xarray\n{read}"))
    steps.append(("Look at every number as it changed:", f"tensorboard --logdir {shlex.quote(out + '/tensorboard')}"))
    return steps


def _settings(run: OnlineRun) -> str:
    rows: list[tuple[str, str]] = []

    def walk(table: Any, prefix: str) -> None:
        for key, value in table.items():
            if isinstance(value, dict):
                walk(value, f"{prefix}{key}.")
            else:
                rows.append((prefix + str(key), str(value)))

    walk(run.settings, "")
    facts = {k: v for k, v in run.facts.items() if k not in ("truth", "sources")}
    shown = html.table(["setting", "value"], rows)
    rows = []
    walk(facts, "")
    return shown + html.details("Versions, device and times", html.table(["fact", "value"], rows))


def _sentence(text: str) -> str:
    return f"{text[:1].upper()}{text[1:]}."


def _circumstances(run: OnlineRun) -> str:
    s = run.settings
    seeds = f"seeds {run.seeds[0]} to {run.seeds[-1]}" if len(run.seeds) > 1 else f"seed {run.seeds[0]}"
    target = {"gymnasium": "Gymnasium's environment as the target", "simulated": "a simulated target"}
    target["vehicle"] = "a vehicle that slips as the target"
    parts = [target.get(str(s.get("target")), "a real target"), seeds, f"proposal {s.get('proposal', '–')}"]
    parts.append(f"{s.get('simulations', '–')} simulations of {s.get('steps', '–')} steps a round")
    return " · ".join(parts)


def _origin(run: OnlineRun) -> str:
    version = (run.facts.get("versions") or {}).get("bayessim_jax", "")
    sources = run.facts.get("sources") or []
    cite = f" Builds on {'; '.join(sources)}; bayessim --citations prints them as BibTeX." if sources else ""
    return f"Made by bayessim_jax {version}, {run.facts.get('ended') or run.facts.get('started') or ''}.{cite}"
