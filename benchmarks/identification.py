"""Posteriors of simulated machines with nothing concealed in them, against the estimate of `mujoco.sysid`."""

from __future__ import annotations

import json
import math
from functools import partial
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from benchmarks.compilation import fresh_cache, make_room, watch_compilation
from benchmarks.concealed import read_rows, resumed
from benchmarks.peers import require_peers
from benchmarks.timing import stopwatch

if TYPE_CHECKING:
    from argparse import Namespace
    from collections.abc import Callable
    from pathlib import Path

__all__ = ["MODELS", "compare_methods", "draw_clean", "identify_clean", "ranks", "summarize"]

MODELS = ("pendulum", "slide", "double", "cart", "arm3")
NOISE = 1.0
"""Times 1e-3 rad or 2e-4 m on positions, and ten times as much for a second on velocities."""

PROGRAMS = ("none", "on disk", "here")
"""What was compiled before: nothing for a machine's first case, programs in the persistent cache for its second, as for
a command that is given again, and programs in the same process for the others."""


def draw_clean(rigs: list[str], count: int, seed: int, finer: int = 1) -> list[dict[str, Any]]:
    """Cases without an effect, the machines in turn, their time step `finer` times shorter; θ* comes from the seed."""
    same = {"group": "clean", "effects": [], "strength": 0.0, "noise": NOISE}
    same |= {"velocities": True, "quantize": None, "jitter": 0.0, "finer": finer}
    return [{"rig": rigs[i % len(rigs)], **same, "seed": seed * 100_000 + i} for i in range(count)]


def ranks(draws: np.ndarray, truth: np.ndarray) -> tuple[float, np.ndarray]:
    """Where θ* lies among draws of a posterior, shape (draws, d): the share of them that is nearer to the mean than θ*
    by Mahalanobis' distance, and for each parameter the share below θ*. A calibrated posterior's are uniform.
    """
    off = np.concatenate([draws, truth[None]]) - draws.mean(0)
    weights = np.linalg.inv(np.atleast_2d(np.cov(draws.T)))
    distance = np.einsum("ni,ij,nj->n", off, weights, off)
    return float((distance[:-1] < distance[-1]).mean()), (draws < truth).mean(0)


def identify_clean(options: Namespace) -> None:
    """Infer the cases that are not in the file yet, by one method, and print the table of all.

    The peer estimates beside `direct` alone; with `beside`, a file of another method's records, both are compared.
    """
    jax.config.update("jax_enable_x64", True)
    others = _read(options.beside) if options.beside else []
    if options.out and options.out.exists() and {row["method"] for row in _read(options.out)} - {options.method}:
        raise SystemExit(f"{options.out} holds cases of another method; give another --out.")
    peer: dict[str, Callable[..., Any] | None] = {} if options.method == "direct" else {"identify": None}
    on_disk: set[str] = set()
    here: set[str] = set()

    def make(path: Path, case: dict[str, Any]) -> dict[str, Any]:
        if not peer:
            peer["identify"] = _find_peer()
        rig = case["rig"]
        if rig in here and not on_disk:
            # once, when machines are met for the second time
            jax.clear_caches()
            on_disk.update(here)
            here.clear()
        programs = "here" if rig in here else "on disk" if rig in on_disk else "none"
        here.add(rig)
        return {"method": options.method, "programs": programs, **_infer(path, case, options.method, peer["identify"])}

    rows = []
    with fresh_cache():
        cases = draw_clean(options.rigs or list(MODELS), options.cases, options.seed, options.finer)
        for row in resumed(cases, options.out, make):
            rows.append(row)
            taken = row["peer_seconds"]
            theirs = "" if taken is None else f", the peer's {_error(row, 'peer'):.2g} in {taken:.1f} s"
            print(
                f"{row['case']['rig']:<10} {row['rank']:.2f} error {_error(row, 'mean'):.2g} of the prior's sd in "
                f"{row['ours_seconds']:.1f} s, {row['compile_seconds']:.1f} s of it compiling{theirs}",
                flush=True,
            )
    print("\n" + summarize(rows) + "\n\n" + compare_seconds(rows))
    if others:
        print("\n" + compare_methods(rows, others))


