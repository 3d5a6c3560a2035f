"""The report of `bayessim infer`: what was learned of the parameters, and how the simulator predicts with it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from bayessim_jax.recordings.identification import CaseInference
from bayessim_jax.report import html
from bayessim_jax.report.pairs import pair_plot
from bayessim_jax.report.replay import replay_animation
from bayessim_jax.report.residuals import residual_plot
from bayessim_jax.report.style import BLUE, ORANGE
from bayessim_jax.report.timelines import channel_labels, window_traces
from bayessim_jax.report.viewer import SCRIPT_HASH, script
from bayessim_jax.report.words import number, plus_minus

__all__ = ["headline", "render", "replay_figure", "trace_figure"]


def headline(result: CaseInference) -> str:
    """The first sentence: each parameter, and what the fit did to predictions of held-out windows."""
    draws, margins = np.asarray(result.posterior.draws), result.model.margins
    parts = [
        f"{name} is {plus_minus(draws[:, k].mean(), draws[:, k].std(), margins.units[k])}"
        for k, name in enumerate(margins.names)
    ]
    before, after = result.scores["baseline"].nrmse, result.scores["posterior"].nrmse
    horizon = result.model.case.case.horizon
    change = f"predictions {horizon:g} s ahead miss by {number(100 * after)} % of a channel's spread"
    return f"{', '.join(parts)}; {change}, {number(100 * before)} % before the fit."


def worries(result: CaseInference) -> list[str]:
    """What stands in the way of believing it."""
    found = []
    identifiability, fit = result.identifiability, result.posterior.fit
    for name in identifiability.not_informed:
        found.append(f"The recordings say nothing of {name}: its posterior is as wide as its prior.")
    for first, second, correlation in identifiability.ridges:
        found.append(
            f"{first} and {second} trade off (correlation {number(correlation)}): the recordings fix a combination of "
            "the two, not each."
        )
    for name in identifiability.at_edge:
        found.append(f"{name} lies at the edge of its prior: widen it, or something is missing in the simulator.")
    after, floor = result.scores["posterior"].nrmse, result.noise_floor
    if not bool(fit.converged):
        found.append("The fit did not converge: the optimum may lie elsewhere.")
    found.extend(result.posterior.doubts)
    if lost := result.scores["posterior"].diverged:
        found.append(f"{lost} held-out windows diverged in simulation; they are in no average.")
    if np.isfinite(floor) and after > 2 * floor:
        found.append(
            f"Predictions miss by {number(after / floor)} times what noise allows: something is missing in the "
            "simulator, and the parameters may have been bent to make up for it; see bayessim diagnose."
        )
    return found


def render(result: CaseInference, facts: Mapping[str, Any]) -> str:
    """The page."""
    case = result.model.case
    worried = worries(result)
    notices = [html.notice(w) for w in worried] or [
        html.notice("Every parameter is informed by the recordings, and the fit converged.", good=True)
    ]
    out = str(facts.get("folder", "RUN"))
    body = [
        f"<h1>{html.escape(case.case.name)}</h1>",
        f'<p class="lead">{html.escape(headline(result))}</p>',
        *notices,
        html.section("Parameters", _pairs(result), _parameters(result)),
        html.section("Recording against prediction", trace_figure(result), _scores(result)),
        *([html.section("Replay", replay_figure(result))] if case.model is not None else []),
        html.section("What the predictions miss", html.figure(*_residuals(result), wide=True)),
        html.section(
            "What to do next",
            html.commands(
                [
                    ("See whether physics is missing in the simulator:", f"bayessim diagnose {case.case.folder}"),
                    (
                        "Draw models for domain randomization:",
                        "from bayessim_jax.recordings.results import sample_models\n"
                        f"models = sample_models({out!r}, 100)",
                    ),
                    (
                        "Use the posterior:",
                        f"import xarray\nxarray.open_datatree({out + '/posterior.nc'!r})['posterior']",
                    ),
                ]
            ),
        ),
        html.section("Settings", _settings(result, facts)),
    ]
    title = f"{case.case.name}: parameters"
    return html.page(title, "\n".join(body), script=script(), script_hash=SCRIPT_HASH)


def _pairs(result: CaseInference) -> str:
    draws, margins = np.asarray(result.posterior.draws), result.model.margins
    low, high = _limits(result)
    marks = "Blue: posterior, with 50 %, 90 % and 99 % credible sets; dashed: the prior's bounds."
    common = (margins.names, margins.units, low, high, None)
    figures = [
        html.figure(pair_plot(draws, *common, "pairs"), "Pair plot of the posterior.", f"The whole prior. {marks}"),
        html.figure(
            pair_plot(draws, *common, "magnified", magnify=True),
            "Pair plot of the posterior, magnified.",
            "Magnified to where the posterior lies.",
        ),
    ]
    return html.figures(*figures, least="24rem" if len(margins.names) <= 2 else "34rem")


def _limits(result: CaseInference) -> tuple[np.ndarray, np.ndarray]:
    low = np.array([p.prior.low for p in result.model.case.parameters])
    high = np.array([p.prior.high for p in result.model.case.parameters])
    middle = np.array([p.prior.mean for p in result.model.case.parameters])
    reach = 4 * np.array([p.prior.sd for p in result.model.case.parameters])
    return np.maximum(low, middle - reach), np.minimum(high, middle + reach)


def _parameters(result: CaseInference) -> str:
    rows = []
    for name, entry in result.table()["parameters"].items():
        interval = f"{number(entry['q05'], 4)} to {number(entry['q95'], 4)}"
        learned = result.identifiability.contraction[name]
        rows.append(
            [name, entry["unit"], entry["prior"], plus_minus(entry["mean"], entry["sd"]), interval, f"{learned:.2f}"]
        )
    return html.table(["parameter", "unit", "prior", "posterior", "5 % to 95 %", "learned (0 to 1)"], rows)


def _scores(result: CaseInference) -> str:
    before, after = result.scores["baseline"], result.scores["posterior"]
    rows = [
        [channel, number(before.per_channel[channel]), number(after.per_channel[channel])]
        for channel in after.per_channel
    ]
    rows.append(["mean", number(before.nrmse), number(after.nrmse)])
    rows.append(["log score", number(before.log_score), number(after.log_score)])
    rows.append(["noise allows", "", number(result.noise_floor)])
    return html.table(["error over the channel's spread", "prior's mean", "posterior's mean"], rows)


def trace_figure(result: CaseInference) -> str:
    """The held-out windows of each recording, with predictions before and after."""
    shots = result.model.shots(result.held_out)
    low, high = np.quantile(result.band, [0.05, 0.95], axis=0)
    measured = np.where(np.asarray(shots.measured), np.asarray(shots.y), np.nan)
    values = {**result.predictions, "low": low, "high": high, "measured": measured}
    series = [
        {"key": "low", "upper": "high", "label": "posterior, 5 % to 95 %", "colour": BLUE},
        {"key": "baseline", "label": "before: the prior's mean", "colour": ORANGE, "scale": True},
        {"key": "posterior", "label": "after: the posterior's mean", "colour": BLUE, "scale": True},
        {"key": "measured", "label": "recording", "dots": True, "scale": True},
    ]
    caption = (
        f"Predictions restart from the recording every {result.model.case.case.horizon:g} s; none of these rows took "
        "part in the fit. The wheel zooms in time, dragging moves, a double click shows everything."
    )
    windows = result.held_out
    return window_traces(result.model, windows, np.arange(len(windows)), values, series, caption)


def replay_figure(result: CaseInference) -> str:
    """The model moving as recorded, and its two ghosts."""
    ghosts = [("before", ORANGE, result.predictions["baseline"]), ("after", BLUE, result.predictions["posterior"])]
    return replay_animation(result.model, result.held_out, ghosts, "before and after the fit")


def _residuals(result: CaseInference) -> tuple[str, str, str]:
    shots = result.model.shots(result.held_out)
    measured = np.asarray(shots.measured)
    y = np.asarray(shots.y)
    errors = {name: np.where(measured, y - p, np.nan) for name, p in result.predictions.items()}
    time = result.held_out.time
    svg = residual_plot(time, y, errors, channel_labels(result.model), np.asarray(result.posterior.fit.sigma))
    caption = (
        "Left: root mean square error against the time since a prediction started; the dotted line is the estimated "
        "noise. Right: errors after the fit against the measured value, with their median."
    )
    return svg, "Residuals against lead time and against the state.", caption


def _trust(result: CaseInference) -> list[list[str]]:
    """What the way in which the posterior was drawn says of itself."""
    rows, coverage = [], result.posterior.coverage
    if result.posterior.efficiency is not None:
        rows.append(["effective share of Laplace's draws", number(result.posterior.efficiency)])
    if coverage is not None:
        held = f"{100 * coverage.half:.0f} % and {100 * coverage.most:.0f} % of {coverage.sets}"
        rows.append(["truths in the 50 % and 90 % sets of simulated recordings", held])
    return rows


def _settings(result: CaseInference, facts: Mapping[str, Any]) -> str:
    noise = [
        [c, number(s, 4)] for c, s in zip(result.model.channels, np.asarray(result.posterior.fit.sigma), strict=True)
    ]
    rows = [
        ["sampler", result.posterior.sampler],
        *_trust(result),
        ["windows fitted, held out", f"{len(result.fitted)}, {len(result.held_out)}"],
        ["held out", ", ".join(result.held_out_names)],
        *[[str(k), str(v)] for k, v in facts.items() if isinstance(v, (str, int, float))],
    ]
    return (
        html.table(["setting", "value"], rows)
        + html.details("Estimated noise", html.table(["channel", "standard deviation"], noise))
        + html.findings(facts.get("findings", []))
    )
