"""What was learned and whether to believe it, in sentences."""

from __future__ import annotations

import math
import shlex
from pathlib import PurePath
from typing import TYPE_CHECKING, Any

import numpy as np

from bayessim_jax.inference.strangeness import STRANGE
from bayessim_jax.report.evidence import OnlineRun

if TYPE_CHECKING:
    from collections.abc import Mapping

__all__ = ["collapses", "headline", "invocation", "number", "plus_minus", "title", "worries"]


def number(value: float | np.floating, digits: int = 3) -> str:
    """A number to so many significant digits, without an exponent where that is short; a dash where there is none."""
    if not math.isfinite(value):
        return "–"
    if value == 0 or 1e-4 <= abs(value) < 1e5:
        decimals = max(0, digits - 1 - math.floor(math.log10(abs(value)))) if value else 0
        return f"{value:.{decimals}f}".replace("-", "−")
    return f"{value:.{digits - 1}e}".replace("-", "−")


def plus_minus(mean: float, sd: float, unit: str = "") -> str:
    """`0.412 ± 0.006 m`: the deviation to two significant digits, the mean to the same place."""
    tail = f" {unit}" if unit else ""
    if not (math.isfinite(mean) and math.isfinite(sd) and sd > 0):
        return number(mean) + tail
    decimals = min(max(0, 1 - math.floor(math.log10(sd))), 12)
    return f"{mean:.{decimals}f} ± {sd:.{decimals}f}{tail}".replace("-", "−")


def title(settings: Mapping[str, Any]) -> str:
    """What the run is called."""
    source = settings.get("diagnosis")
    on = f"the simulator of {PurePath(source).name}" if source else settings.get("system", "a system")
    return f"Online BayesSim on {on}"


def invocation(settings: Mapping[str, Any]) -> str:
    """The command that starts such a run, without its options."""
    source = settings.get("diagnosis")
    return f"bayessim online {f'--from {shlex.quote(source)}' if source else settings.get('system')}"


def headline(run: OnlineRun) -> str:
    """The first sentences of the report."""
    start = f"After {_count(run.rounds, 'round')}"
    learned = _single(run) if len(run.seeds) == 1 else _several(run)
    if not run.inferred:
        seeds = f" and {len(run.seeds)} seeds" if len(run.seeds) > 1 else ""
        learned = f"of domain randomization over {_join(list(run.names))}{seeds} nothing was inferred"
    returns = run.series("return_target")
    if not np.isfinite(returns).any():
        return f"{start} {learned}."
    first, last = np.nanmean(returns[:, 0]), np.nanmean(returns[:, -1])
    change = f", from {number(first)} after the first round" if run.rounds > 1 else ""
    return f"{start} {learned}. The policy's return on the target is {number(last)}{change}."


def _single(run: OnlineRun) -> str:
    mean, sd = run.vectors("mean")[0, -1], run.vectors("sd")[0, -1]
    parts = []
    for i, (name, unit) in enumerate(zip(run.names, run.units, strict=True)):
        true = ""
        if run.truths is not None:
            decimals = min(max(0, 1 - math.floor(math.log10(sd[i]))), 12) if sd[i] > 0 else 3
            seems = "" if run.apparent is None else f", apparent {run.apparent[0, -1, i]:.{decimals}f}"
            true = f" (true {run.truths[0, i]:.{decimals}f}{seems})".replace("-", "−")
        parts.append(f"{name} is {plus_minus(mean[i], sd[i], unit)}{true}")
    return _join(parts)


def _several(run: OnlineRun) -> str:
    seeds = f"and {len(run.seeds)} seeds"
    if run.truths is None:
        spread = run.vectors("mean")[:, -1]
        pairs = zip(run.names, run.units, spread.mean(0), spread.std(0), strict=True)
        return f"{seeds} " + _join([f"{n} is {plus_minus(m, s, u)} over the seeds" for n, u, m, s in pairs])
    aim = run.truths if run.apparent is None else run.apparent[:, -1]
    error = np.median(np.abs(run.vectors("mean")[:, -1] - aim), axis=0)
    pairs = zip(run.names, run.units, error, strict=True)
    parts = [f"{name} by {number(e, 2)}{' ' + unit if unit else ''}" for name, unit, e in pairs]
    if run.apparent is not None:
        return f"{seeds} the posterior mean misses what the vehicle seems to have (median) {_join(parts)}"
    log_prob, gain = run.series("log_prob_true")[:, -1], run.series("gain_over_prior")[:, -1]
    own = ", each with its own truth," if len(np.unique(run.truths, axis=0)) > 1 else ""
    side = "above" if np.mean(gain) >= 0 else "below"
    return (
        f"{seeds}{own} the posterior mean misses (median) {_join(parts)}; log q(θ*) is "
        f"{number(float(np.mean(log_prob)))} on average, {number(abs(float(np.mean(gain))))} {side} the prior"
    )