def _read(path: Path) -> list[dict[str, Any]]:
    """Records of cases; those that name no method are of the direct one."""
    return [{"method": "direct", **row} for row in read_rows(path)]


def _find_peer() -> Callable[..., Any] | None:
    """The peer's estimator; None, and a line that says so, where what it needs is not installed."""
    try:
        require_peers("absl", "colorama", "jinja2", "plotly", "tabulate", "yaml")
    except SystemExit as told:
        print(f"{told} Without it there are no figures of mujoco.sysid.", flush=True)
        return None
    from benchmarks.peers.mujoco_sysid import identify

    return identify


def _infer(path: Path, case: dict[str, Any], method: str, peer: Callable[..., Any] | None) -> dict[str, Any]:
    """The posterior of a case, the peer's estimate on the windows it was fitted to, and the seconds of both."""
    from bayessim_jax.recordings.concealing import SEALED
    from bayessim_jax.recordings.identification import infer_case
    from bayessim_jax.recordings.loading import load_case
    from bayessim_jax.recordings.shots import case_model

    model = case_model(load_case(path).check())
    with watch_compilation() as compilation:
        seconds, found = stopwatch(partial(infer_case, method=method), jax.random.key(case["seed"]), model)
    make_room()
    estimate, peer_seconds = peer(model, found.fitted) if peer else (None, None)
    truths = json.loads((path / SEALED).read_text(encoding="utf-8"))["parameters"]
    draws = np.asarray(found.posterior.draws)
    rank, below = ranks(draws, np.array([truths[p.name] for p in model.case.parameters]))
    parameters = {
        p.name: {
            "truth": _rounded(truths[p.name], 9),
            "mean": _rounded(draws[:, k].mean(), 9),
            "sd": _rounded(draws[:, k].std(), 4),
            "below": _rounded(below[k], 4),
            "prior_sd": _rounded(p.prior.sd, 6),
            "peer": None if estimate is None else _rounded(estimate[k], 9),
        }
        for k, p in enumerate(model.case.parameters)
    }
    return {
        "rank": _rounded(rank, 4),
        "parameters": parameters,
        "windows": len(found.fitted),
        "refined": found.model.refined,
        "sampler": found.posterior.sampler,
        "ours_seconds": round(seconds, 3),
        "compile_seconds": round(compilation.seconds, 3),
        "peer_seconds": None if peer_seconds is None else round(peer_seconds, 3),
    }


def _rounded(value: float, digits: int) -> float:
    return float(f"{value:.{digits}g}")


def _error(row: dict[str, Any], which: str) -> float:
    """Root mean square error of a case's parameters, in standard deviations of their priors."""
    each = [(p[which] - p["truth"]) / p["prior_sd"] for p in row["parameters"].values()]
    return math.sqrt(np.mean(np.square(each)))


HEAD = """\
| machine | cases | joint 50 % | 90 % | numbers | each 50 % | 90 % | error ratio | s | cold | on disk | again | peer |
|---|---|---|---|---|---|---|---|---|---|---|---|---|"""


def summarize(rows: list[dict[str, Any]]) -> str:
    """A line for each machine and one for all.

    How many joint 50 % and 90 % sets hold θ*, and how many central intervals of single parameters; error over the
    peer's: median and quartiles over cases; seconds, medians: without compilation, with it the first time that a
    machine is met, with programs from the persistent cache, with those of the same process, and the peer's.
    """
    rigs = list(dict.fromkeys(row["case"]["rig"] for row in rows))
    lines = [HEAD] + [_line(rig, [row for row in rows if row["case"]["rig"] == rig]) for rig in rigs]
    return "\n".join([*lines, *([_line("all", rows)] if len(rigs) > 1 else [])])


