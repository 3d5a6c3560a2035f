"""Control on the target after the last round, beside two references trained with as many policy steps.

    python scripts/control.py --systems cartpole pendulum acrobot --runs 6
    python scripts/control.py --systems hopper --episodes 30 --out benchmarks/results/control.jsonl

Each run hides its own θ*, drawn from the prior, in Gymnasium's environment, and judges three deterministic policies on
100 episodes of the task's full length with the same resets: `online` was trained in the loop, `uniform` on the prior
(domain randomization without inference), `truth` on θ* itself (the ceiling); for Hopper, whose simulator is Brax, the
last one was trained on the target's own engine. `whole` is the share of episodes that last to the time limit.
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
from bayessim_jax.beliefs import Uniform
from bayessim_jax.cli.options import HABITS
from bayessim_jax.contracts import Belief, Box, Learner
from bayessim_jax.engines.gymnasium import gymnasium_target
from bayessim_jax.learning import default_learner
from bayessim_jax.systems import Hopper, lookup

if TYPE_CHECKING:
    from collections.abc import Callable

SYSTEMS = ("cartpole", "pendulum", "acrobot", "hopper")


def main() -> None:
    """Run the systems asked for and print a table for each."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--systems", nargs="+", choices=SYSTEMS, default=list(SYSTEMS))
    parser.add_argument("--runs", type=int, default=6)
    parser.add_argument("--rounds", type=int, help="by default 30, with Hopper 50")
    parser.add_argument("--episodes", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, help="file of JSON lines to append runs to, and to resume from")
    args = parser.parse_args()
    for name in args.systems:
        rounds = args.rounds or HABITS.get(name, {}).get("rounds", 30)
        labels = {"system": name, "seed": args.seed, "rounds": rounds, "episodes": args.episodes}
        make = _trial(name, rounds, args.episodes, args.seed)
        rows = gather(resume(make, args.runs, args.out, labels), args.runs, name)
        print(f"{name}: {args.runs} runs of {rounds} rounds, {args.episodes} episodes each" + 20 * " ")
        for way in ("online", "uniform", "truth"):
            means = np.array([r[way]["return"] for r in rows])
            ratio = np.array([r[way]["return"] / r["truth"]["return"] for r in rows])
            whole = np.array([r[way]["whole"] for r in rows])
            print(
                f"  {way:8s} return {means.mean():8.1f} ± {means.std():.1f} over runs, worst {means.min():8.1f}; "
                f"over the ceiling's, median {np.median(ratio):.3f}; whole episodes {whole.mean():.3f}, "
                f"least {whole.min():.2f}"
            )


def _trial(name: str, rounds: int, episodes: int, seed: int) -> Callable[[int], dict[str, Any]]:
    """What one run gives, as a function of its number."""
    entry = lookup(name)
    system, task = entry.system(), entry.task()
    learner, box = default_learner(name, system, task), system.parameters
    own = default_learner(name, Hopper.create(pipeline="mujoco"), task) if name == "hopper" else learner
    sizes = {size: value for size, value in HABITS.get(name, {}).items() if size in ("history", "calibrations")}
    setup = online.Setup.create(system, learner, task, **sizes)
    run = jax.jit(online.run, static_argnames="rounds")

    @jax.jit
    def train(key: Any, learner: Learner[Any], belief: Belief) -> Any:
        """As many policy steps as in the loop, all of them on one belief."""
        first, *later = jax.random.split(key, rounds + 1)
        state = learner.init(first)
        return jax.lax.scan(lambda s, k: (learner.step(k, s, belief)[0], None), state, jnp.stack(later))[0]

    @jax.jit
    def judge(key: Any, target: Any, state: Any) -> dict[str, Any]:
        policy = learner.policy(state, deterministic=True)
        seen = jax.vmap(lambda k: target.record(k, policy, task.steps))(jax.random.split(key, episodes))
        return {"return": seen.rewards.sum(-1).mean(), "whole": seen.valid.all(-1).mean()}

    def make(index: int) -> dict[str, Any]:
        truth_key, run_key, judge_key = jax.random.split(jax.random.fold_in(jax.random.key(seed), index), 3)
        truth = jax.random.uniform(truth_key, box.low.shape, minval=box.low, maxval=box.high)
        target = gymnasium_target(name, truth, system.noise)
        known = Uniform(Box(truth - 1e-3 * box.width, truth + 1e-3 * box.width, box.names, box.units))
        states = {
            "online": run(run_key, setup, target, rounds=rounds)[0].learner,
            "uniform": train(run_key, learner, Uniform(box)),
            "truth": train(run_key, own, known),
        }
        judged = {way: jax.tree.map(float, judge(judge_key, target, state)) for way, state in states.items()}
        return judged | {"truth_values": np.asarray(truth)}

    return make


if __name__ == "__main__":
    main()