def worries(run: OnlineRun) -> list[str]:
    """Reasons for distrust, the worst first; empty where none was found."""
    several = len(run.seeds) > 1
    found = []
    inferred = np.flatnonzero(np.isfinite(run.series("log_q_validation")).any(0))
    at = lambda name: run.series(name)[:, inferred[-1:]]  # noqa: E731
    wanted = int(run.settings.get("rounds", run.rounds))
    if run.rounds < wanted:
        found.append(f"The run stopped after {_count(run.rounds, 'round')} of {wanted}.")
    fallen = int((at("prior_share") >= 0.999).sum())
    if fallen:
        found.append(f"The last fit gave no usable posterior{_in(fallen, several)}, so the prior stands.")
    strange = at("strangeness")
    if (n := int((strange > STRANGE).sum())) > 0:
        found.append(
            f"What the target showed is unlike what is simulated{_in(n, several)}: it lies "
            f"{number(float(np.nanmax(strange)), 2)} standard deviations farther out than simulated recordings do. "
            "Something is missing in the simulator, or the belief has lost the truth; what the simulator lacks is read "
            "as parameters, so do not trust the posterior."
        )
    if not run.corrected and (told := collapses(run)):
        found.append(f"{told} Nothing widens it under the paper's proposals; more simulations a round make it better.")
    if (n := int(np.nansum(at("overconfident")))) > 0:
        share = float(np.nanmin(at("coverage90")))  # of the last round that inferred, as everything here
        found.append(
            f"The posterior is over-confident{_in(n, several)}: only {share:.0%} of the held-out simulated sets lie "
            "inside their 90 % credible set, recalibration included."
        )
    if (n := int(np.nansum(at("overfit")))) > 0:
        found.append(
            f"The last fit over-fitted after its best epoch{_in(n, several)}; the weights of that epoch were kept."
        )
    found += _against_truth(run, several) if inferred.size else []
    counted = {
        "diverged_target": ("recording", "of the target held numbers that are not finite and took part in nothing."),
        "diverged": ("simulation", "gave numbers that are not finite and took part in nothing."),
        "masked": ("step", "of the learner's simulations gave numbers that are not finite and were left out."),
        "nonfinite": ("update", "of the networks had a loss that is not finite and were skipped."),
    }
    for name, (noun, what) in counted.items():
        if (n := int(np.nansum(run.series(name)))) > 0:
            found.append(f"{_count(n, noun)} {what}")
    return found


def collapses(run: OnlineRun) -> str:
    """In how many rounds the posterior of the networks alone collapsed; empty where it did not."""
    collapsed = int((np.nan_to_num(run.series("collapsed")) > 0).any(0).sum())
    if not collapsed:
        return ""
    share = float(np.nanmin(run.series("coverage90_network")))
    return (
        f"The posterior of the networks alone collapsed in {_count(collapsed, 'round')}: down to {share:.0%} of the "
        "simulated sets lay inside its 90 % credible set, fewer than if it stated half of its errors."
    )


def _against_truth(run: OnlineRun, several: bool) -> list[str]:
    if run.truths is None or run.apparent is not None:  # a vehicle that slips is not expected to look as it is
        return []
    level, gain = run.series("level_true")[:, -1], run.series("gain_over_prior")[:, -1]
    if several:
        inside, n = int((level <= 0.9).sum()), len(level)
        if inside / n < 0.9 - 2 * math.sqrt(0.09 / n):
            return [f"Only {inside} of {n} 90 % credible sets hold the truth: the posteriors are over-confident."]
        return []
    found = []
    if not gain[0] > 0:
        found.append("The posterior gives the truth a lower density than the prior did: it is confidently wrong.")
    elif level[0] > 0.99:
        found.append("The truth lies outside the 99 % credible set: the posterior is probably over-confident.")
    return found


def _in(n: int, several: bool) -> str:
    return f" for {_count(n, 'seed')}" if several else ""


def _count(n: int, noun: str) -> str:
    return f"{n} {noun}{'' if n == 1 else 's'}"


def _join(parts: list[str]) -> str:
    return parts[0] if len(parts) == 1 else ", ".join(parts[:-1]) + " and " + parts[-1]
