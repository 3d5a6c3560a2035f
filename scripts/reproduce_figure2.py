"""Figure 2 of the paper: success on the target against environment steps, for three ways to choose what to train on.

    python scripts/reproduce_figure2.py --systems fetch_push fetch_slide --runs 3 --rounds 30 --out runs/figure2.jsonl

Every run hides its own friction, drawn from the prior, in the gymnasium-robotics environment. `online` infers in every
round after the warm-up, `offline` once, from the policy after the warm-up, and then keeps that posterior, `uniform`
never. After each round the deterministic policy plays `--episodes` episodes on the target; with `--figure` the curves
are drawn.

Source: Possas et al. 2020
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from trials import gather, resume

from bayessim_jax import online
from bayessim_jax.cli.options import HABITS
from bayessim_jax.cli.plan import INFERENCES, make_estimator
from bayessim_jax.engines.gymnasium import gymnasium_target
from bayessim_jax.inference import Schedule
from bayessim_jax.learning import default_learner
from bayessim_jax.learning.her import Her
from bayessim_jax.systems import lookup

if TYPE_CHECKING:
    from collections.abc import Callable

SYSTEMS = ("fetch_push", "fetch_slide")


def main() -> None:
    """Run what is asked for, print a line for each scheme, and draw the curves."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--systems", nargs="+", choices=SYSTEMS, default=list(SYSTEMS))
    parser.add_argument("--schemes", nargs="+", choices=INFERENCES, default=list(INFERENCES))
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--rounds", type=int, default=30)
    parser.add_argument("--episodes", type=int, default=20, help="on the target after each round")
    parser.add_argument("--small", action="store_true", help="a few simulations and policy steps: shows that it runs")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, help="file of JSON lines to append runs to, and to resume from")
    parser.add_argument("--figure", type=Path, help="SVG to draw")
    args = parser.parse_args()
    curves: dict[str, dict[str, Any]] = {}
    for name in args.systems:
        for scheme in args.schemes:
            make, steps = _trial(name, scheme, args)
            labels = {
                "system": name,
                "scheme": scheme,
                "rounds": args.rounds,
                "episodes": args.episodes,
                "seed": args.seed,
                "small": args.small,
            }
            results = gather(resume(make, args.runs, args.out, labels), args.runs, f"{name} {scheme}")
            success = np.stack([r["success"] for r in results])
            curves.setdefault(name, {})[scheme] = steps, success
            last = success[:, -1]
            print(
                f"{name:11s} {scheme:8s} after {steps[-1]} steps: success {last.mean():.2f} ({last.min():.2f} to "
                f"{last.max():.2f}) over {len(last)} runs; best round {success.mean(0).max():.2f}"
            )
    if args.figure:
        _draw(curves, args.figure)


def _trial(name: str, scheme: str, args: argparse.Namespace) -> tuple[Callable[[int], dict[str, Any]], np.ndarray]:
    """What one run gives, as a function of its number, and the environment steps after each of its rounds."""
    entry, habits = lookup(name), dict(HABITS[name])
    system, task = entry.system(noise=habits.pop("noise")), entry.task()
    learner, sizes = default_learner(name, system, task), habits | {"evaluations": args.episodes}
    schedule = Schedule(epochs=5) if args.small else None
    estimator = make_estimator(sizes.pop("encoder"), system, schedule=schedule)
    if args.small:
        learner = Her.create(system, task, 2, envs=2, updates=2, widths=(8,))
        sizes |= {"warmup": 1, "simulations": 20, "steps": 10, "pool": 2, "history": 2, "calibrations": 8}
    setup = online.Setup.create(system, learner, task, estimator=estimator, inferences=INFERENCES[scheme], **sizes)
    box = system.parameters
    run = jax.jit(online.run, static_argnames="rounds")
    a_round = learner.iterations * learner.envs * learner.horizon

    def make(index: int) -> dict[str, Any]:
        truth_key, run_key = jax.random.split(jax.random.fold_in(jax.random.key(args.seed), index))
        truth = jax.random.uniform(truth_key, box.low.shape, minval=box.low, maxval=box.high)
        target = gymnasium_target(name, truth, system.noise)
        state, done = online.init(online.split(run_key).init, setup), []
        for number in range(1, args.rounds + 1):
            state, info = run(run_key, setup, target, state, rounds=1)
            done.append(jax.tree.map(np.asarray, info))
            success = float(info.success_target[0])
            print(f"{name} {scheme} round {number}: success {success:.2f}".ljust(60), end="\r", flush=True)
        infos = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *done)
        log_q = jax.vmap(lambda belief: belief.log_prob(truth))(infos.belief)
        found = {"success": infos.success_target, "return": infos.return_target, "log_q": log_q, "truth_values": truth}
        return jax.tree.map(np.asarray, found)

    return make, a_round * (1 + np.arange(args.rounds))


def _draw(curves: dict[str, dict[str, Any]], path: Path) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(4.5 * len(curves), 3.2), layout="constrained")
    for axes, (name, schemes) in zip(np.atleast_1d(figure.subplots(1, len(curves))), curves.items(), strict=True):
        for scheme, (steps, success) in schemes.items():
            axes.plot(steps / 1e3, success.mean(0), label=scheme)
            axes.fill_between(steps / 1e3, success.min(0), success.max(0), alpha=0.15)
        axes.set(title=name, xlabel="environment steps, thousands", ylabel="success on the target", ylim=(0, 1))
        axes.legend(frameon=False)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path)


if __name__ == "__main__":
    main()