def compare_seconds(rows: list[dict[str, Any]]) -> str:
    """One line: seconds of all cases, compilation included, beside the peer's, and in how many cases they are fewer."""
    both = [row for row in rows if row["peer_seconds"] is not None]
    if not both:
        return ""
    ours, theirs = (sum(row[f"{who}_seconds"] for row in both) for who in ("ours", "peer"))
    fewer = {
        name: [row["ours_seconds"] < row["peer_seconds"] for row in both if row["programs"] == name]
        for name in PROGRAMS
    }
    each = ", ".join(f"{sum(won)} of {len(won)} {name}" for name, won in fewer.items() if won)
    net = sum(row["ours_seconds"] - row["compile_seconds"] < row["peer_seconds"] for row in both)
    return (
        f"{ours:.0f} s in all, {theirs:.0f} s the peer; fewer seconds in {each} (programs compiled before); "
        f"in {net} of {len(both)} without compilation."
    )


METHODS_HEAD = """\
| method | cases | joint 50 % | 90 % | numbers | each 50 % | 90 % | error | sd over {}'s | s | cold | on disk | again |
|---|---|---|---|---|---|---|---|---|---|---|---|---|"""


def compare_methods(rows: list[dict[str, Any]], others: list[dict[str, Any]]) -> str:
    """A line for each of two methods on the cases that both have.

    Errors are medians in standard deviations of the priors; of the posteriors' standard deviations over the other
    method's the median and the quartiles over numbers; the rest is as in `summarize`.
    """
    theirs = {row["case"]["seed"]: row for row in others}
    pairs = [(row, theirs[seed]) for row in rows if (seed := row["case"]["seed"]) in theirs]
    if any(row["case"] != other["case"] for row, other in pairs) or not pairs:
        raise SystemExit("the two files are not of the same cases; choose the same --seed, --rigs and --finer.")
    reference = [other for _, other in pairs]
    lines = [METHODS_HEAD.format(reference[0]["method"])]
    for each in (reference, [row for row, _ in pairs]):
        ratios = [
            p["sd"] / other["parameters"][name]["sd"]
            for row, other in zip(each, reference, strict=True)
            for name, p in row["parameters"].items()
        ]
        low, middle, high = np.quantile(ratios, [0.25, 0.5, 0.75])
        error = f"{np.median([_error(row, 'mean') for row in each]):.2g}"
        width = "1" if each is reference else f"{middle:.2f} ({low:.2f} – {high:.2f})"
        cells = (each[0]["method"], len(each), *_held(each), error, width, *_seconds(each))
        lines.append(f"| {' | '.join(map(str, cells))} |")
    return "\n".join(lines)


def _held(rows: list[dict[str, Any]]) -> tuple[Any, ...]:
    """Joint coverage at 50 and 90 %, how many single parameters there are, and theirs."""
    rank = np.array([row["rank"] for row in rows])
    below = np.array([p["below"] for row in rows for p in row["parameters"].values()])
    joint, each = ([f"{(x <= level).mean():.2f}" for level in (0.5, 0.9)] for x in (rank, 2 * np.abs(below - 0.5)))
    return (*joint, len(below), *each)


def _seconds(rows: list[dict[str, Any]]) -> tuple[str, ...]:
    """Medians: without compilation, and with it for each of `PROGRAMS`."""
    net = np.median([row["ours_seconds"] - row["compile_seconds"] for row in rows])
    spent = [[row["ours_seconds"] for row in rows if row["programs"] == programs] for programs in PROGRAMS]
    return f"{net:.2f}", *(f"{np.median(each):.1f}" if each else "–" for each in spent)


def _line(name: str, rows: list[dict[str, Any]]) -> str:
    both = [row for row in rows if row["peer_seconds"] is not None]
    ratio, theirs = "–", "–"
    if both:
        low, middle, high = np.quantile([_error(row, "mean") / _error(row, "peer") for row in both], [0.25, 0.5, 0.75])
        ratio = f"{middle:.2g} ({low:.2g} – {high:.2g})"
        theirs = f"{np.median([row['peer_seconds'] for row in both]):.1f}"
    cells = (name, len(rows), *_held(rows), ratio, *_seconds(rows), theirs)
    return f"| {' | '.join(map(str, cells))} |"
