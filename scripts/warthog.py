"""A real skid-steered vehicle: wheel radius, axial distance and ICR offset, and what they predict.

    python scripts/warthog.py PATH/TO/CASES --out benchmarks/results/warthog.jsonl

The cases `warthog_asphalt` and `warthog_ice` are 60 windows each of 1 to 2 s, from commanded wheel speeds and lidar
poses; `bayessim infer` with seed 0 does the same with either. Every window left out is predicted a second ahead from
its first pose. `wide` are the same cases under a prior that the answer should not run into. The yaw gain is the
posterior mean of r/d over its nominal value, which the authors of the data give for the wheels' measured speeds. With
all of `--runs` in the file of records the cases are not needed.

Source: Baril et al. 2023
"""

from __future__ import annotations

import argparse
import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import numpy as np
from trials import gather, resume

from bayessim_jax.recordings.identification import infer_case
from bayessim_jax.recordings.loading import load_case
from bayessim_jax.recordings.priors import Uniform
from bayessim_jax.recordings.shots import case_model

if TYPE_CHECKING:
    from collections.abc import Callable

    from bayessim_jax.recordings.identification import CaseInference

GROUNDS = ("asphalt", "ice")
PRIORS = ("given", "wide")
WIDE = {"wheel_radius": (0.02, 0.6), "axial_distance": (0.5, 8.0), "icr_offset": (-1.0, 1.0)}
NOMINAL = 0.3 / 1.08
"""r/d of the authors' wheels and track."""
GAINS = {"asphalt": 0.59, "ice": 0.39}
"""Measured yaw rate over the one that the wheels' measured speeds imply, as the authors have it."""


def main() -> None:
    """Infer what is asked for and print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("cases", type=Path, nargs="?", default=Path(), help="folder that holds the two cases")
    parser.add_argument("--runs", type=int, default=3, help="seeds, of the start of the fit and of the draws")
    parser.add_argument("--draws", type=int, default=2000)
    parser.add_argument("--out", type=Path, help="file of JSON lines to append runs to, and to resume from")
    args = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    columns = {}
    for ground in GROUNDS:
        for prior in PRIORS:
            labels = {"ground": ground, "prior": prior, "draws": args.draws}
            trial = make_trial(args.cases / f"warthog_{ground}", prior, args.draws)
            columns[ground, prior] = gather(resume(trial, args.runs, args.out, labels), args.runs, f"{ground} {prior}")
    print(f"posterior mean ± sd of seed 0 of {args.runs}; in brackets the spread of means over seeds" + 20 * " ")
    print(f"| | {' | '.join(f'{g}, prior {p}' for g, p in columns)} |\n|---{'|---' * len(columns)}|")
    for row, show in ROWS.items():
        print(f"| {row} | {' | '.join(show(rows, ground) for (ground, _), rows in columns.items())} |")


def make_trial(folder: Path, prior: str, draws: int) -> Callable[[int], dict[str, Any]]:
    """What one seed gives."""

    def make(seed: int) -> dict[str, Any]:
        loaded = load_case(folder).check()
        if prior == "wide":
            wide = [dataclasses.replace(p, prior=Uniform(*WIDE[p.name])) for p in loaded.parameters]
            loaded = dataclasses.replace(loaded, parameters=type(loaded.parameters)(wide))
        result = infer_case(jax.random.key(seed), case_model(loaded), draws=draws)
        draw = np.asarray(result.posterior.draws)
        found: dict[str, Any] = {"mean": draw.mean(0), "sd": draw.std(0), "at_edge": result.identifiability.at_edge}
        found["windows"] = [len(result.fitted), len(result.held_out)]
        for when, name in (("before", "baseline"), ("after", "posterior")):
            told = result.scores[name].as_table()
            found[f"error_{when}"] = np.array([told["nrmse"], *told["per_channel"].values()])
            found[f"end_{when}"] = _ends(result, name)
        return found

    return make


def _ends(result: CaseInference, name: str) -> np.ndarray:
    """Median over the windows left out of how far off the last prediction is: way in m, heading in rad."""
    held = result.held_out
    rows, last = np.arange(len(held)), held.sensors_measured.all(-1).cumsum(1).argmax(1)
    gap = result.predictions[name][rows, last] - held.sensors[rows, last]
    return np.array([np.median(np.hypot(gap[:, 0], gap[:, 1])), np.median(np.abs(gap[:, 2]))])


def _parameter(index: int, decimals: int) -> Callable[[list[dict[str, Any]], str], str]:
    def show(rows: list[dict[str, Any]], ground: str) -> str:
        means = [row["mean"][index] for row in rows]
        shown = f"{means[0]:.{decimals}f} ± {rows[0]['sd'][index]:.{decimals}f} ({np.ptp(means):.{decimals}f})"
        return shown.replace("-", "−")

    return show


def _error(key: str) -> Callable[[list[dict[str, Any]], str], str]:
    def show(rows: list[dict[str, Any]], ground: str) -> str:
        mean, x, y, yaw = rows[0][key]
        return f"{mean:.2f} ({x:.2f}, {y:.2f}, {yaw:.2f})"

    return show


def _end(key: str) -> Callable[[list[dict[str, Any]], str], str]:
    return lambda rows, ground: "{:.2f} m, {:.2f} rad".format(*rows[0][key])


def _gain(rows: list[dict[str, Any]], ground: str) -> str:
    return f"{rows[0]['mean'][0] / rows[0]['mean'][1] / NOMINAL:.2f} (theirs {GAINS[ground]:.2f})"


ROWS: dict[str, Callable[[list[dict[str, Any]], str], str]] = {
    "wheel radius, m": _parameter(0, 4),
    "axial distance, m": _parameter(1, 3),
    "ICR offset, m": _parameter(2, 3),
    "yaw gain": _gain,
    "error before, at the mean of the prior: mean (x, y, yaw)": _error("error_before"),
    "error after": _error("error_after"),
    "median error a second ahead, before": _end("end_before"),
    "median error a second ahead, after": _end("end_after"),
}


if __name__ == "__main__":
    main()
