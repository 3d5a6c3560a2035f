"""One control step of DISCO on the pendulum against `pytorch_mppi`, and the time of a step against its size."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp

from bayessim_jax.beliefs import Truncated
from bayessim_jax.control import Disco, default_planner
from bayessim_jax.systems import Pendulum, Upswing, lookup
from benchmarks.timing import Spread, measure

if TYPE_CHECKING:
    from argparse import Namespace
    from collections.abc import Iterator
    from pathlib import Path

__all__ = ["compare_planners"]

LOOK = jnp.array([-1.0, 0.05, 0.3])
SAMPLES, HORIZONS = (100, 300, 1000, 3000, 10_000), (10, 30, 100)


def compare_planners(options: Namespace) -> None:
    """Print milliseconds of a control step on both sides, the ratios, how it grows, and the skid-steer robot's rate.

    What `options.out` holds already is not measured again.
    """
    if options.out and options.out.exists():
        rows = [json.loads(line) for line in options.out.read_text(encoding="utf-8").splitlines()]
    else:
        rows = [*measure_planners(options)]
        if options.out:
            options.out.parent.mkdir(parents=True, exist_ok=True)
            options.out.write_text("".join(json.dumps(row) + "\n" for row in rows), encoding="utf-8")
    print_tables(rows)
    if options.figure:
        draw_figure([row for row in rows if row["part"] == "scale"], options.figure)
        print(f"\n{options.figure}")


def measure_planners(options: Namespace) -> Iterator[dict[str, Any]]:
    """What was timed, one row for each controller and size: a `part`, its settings, `ms` of every repeat."""
    from benchmarks.peers import choose_threads, require_peers

    require_peers("torch", "pytorch_mppi")
    from benchmarks.peers.pytorch_mppi import pendulum_step

    threads = choose_threads(options.threads)
    theirs = pendulum_step(options.seed)
    ours = {n: _stepper(particles=n) for n in (1, 4, 16)}
    laps: dict[int, list[float]] = {n: [] for n in ours}
    peer = []
    for _ in range(options.repeats):  # one after the other, so that a busy minute meets all of them
        peer.append(_milliseconds(measure(theirs, repeats=1, shortest=0.5))[0])
        for n, step in ours.items():
            laps[n] += _milliseconds(measure(*step, repeats=1, shortest=0.5))
    yield {"part": "peer", "threads": threads, "ms": peer}
    for n, values in laps.items():
        yield {"part": "ours", "models": n, "ms": values}

    for horizon in HORIZONS:
        for samples in SAMPLES:
            for models in (1, 16):
                step = _stepper(particles=models, samples=samples, horizon=horizon)
                ms = _milliseconds(measure(*step, repeats=options.repeats))
                yield {"part": "scale", "samples": samples, "horizon": horizon, "models": models, "ms": ms}

    entry = lookup("skid_steer")
    system = entry.system()
    for name in ("mppi", "disco"):
        planner = default_planner(name, "skid_steer", system, entry.task())
        step = _step(planner.disco, Truncated.uniform(system.parameters, 5), jnp.zeros(3))
        yield {"part": "rate", "controller": name, "ms": _milliseconds(measure(*step, repeats=options.repeats))}


def print_tables(rows: list[dict[str, Any]]) -> None:
    """Against the peer, over samples and horizon, and as control rates."""
    part = lambda name: [row for row in rows if row["part"] == name]  # noqa: E731
    (peer,) = part("peer")
    repeats = len(peer["ms"])
    print(f"Pendulum, horizon 30, 500 samples; PyTorch threads: {peer['threads']}; {repeats} repeats: median (range)\n")
    print("| controller | ms for a control step | times faster |\n|---|---|---|")
    print(f"| pytorch_mppi, 1 model | {Spread.of(peer['ms'])} | 1 |")
    for row in part("ours"):
        faster = Spread.of([p / v for p, v in zip(peer["ms"], row["ms"], strict=True)])
        label = f"{row['models']} model{'s' if row['models'] > 1 else ''}"
        print(f"| ours, {label} | {Spread.of(row['ms'])} | {faster} |")

    print("\n| horizon | samples | ms, 1 model | ms, 16 models |\n|---|---|---|---|")
    for one, many in zip(part("scale")[::2], part("scale")[1::2], strict=True):
        print(f"| {one['horizon']} | {one['samples']} | {Spread.of(one['ms'])} | {Spread.of(many['ms'])} |")

    print("\n| skid-steer robot, as by default | ms for a control step | Hz |\n|---|---|---|")
    for row in part("rate"):
        rate = Spread.of([1e3 / ms for ms in row["ms"]])
        print(f"| {row['controller']} | {Spread.of(row['ms'])} | {rate} |")


def draw_figure(rows: list[dict[str, Any]], path: Path) -> None:
    """Milliseconds of a control step over the samples, a line for each horizon; one panel for each number of models."""
    import matplotlib as mpl

    mpl.use("Agg")
    mpl.rcParams["svg.hashsalt"] = "bayessim"
    import matplotlib.pyplot as plt

    figure, panels = plt.subplots(1, 2, figsize=(8, 3.4), layout="constrained", sharey=True)
    for axes, models in zip(panels, (1, 16), strict=True):
        for horizon, color in zip(HORIZONS, ("#0072B2", "#D55E00", "#009E73"), strict=True):
            line = [row for row in rows if (row["models"], row["horizon"]) == (models, horizon)]
            x, spreads = [row["samples"] for row in line], [Spread.of(row["ms"]) for row in line]
            axes.fill_between(
                x, [min(s.values) for s in spreads], [max(s.values) for s in spreads], color=color, alpha=0.2, lw=0
            )
            axes.plot(x, [s.median for s in spreads], color=color, marker="o", ms=3, label=f"H = {horizon}")
        axes.axhline(50, color="0.6", lw=0.8, ls="--")
        axes.set(xscale="log", yscale="log", xlabel="samples K", title=f"{models} model{'s' if models > 1 else ''}")
        axes.grid(color="0.9")
        axes.spines[["top", "right"]].set_visible(False)
    panels[0].set_ylabel("ms for a control step")
    panels[0].text(SAMPLES[0], 54, "one control period", color="0.4", fontsize="small")
    panels[0].legend(frameon=False, fontsize="small", loc="upper left", bbox_to_anchor=(0.0, 0.78))
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, metadata={"Date": None} if path.suffix == ".svg" else None)
    plt.close(figure)


def _stepper(particles: int = 1, **sizes: int) -> tuple[Any, ...]:
    system = Pendulum.create()
    use = "particles" if particles > 1 else "mean"
    disco = Disco.create(system, Upswing(), use, particles=particles, **sizes)
    return _step(disco, Truncated.uniform(system.parameters, 5), LOOK)


def _step(disco: Disco, belief: Truncated, look: Any) -> tuple[Any, ...]:
    """A compiled control step, every number of which is an argument, and its arguments."""
    step = jax.jit(lambda key, plan, look, digest: disco.steer(key, plan, look, digest)[:2])
    return step, jax.random.key(1), disco.init(), look, disco.digest(jax.random.key(0), belief)


def _milliseconds(seconds: Spread) -> list[float]:
    return [round(1e3 * s, 5) for s in seconds.values]
