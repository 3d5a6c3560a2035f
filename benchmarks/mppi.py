"""One control step of DISCO on the pendulum against `pytorch_mppi`, and the time of a step against its size."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp

from bayessim_jax.beliefs import Truncated
from bayessim_jax.control import Disco, default_planner
from bayessim_jax.systems import Pendulum, Upswing, lookup
from benchmarks.timing import Spread, measure

if TYPE_CHECKING:
    from argparse import Namespace

__all__ = ["compare_planners"]

LOOK = jnp.array([-1.0, 0.05, 0.3])
SCALES = ((500, 30), (2000, 30), (10_000, 30), (500, 100), (2000, 100), (10_000, 100))


def compare_planners(options: Namespace) -> None:
    """Print milliseconds of a control step on both sides, the ratios, how it grows, and the skid-steer robot's rate."""
    from benchmarks.peers import choose_threads, require_peers

    require_peers("torch", "pytorch_mppi")
    from benchmarks.peers.pytorch_mppi import pendulum_step

    threads = choose_threads(options.threads)
    print(f"Pendulum, horizon 30, 500 samples; PyTorch threads: {threads}; {options.repeats} repeats: median (range)\n")
    ours = {f"ours, {n} models": _stepper(particles=n) for n in (1, 4, 16)}
    theirs, laps = pendulum_step(options.seed), {name: [] for name in ours}
    peer = []
    for _ in range(options.repeats):  # one after the other, so that a busy minute meets all of them
        peer.append(measure(theirs, repeats=1, shortest=0.5).median)
        for name, step in ours.items():
            laps[name].append(measure(*step, repeats=1, shortest=0.5).median)
    print("| controller | ms for a control step | times faster |\n|---|---|---|")
    print(f"| pytorch_mppi, 1 model | {_milliseconds(peer)} | 1 |")
    for name, values in laps.items():
        print(f"| {name} | {_milliseconds(values)} | {Spread.of([p / v for p, v in zip(peer, values, strict=True)])} |")

    print("\n| samples | horizon | ms, 1 model | ms, 16 models |\n|---|---|---|---|")
    for samples, horizon in SCALES:
        both = [
            measure(*_stepper(particles=n, samples=samples, horizon=horizon), repeats=options.repeats) for n in (1, 16)
        ]
        print(f"| {samples} | {horizon} | {' | '.join(str(_milliseconds(b.values)) for b in both)} |", flush=True)

    entry = lookup("skid_steer")
    system = entry.system()
    for name in ("mppi", "disco"):
        planner = default_planner(name, "skid_steer", system, entry.task())
        step = _step(planner.disco, Truncated.uniform(system.parameters, 5), jnp.zeros(3))
        spread = measure(*step, repeats=options.repeats)
        print(f"skid-steer, {name} as by default: {_milliseconds(spread.values)} ms, {1 / spread.median:.0f} Hz")


def _stepper(particles: int = 1, **sizes: int) -> tuple[Any, ...]:
    system = Pendulum.create()
    use = "particles" if particles > 1 else "mean"
    disco = Disco.create(system, Upswing(), use, particles=particles, **sizes)
    return _step(disco, Truncated.uniform(system.parameters, 5), LOOK)


def _step(disco: Disco, belief: Truncated, look: Any) -> tuple[Any, ...]:
    """A compiled control step, every number of which is an argument, and its arguments."""
    step = jax.jit(lambda key, plan, look, digest: disco.steer(key, plan, look, digest)[:2])
    return step, jax.random.key(1), disco.init(), look, disco.digest(jax.random.key(0), belief)


def _milliseconds(seconds: Any) -> Spread:
    return Spread.of([1e3 * s for s in seconds])
