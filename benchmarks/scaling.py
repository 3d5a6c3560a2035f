"""Rollouts per second and memory against batch size, for every registered system."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import jax

from bayessim_jax.learning import Ppo
from bayessim_jax.learning.fixed import RandomPolicy
from bayessim_jax.systems import SYSTEMS
from benchmarks.data import draw_recordings
from benchmarks.timing import Spread, measure

if TYPE_CHECKING:
    from argparse import Namespace
    from pathlib import Path

    from bayessim_jax.contracts import Policy, System

__all__ = ["Point", "measure_scaling"]

STEPS = 50


@dataclass(frozen=True)
class Point:
    """One measurement: rollouts of 50 steps, each with its own θ."""

    system: str
    policy: str
    batch: int
    rate: Spread
    """Rollouts per second."""
    megabytes: float
    """Temporary buffers and results of the compiled program."""


def measure_scaling(options: Namespace) -> None:
    """Print a table as it is measured, and draw the figure."""
    batches = [4**k for k in range(20) if 4**k <= options.largest]
    points = []
    print(f"Rollouts of {STEPS} steps per second, {options.repeats} repeats: median (range)\n")
    print("| system | policy | batch | rollouts/s | MB |\n|---|---|---|---|---|")
    for name in ("cartpole", "pendulum", "acrobot", "skid_steer"):
        entry = SYSTEMS[name]
        system, task = entry.system(), entry.task()
        learner = Ppo.create(system, task)
        policies = {
            "network": learner.policy(learner.init(jax.random.key(0))),
            "random": RandomPolicy(system.actions),
        }
        for policy_name, policy in policies.items():
            for batch in batches:
                rate, megabytes = measure_batch(system, policy, batch, options.repeats)
                points.append(Point(name, policy_name, batch, rate, megabytes))
                print(f"| {name} | {policy_name} | {batch} | {rate} | {megabytes:.3g} |", flush=True)
    draw_figure(points, options.figure)
    print(f"\n{options.figure}")


def measure_batch(system: System[Any], policy: Policy, batch: int, repeats: int) -> tuple[Spread, float]:
    """Rollouts per second, and the megabytes that the compiled program asks for."""
    compiled = (
        jax.jit(draw_recordings, static_argnums=(3, 4)).lower(jax.random.key(0), system, policy, batch, STEPS).compile()
    )
    memory: Any = compiled.memory_analysis()
    seconds = measure(compiled, jax.random.key(1), system, policy, repeats=repeats)
    megabytes = (memory.temp_size_in_bytes + memory.output_size_in_bytes) / 1e6
    return Spread.of([batch / lap for lap in seconds.values]), megabytes


def draw_figure(points: list[Point], path: Path) -> None:
    """Two panels over the batch size: rollouts per second, and memory."""
    import matplotlib as mpl

    mpl.use("Agg")
    mpl.rcParams["svg.hashsalt"] = "bayessim"
    import matplotlib.pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.6), layout="constrained")
    colors = dict(
        zip(dict.fromkeys(p.system for p in points), ("#0072B2", "#D55E00", "#009E73", "#CC79A7"), strict=False)
    )
    dashes = {"network": "-", "random": "--"}
    for system, color in colors.items():
        for policy, dash in dashes.items():
            line = [p for p in points if (p.system, p.policy) == (system, policy)]
            x = [p.batch for p in line]
            left.fill_between(
                x, [min(p.rate.values) for p in line], [max(p.rate.values) for p in line], color=color, alpha=0.15, lw=0
            )
            left.plot(
                x, [p.rate.median for p in line], dash, color=color, marker="o", ms=3, label=f"{system}, {policy}"
            )
            right.plot(x, [p.megabytes for p in line], dash, color=color, marker="o", ms=3)
    for axes, label in ((left, f"rollouts of {STEPS} steps per second"), (right, "memory, MB")):
        axes.set(xscale="log", yscale="log", xlabel="batch size", ylabel=label)
        axes.grid(color="0.9")
        axes.spines[["top", "right"]].set_visible(False)
    left.legend(frameon=False, fontsize="small")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, metadata={"Date": None} if path.suffix == ".svg" else None)
    plt.close(figure)
