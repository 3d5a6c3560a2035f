"""After θ* changes in mid-run: the cost of a step on the circle, round by round, beside that of who knows θ*.

    python scripts/change_of_truth.py --runs 8 --out runs/change.jsonl

The robot drives rounds 1 to `--before` as it is, and from then on with worn wheels and its load at the other end. The
loop forgets with probability `--forget`; planners of a round start from the same pose as the informed one.
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
from bayessim_jax.beliefs import GaussianMixture
from bayessim_jax.control import default_planner
from bayessim_jax.engines.simulated import SimulatedTarget
from bayessim_jax.systems import FollowCircle, SkidSteer

if TYPE_CHECKING:
    from collections.abc import Callable

FIRST, LATER = (0.0625, 0.475, 0.2), (0.045, 0.475, -0.2)


def main() -> None:
    """Run what is asked for and print a line for each round."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=8)
    parser.add_argument("--before", type=int, default=3, help="rounds before the change")
    parser.add_argument("--after", type=int, default=3, help="rounds after it")
    parser.add_argument("--forget", type=float, default=0.1)
    parser.add_argument("--steps", type=int, default=150, help="control periods of a recording")
    parser.add_argument("--episode", type=int, default=500, help="control periods of an episode that is judged")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, help="file of JSON lines to append runs to, and to resume from")
    args = parser.parse_args()
    labels = {name: value for name, value in vars(args).items() if name not in ("runs", "out")}
    rows = gather(resume(make_trial(args), args.runs, args.out, labels), args.runs)
    cost, informed = (np.stack([row[name] for row in rows]) for name in ("cost", "informed"))
    stale = np.array([row["stale"] for row in rows])
    print(
        f"mean cost of a step ± sd over {args.runs} runs; the belief is that after the round; θ* changes after round "
        f"{args.before}. With the belief from before the change: {stale.mean():.3g} ± {stale.std(ddof=1):.2g}"
    )
    print("| round | cost | informed | ratio of means | runs within a fifth |\n|---|---|---|---|---|")
    for k in range(cost.shape[1]):
        ratio, within = cost[:, k].mean() / informed[:, k].mean(), (cost[:, k] <= 1.2 * informed[:, k]).sum()
        print(
            f"| {k + 1} | {_spread(cost[:, k])} | {_spread(informed[:, k])} | {ratio:.2f} | {within} of {args.runs} |"
        )


def _spread(values: np.ndarray) -> str:
    return f"{values.mean():.3g} ± {values.std(ddof=1):.2g}"


def make_trial(args: argparse.Namespace) -> Callable[[int], dict[str, Any]]:
    """What one run gives, as a function of its number."""
    system, task = SkidSteer.create(), FollowCircle(steps=args.episode)
    planner = default_planner("mppi", "skid_steer", system, task)
    sizes = {"steps": args.steps, "simulations": 400, "calibrations": 64, "history": 4}
    setup = online.Setup.create(system, planner, task, replay=True, forget=args.forget, **sizes)
    record, update = jax.jit(online.record), jax.jit(online.update, compiler_options=online.COMPILER_OPTIONS)

    @jax.jit
    def judge(key: Any, target: Any, learner: Any) -> Any:
        policy = planner.policy(learner, deterministic=True)
        return -target.record(key, policy, args.episode).rewards.mean()

    def make(index: int) -> dict[str, Any]:
        key, judge_key = jax.random.split(jax.random.fold_in(jax.random.key(args.seed), index))
        keys = online.split(key)
        state = online.init(keys.init, setup)
        costs, informed, stale = [], [], float("nan")
        for k in range(args.before + args.after):
            truth = jnp.asarray(FIRST if k < args.before else LATER)
            target = SimulatedTarget(system, task, truth)
            at = jax.random.fold_in(judge_key, k)
            if k == args.before:
                stale = float(judge(at, target, state.learner))
            state, _ = update(keys.update, setup, state, record(keys.record, setup, target, state))
            sure = GaussianMixture(jnp.zeros(1), truth[None], 1e-6 * jnp.eye(3)[None])
            costs.append(judge(at, target, state.learner))
            informed.append(judge(at, target, planner.step(key, state.learner, sure)[0]))
        return {"cost": np.array(costs), "informed": np.array(informed), "stale": stale}

    return make


if __name__ == "__main__":
    main()
