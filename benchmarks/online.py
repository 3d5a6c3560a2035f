"""One round of the paper's CartPole setting: ours against the same work put together from other projects' parts."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp

from bayessim_jax.beliefs import Uniform
from bayessim_jax.contracts import Recording
from bayessim_jax.inference.estimators import MixtureDensity, recurrent_mixture
from bayessim_jax.inference.fit import Schedule
from bayessim_jax.learning import Ppo, default_learner
from bayessim_jax.systems import Balance, CartPole
from benchmarks.compilation import measure_compilation
from benchmarks.data import as_recordings, draw_recordings, score_held_out
from benchmarks.timing import Parts, Spread, stopwatch

if TYPE_CHECKING:
    from argparse import Namespace

__all__ = ["OurRound", "compare_rounds"]

PARTS = ("policy", "rollouts", "estimator", "total")


class OurRound:
    """The three parts of a round, each compiled once and then called with a new seed."""

    def __init__(self, learner: Any, estimator: MixtureDensity, count: int = 200, steps: int = 50) -> None:
        system = learner.system
        self.learner, self.estimator, self.count = learner, estimator, count
        self.learn = jax.jit(lambda key, state: learner.step(key, state, Uniform(system.parameters))[0])
        self.collect = jax.jit(lambda key, state: draw_recordings(key, system, learner.policy(state), count, steps))
        self.fit = jax.jit(lambda key, state, *pairs: estimator.fit(key, state, *pairs)[0])

    def run(self, seed: int) -> tuple[Parts, Any]:
        """Seconds of each part, and what the policy showed."""
        keys = jax.random.split(jax.random.key(seed), 4)
        policy_seconds, state = stopwatch(self.learn, keys[0], self.learner.init(keys[1]))
        rollout_seconds, pairs = stopwatch(self.collect, keys[2], state)
        fit_seconds, _ = self.train(seed, *pairs)
        return Parts(policy_seconds, rollout_seconds, fit_seconds), pairs

    def train(self, seed: int, thetas: Any, recordings: Recording) -> tuple[float, Any]:
        """Seconds of the fit on given pairs, and the fitted state."""
        keys = jax.random.split(jax.random.key(seed), 2)
        as_sets = jax.tree.map(lambda leaf: leaf[:, None], recordings)
        example = jax.tree.map(lambda leaf: leaf[0], as_sets)
        state = self.estimator.init(keys[0], example, thetas.shape[1])
        return stopwatch(self.fit, keys[1], state, thetas, as_sets, jnp.ones(thetas.shape[0]))


def compare_rounds(options: Namespace) -> None:
    """Print seconds of each part on both sides, the ratios, and the time to the same held-out log q."""
    from benchmarks.peers import choose_threads, require_peers

    require_peers()
    from benchmarks.peers.stable_baselines import collect, fit_density, run_round

    system, task = CartPole.create(noise=0.01), Balance(steps=50)
    same = OurRound(
        Ppo.create(system, task, envs=16, horizon=128, epochs=10, minibatches=32, learning_rate=3e-4),
        recurrent_mixture("lstm", 5, Schedule(epochs=200, patience=200), members=1, folds=10),
    )
    default = default_learner("cartpole", system, Balance())
    ladder = {
        n: OurRound(default, recurrent_mixture(options.encoder, 5, Schedule(epochs=n), members=options.members))
        for n in options.ladder
    }
    print(f"PyTorch threads: {choose_threads(options.threads)}; {options.repeats} repeats: median (range)", flush=True)
    same.run(options.seed)
    for ours in ladder.values():
        ours.run(options.seed)

    mine, theirs, reached, best_scores, curves = [], [], [], [], []
    for repeat in range(options.repeats):
        seed = options.seed + repeat
        peer = run_round(seed)
        mine.append(same.run(seed)[0])
        theirs.append(peer.parts)

        # Which of the peer's epochs generalizes best is found with the held-out pairs: a favour to the peer.
        held = collect(peer.policy, seed + 1000, options.held_out, 50)
        history = fit_density(peer.trajectories, held, seed)
        best_at, best = max(history, key=lambda entry: entry[1])
        best_scores.append((best, history[-1][1], best_at / history[-1][0] * peer.parts.estimator))
        pairs, held_pairs = _as_pairs(system.dt, peer.trajectories), _as_pairs(system.dt, held)
        curve = {}
        for epochs, ours in ladder.items():
            seconds, state = ours.train(seed, *pairs)
            curve[epochs] = (float(score_held_out(ours.estimator, state, *held_pairs)), seconds)
        curves.append(curve)
        good = [epochs for epochs, (score, _) in curve.items() if score >= best]
        parts = ladder[min(good)].run(seed)[0] if good else None
        reached.append((min(good), curve[min(good)][1], parts.total) if good else None)  # type: ignore[union-attr]
        print(f"  repeat {repeat + 1}: peer {peer.parts.total:.1f} s, ours {mine[-1].total:.2f} s", flush=True)

    print(f"\nSame work: PPO of {peer.policy_steps} steps, 200 rollouts, 200 epochs of LSTM(64) and 5 Gaussians\n")
    print("| part | peer, s | ours, s | times faster |\n|---|---|---|---|")
    for part in PARTS:
        a, b = [getattr(p, part) for p in theirs], [getattr(p, part) for p in mine]
        print(f"| {part} | {Spread.of(a)} | {Spread.of(b)} | {Spread.of([x / y for x, y in zip(a, b, strict=True)])} |")
    _print_quality(options, curves, best_scores, reached, theirs)
    for state, seconds in zip(("cold", "from the persistent cache"), measure_compilation(), strict=True):
        print(f"compilation of a whole run, {state}: {seconds:.1f} s", flush=True)


def _as_pairs(dt: float, made: Any) -> tuple[Any, Recording]:
    return jnp.asarray(made.theta), as_recordings(dt, made.observations, made.actions, made.valid)


def _print_quality(options: Namespace, curves: Any, best_scores: Any, reached: Any, theirs: Any) -> None:
    """Held-out log q of both sides on the peer's trajectories, and how much sooner we get there."""
    print(f"\nHeld-out log q on {options.held_out} more of the peer's trajectories\n")
    print("| estimator | log q | seconds |\n|---|---|---|")
    best, last, seconds = (Spread.of(column) for column in zip(*best_scores, strict=True))
    print(f"| peer, its best epoch | {best} | {seconds} |")
    print(f"| peer, after 200 epochs | {last} | {Spread.of([p.estimator for p in theirs])} |")
    for epochs in options.ladder:
        scores, laps = zip(*(curve[epochs] for curve in curves), strict=True)
        name = f"ours, {options.encoder} × {options.members}, at most {epochs} epochs"
        print(f"| {name} | {Spread.of(scores)} | {Spread.of(laps)} |")
    print()
    found = [(r, b, p) for r, b, p in zip(reached, best_scores, theirs, strict=True) if r is not None]
    print(f"The peer's best log q was reached in {len(found)} of {len(reached)} repeats", end="")
    if not found:
        print(".")
        return
    print(f", after {Spread.of([r[0] for r, _, _ in found])} epochs;")
    print(f"  estimator, against the peer's 200 epochs: {Spread.of([p.estimator / r[1] for r, _, p in found])} times")
    print(f"  estimator, against the peer's best epoch: {Spread.of([b[2] / r[1] for r, b, _ in found])} times")
    print(f"  whole round with our default learner:     {Spread.of([p.total / r[2] for r, _, p in found])} times")
