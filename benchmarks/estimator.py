"""The estimator by itself: held-out log q and seconds against sbi's NPE, on the same CartPole trajectories."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from bayessim_jax.contracts import Recording
from bayessim_jax.inference.estimators import recurrent_mixture
from bayessim_jax.inference.fit import Schedule
from bayessim_jax.learning.fixed import RandomPolicy
from bayessim_jax.systems import CartPole
from benchmarks.data import draw_recordings, score_held_out, stack_rows
from benchmarks.timing import Spread, stopwatch

if TYPE_CHECKING:
    from argparse import Namespace

__all__ = ["compare_estimators", "fit_ours"]


def compare_estimators(options: Namespace) -> None:
    """Print a table: each estimator on the same pairs in one run, and our ratios to each peer."""
    from benchmarks.peers import choose_threads, require_peers

    require_peers()
    from benchmarks.peers.sbi_npe import fit_npe

    n, held = options.train, options.held_out
    system = CartPole.create(noise=0.01)
    policy = RandomPolicy(system.actions)
    print(f"CartPole, 50 steps, random actions, sensor noise 0.01: {n} pairs to fit, {held} held out", flush=True)
    print(
        f"PyTorch threads: {choose_threads(options.threads)}; {options.repeats} repeats: median (range)\n", flush=True
    )
    rows: dict[str, list[tuple[float, float, float]]] = {}
    for repeat in range(options.repeats):
        seed = options.seed + repeat
        thetas, recordings = draw_recordings(jax.random.key(seed), system, policy, n + held)
        inputs, targets = stack_rows(recordings), np.asarray(thetas)
        for name in options.encoders:
            schedule = Schedule(epochs=options.epochs, draws=n)
            rows.setdefault(f"ours, {name}", []).append(
                fit_ours(seed, name, options.members, schedule, thetas, recordings, n)
            )
        for model in options.models:
            peer = fit_npe(model, targets[:n], inputs[:n], targets[n:], inputs[n:], seed)
            rows.setdefault(f"sbi, {model}", []).append((peer.log_q, peer.seconds, peer.seconds))
            print(f"  repeat {repeat + 1}: sbi {model} stopped after {peer.epochs} epochs", flush=True)

    print("\n| estimator | held-out log q | seconds | with compilation |\n|---|---|---|---|")
    for name, results in rows.items():
        columns = [Spread.of(column) for column in zip(*results, strict=True)]
        print(f"| {name} | {columns[0]} | {columns[1]} | {columns[2]} |")
    print()
    for ours in (name for name in rows if name.startswith("ours")):
        for peer in (name for name in rows if name.startswith("sbi")):
            pairs = list(zip(rows[ours], rows[peer], strict=True))
            warm = Spread.of([theirs[1] / mine[1] for mine, theirs in pairs])
            cold = Spread.of([theirs[1] / mine[2] for mine, theirs in pairs])
            print(f"{ours} against {peer}: {warm} times faster, {cold} with compilation")


def fit_ours(
    seed: int, encoder: str, members: int, schedule: Schedule, thetas: Any, recordings: Recording, n: int
) -> tuple[float, float, float]:
    """Held-out log q, seconds of a compiled fit, and seconds with compilation; pairs from n on are held out."""
    estimator = recurrent_mixture(encoder, 5, schedule, members=members)
    example = jax.tree.map(lambda leaf: leaf[:1], recordings)
    as_sets = jax.tree.map(lambda leaf: leaf[:n, None], recordings)
    state = estimator.init(jax.random.key(seed), example, thetas.shape[1])
    fit = jax.jit(lambda key, state, *pairs: estimator.fit(key, state, *pairs)[0])
    arguments = (jax.random.key(seed + 1), state, thetas[:n], as_sets, jnp.ones(n))
    cold, _ = stopwatch(fit, *arguments)
    warm, fitted = stopwatch(fit, *arguments)
    held = jax.tree.map(lambda leaf: leaf[n:], recordings)
    return float(score_held_out(estimator, fitted, thetas[n:], held)), warm, cold
