"""The report of `bayessim diagnose`: is physics missing, where, which, and what the simulator predicts with it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from bayessim_jax.diagnosis.verdict import Thresholds, share_left
from bayessim_jax.recordings.diagnosing import CaseDiagnosis
from bayessim_jax.recordings.experiments import advise
from bayessim_jax.recordings.shots import take
from bayessim_jax.report import html
from bayessim_jax.report.laws import laws_plot, state_plot
from bayessim_jax.report.misfit import candidates_plot, misfit_map
from bayessim_jax.report.replay import replay_animation
from bayessim_jax.report.residuals import residual_plot
from bayessim_jax.report.style import BLUE, ORANGE, PURPLE
from bayessim_jax.report.timelines import channel_labels, window_traces
from bayessim_jax.report.viewer import SCRIPT_HASH, script
from bayessim_jax.report.words import number, plus_minus

__all__ = ["headline", "render"]

BENT, SLIGHTLY, MUCH = 2.0, 1.0, 0.05
"""Standard deviations by which a parameter differs between simulators, from which it is told; the same where it
differs by a share of itself, and that share."""


def headline(diagnosis: CaseDiagnosis) -> str:
    """The first sentence: the verdict, and what it does to predictions."""
    result, table = diagnosis.result, diagnosis.table()
    before, after = diagnosis.scores["baseline"].nrmse, diagnosis.scores["augmented"].nrmse
    horizon = diagnosis.model.case.case.horizon
    where = ", ".join(place.at for place in diagnosis.locations[:2])
    held = f"on held-out recordings predictions {horizon:g} s ahead"
    if result.verdict == "no_mismatch" and result.entries:
        shift = number(1e3 * diagnosis.bench.largest_shift)
        return (
            "Nothing is missing: what the simulator leaves is what its own time step does, which moves things in time "
            f"by less than {shift} ms; {held} miss by {number(100 * before)} % of a channel's spread, and by less with "
            "a shorter time step."
        )
    if result.verdict == "no_mismatch":
        p = result.baseline.misfit.p_value
        return (
            f"Nothing is missing: the simulator explains the recordings to within their noise (p = {number(p, 2)}); "
            f"{held} miss by {number(100 * before)} % of a channel's spread."
        )
    if result.verdict == "unexplained":
        if result.sooner is not None:
            return (
                "Commands seem to be recorded a row too late: with each of them a row earlier the simulator explains "
                f"the recordings to within their noise (p = {number(result.sooner, 2)}); as they are no candidate does."
            )
        sentence = f"Something is missing at {where or 'no single joint'}, and none of the candidates explains it."
        if result.entries:
            best, floor = result.best, number(100 * diagnosis.noise_floor)
            left = number(100 * share_left(best.misfit, result.baseline.misfit))
            sentence += f" The closest, {best.title}, leaves {left} % of the misfit"
            if not result.taken_back:
                return f"{sentence}."
            sentence += (
                f", but does not hold on recordings left out: predictions {horizon:g} s ahead miss there by "
                f"{number(100 * after)} % of a channel's spread, where noise allows {floor} %"
            )
            free = diagnosis.scores.get("flexible")
            sentence += f" and a force without a name reaches {number(100 * free.nrmse)} %." if free else "."
        return sentence
    change = f"{held} miss by {number(100 * after)} % of a channel's spread instead of {number(100 * before)} %"
    if result.verdict == "ambiguous":
        sets = " or ".join(entry.title for entry in result.confusion)
        return f"Missing is {sets}; these recordings cannot tell which. With the first, {change}."
    parts = []
    for effect in table["effects"]:
        values = ", ".join(
            f"{name} {plus_minus(p['mean'], p['sd'], p['unit'])}" for name, p in effect["parameters"].items()
        )
        parts.append(f"{effect['effect']} at {effect['at']} ({values})")
    left = share_left(result.best.misfit, result.baseline.misfit)
    rest = f" Short pieces show {number(100 * left)} % of the misfit still, which no candidate explains."
    return f"Missing is {' and '.join(parts)}: {change}.{rest if left > Thresholds().left else ''}"


def render(diagnosis: CaseDiagnosis, facts: Mapping[str, Any]) -> str:
    """The page."""
    case, result, table = diagnosis.model.case, diagnosis.result, diagnosis.table()
    out = str(facts.get("folder", "RUN"))
    notices = []
    if result.verdict == "no_mismatch" and not result.entries:
        notices.append(html.notice("The residuals are as white as noise leaves them.", good=True))
    if result.confusion and len(result.best.told) < len(result.best.candidate.effects):
        notices.append(
            html.notice(
                "Fitted with it is a shift in time that is shorter than the simulator's time step: its integrator's, "
                "not the machine's. A shorter step has less of it."
            )
        )
    advice = advise(result, diagnosis.experiment)
    if advice:
        notices.append(html.notice(f"Next experiment: {advice}."))
    body = [
        f"<h1>{html.escape(case.case.name)}</h1>",
        f'<p class="lead">{html.escape(headline(diagnosis))}</p>',
        *notices,
        _absorbed(diagnosis, table),
        html.section("Recording against prediction", _traces(diagnosis), _scores(diagnosis)),
    ]
    if diagnosis.locations:
        maps = [_map(diagnosis), *([_states(diagnosis)] if diagnosis.forces else [])]
        body.append(
            html.section("Where it sits", _places(diagnosis), *(html.figure(*each, wide=True) for each in maps))
        )
    if result.entries:
        plot = html.figure(*_candidates(diagnosis), wide=True)
        body.append(html.section("What was tried", plot, _entries(diagnosis, table)))
    if result.names_something and (curves := laws_plot(diagnosis)):
        caption = (
            "The laws that were found, from 5 % to 95 % of what is believed of their numbers, as far as was recorded; "
            "friction that grows with the load is shown at half of what usually drives the joint."
        )
        body.append(html.section("What it does", html.figure(curves, "The effects as curves.", caption, wide=True)))
    if case.model is not None and diagnosis.model.case.layout.single:
        body.append(html.section("Replay", _replay(diagnosis)))
    body += [
        html.section("What the predictions miss", html.figure(*_residuals(diagnosis), wide=True)),
        html.section("Parameters", *_bent(diagnosis, table), _parameters(table)),
        html.section(
            "What to do next",
            html.commands(
                [
                    (
                        "Score both simulators on other recordings:",
                        f"bayessim evaluate {out} --recordings 'more/*.csv'",
                    ),
                    ("Read what was found:", f"import json\njson.load(open({out + '/diagnosis.json'!r}))"),
                ]
            ),
        ),
        html.section("Settings", _settings(diagnosis, facts)),
    ]
    title = f"{case.case.name}: {result.verdict}"
    return html.page(title, "\n".join(body), script=script(), script_hash=SCRIPT_HASH)


def _absorbed(diagnosis: CaseDiagnosis, table: Mapping[str, Any]) -> str:
    """What is not there to be found; empty where nothing is known to be."""
    names = table["absorbed"]
    if not names:
        return ""
    unknowns = ", ".join(diagnosis.model.margins.names)
    text = f"Not there to be found, because other values of {unknowns} would do the same: {', '.join(names)}."
    return f"<p>{html.escape(text)}</p>"


def _series(diagnosis: CaseDiagnosis) -> list[dict[str, Any]]:
    series = [{"key": "baseline", "label": "the simulator, fitted", "colour": ORANGE, "scale": True}]
    if "flexible" in diagnosis.predictions:
        series.append({"key": "flexible", "label": "with a force without a name", "colour": PURPLE, "width": 1.0})
    if diagnosis.result.names_something:
        series.append({"key": "augmented", "label": "with what was found", "colour": BLUE, "scale": True})
    return [*series, {"key": "measured", "label": "recording", "dots": True, "scale": True}]


def _traces(diagnosis: CaseDiagnosis) -> str:
    shots = diagnosis.shots
    values = {**diagnosis.predictions, "measured": np.where(np.asarray(shots.measured), np.asarray(shots.y), np.nan)}
    caption = (
        f"Held-out recordings; predictions restart from them every {diagnosis.model.case.case.horizon:g} s. The wheel "
        "zooms in time, dragging moves, a double click shows everything."
    )
    held = np.flatnonzero(~diagnosis.chosen)
    return window_traces(diagnosis.model, diagnosis.windows, held, values, _series(diagnosis), caption)


def _scores(diagnosis: CaseDiagnosis) -> str:
    shown = ["baseline", *(["augmented"] if diagnosis.result.names_something else [])]
    shown += ["flexible"] if "flexible" in diagnosis.scores else []
    labels = {"baseline": "the simulator, fitted", "augmented": "with what was found", "flexible": "flexible force"}
    rows = [
        [c, *(number(diagnosis.scores[s].per_channel[c]) for s in shown)]
        for c in diagnosis.scores["baseline"].per_channel
    ]
    rows.append(["mean", *(number(diagnosis.scores[s].nrmse) for s in shown)])
    rows.append(["log score", *(number(diagnosis.scores[s].log_score) for s in shown)])
    rows.append(["noise allows", *([""] * (len(shown) - 1)), number(diagnosis.noise_floor)])
    return html.table(["error over the channel's spread", *(labels[s] for s in shown)], rows)


def _places(diagnosis: CaseDiagnosis) -> str:
    rows = []
    for place in diagnosis.locations:
        when = "; ".join(f"{name} {number(a)} to {number(b)} s" for name, a, b in place.windows[:2])
        rows.append([place.at, f"{100 * place.share:.0f} %", place.regime, when])
    return html.table(["place", "share", "where in the state it is strong", "when, most of it first"], rows)


def _map(diagnosis: CaseDiagnosis) -> tuple[str, str, str]:
    names = [diagnosis.model.recordings[i].name for i in diagnosis.pieces.recording]
    before, after = (entry.misfit.excess for entry in (diagnosis.result.baseline, diagnosis.result.best))
    svg = misfit_map(before, after, names, diagnosis.model.channels)
    caption = (
        "Slow power in the residuals of every window above what noise leaves, a row for each channel: of the simulator "
        "as it is (above), and with the best candidate (below)."
    )
    return svg, "Map of the misfit over windows and channels.", caption


def _states(diagnosis: CaseDiagnosis) -> tuple[str, str, str]:
    scales = diagnosis.bench.scales
    svg = state_plot(
        diagnosis.forces, {place: (scales[place].unit, scales[place].force_unit) for place in diagnosis.forces}
    )
    caption = "Mean size of the force without a name over the states that were recorded: where in them something acts."
    return svg, "Map of the force without a name over position and velocity.", caption


def _replay(diagnosis: CaseDiagnosis) -> str:
    """The model moving as recorded, and its ghosts."""
    held = ~diagnosis.chosen
    ghosts = [("as it is", ORANGE, diagnosis.predictions["baseline"][held])]
    if diagnosis.result.names_something:
        ghosts.append(("with what was found", BLUE, diagnosis.predictions["augmented"][held]))
    return replay_animation(diagnosis.model, take(diagnosis.windows, held), ghosts, "by the simulators")


def _bent(diagnosis: CaseDiagnosis, table: Mapping[str, Any]) -> list[str]:
    """A warning for every parameter that took the place of what was missing.

    Much is told of, too, where a simulator that is wrong knows itself that it does not know: its sd is wide then.
    """
    if not diagnosis.result.names_something:
        return []
    found = []
    for name, entry in table["parameters"].items():
        before, after = entry["baseline"], entry["augmented"]
        apart, sd = abs(before["mean"] - after["mean"]), np.hypot(before["sd"], after["sd"])
        if apart > BENT * sd or (apart > SLIGHTLY * sd and apart > MUCH * abs(after["mean"])):
            off = f"{number(100 * apart / abs(after['mean']), 2)} % " if after["mean"] else ""
            found.append(
                html.notice(f"Without what was found, {name} came out {off}off: it had taken part of its place.")
            )
    return found


def _candidates(diagnosis: CaseDiagnosis) -> tuple[str, str, str]:
    named = {name for entry in diagnosis.result.confusion for name in entry.names}
    caption = "What each gains by itself in log likelihood on the windows that choose; what is named stands out."
    return candidates_plot(diagnosis.result.screened, named), "Gain of every candidate.", caption


def _entries(diagnosis: CaseDiagnosis, table: Mapping[str, Any]) -> str:
    rows = []
    for title, entry in zip((e.title for e in diagnosis.result.entries), table["finalists"], strict=True):
        shares = (entry["misfit_left"], entry["error_ahead_left"])
        rows.append(
            [
                title,
                f"{number(entry['gain'], 4)} ± {number(entry['gain_se'], 2)}",
                f"{number(entry['behind'], 3)} ± {number(entry['behind_se'], 2)}" if entry["behind_se"] else "",
                *(f"{number(100 * share, 2)} %" if np.isfinite(share) else "" for share in shares),
                "" if entry["probability"] is None else number(entry["probability"], 2),
            ]
        )
    heads = ["finalist", "gain on recordings left out", "behind the best", "misfit left", "error ahead left", "named"]
    return html.table(heads, rows)


def _residuals(diagnosis: CaseDiagnosis) -> tuple[str, str, str]:
    held = ~diagnosis.chosen
    y, measured = np.asarray(diagnosis.shots.y)[held], np.asarray(diagnosis.shots.measured)[held]
    shown = ["baseline", *(["augmented"] if diagnosis.result.names_something else [])]
    errors = {name: np.where(measured, y - diagnosis.predictions[name][held], np.nan) for name in shown}
    noise = diagnosis.result.best.misfit.noise
    svg = residual_plot(diagnosis.windows.time[held], y, errors, channel_labels(diagnosis.model), noise)
    caption = (
        "Left: root mean square error against the time since a prediction started; dotted: the noise. Right: errors of "
        "the last of them against the measured value, with their median."
    )
    return svg, "Residuals against lead time and against the state.", caption


def _parameters(table: Mapping[str, Any]) -> str:
    rows = []
    for name, entry in table["parameters"].items():
        before, after = entry["baseline"], entry["augmented"]
        shown = [plus_minus(before["mean"], before["sd"]), plus_minus(after["mean"], after["sd"])]
        rows.append([name, entry["unit"], *shown])
    for effect in table["effects"]:
        for name, p in effect["parameters"].items():
            rows.append([f"{effect['effect']}, {name}", p["unit"], "", plus_minus(p["mean"], p["sd"])])
    return html.table(["parameter", "unit", "the simulator as it is", "with what was found"], rows)


def _settings(diagnosis: CaseDiagnosis, facts: Mapping[str, Any]) -> str:
    rows = [
        ["candidates", str(len(diagnosis.bench.pairs))],
        ["windows that choose, that judge", f"{int(diagnosis.chosen.sum())}, {int((~diagnosis.chosen).sum())}"],
        ["held out", ", ".join(diagnosis.held_out)],
        ["p-value of no mismatch", number(diagnosis.result.baseline.misfit.p_value)],
        *[[str(k), str(v)] for k, v in facts.items() if isinstance(v, (str, int, float))],
    ]
    noise = zip(diagnosis.model.channels, diagnosis.result.best.misfit.noise, strict=True)
    return (
        html.table(["setting", "value"], rows)
        + html.details(
            "Estimated noise", html.table(["channel", "standard deviation"], [[c, number(s, 4)] for c, s in noise])
        )
        + html.findings(facts.get("findings", []))
    )
