"""The ways of planning with a belief, at equal numbers of simulated model steps.

    python scripts/uses_of_theta.py --systems pendulum cartpole skid_steer --runs 12
    python scripts/uses_of_theta.py --systems cartpole --horizon 40

Every run hides its own θ*, drawn from the prior, in a simulated target, and drives one episode from the same start
with each planner. Beliefs: `prior`, the uniform one; `posterior`, two components of a tenth of the prior's width, one
of them not far from θ*, the other elsewhere with a third of the weight. Each use of θ has so many samples as leave
it `--budget` simulated trajectories in a control step; `informed` plans under θ* with as many.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from trials import gather, resume

from bayessim_jax.beliefs import GaussianMixture, Truncated
from bayessim_jax.control import default_planner
from bayessim_jax.engines.simulated import SimulatedTarget
from bayessim_jax.systems import lookup

if TYPE_CHECKING:
    from collections.abc import Callable

WAYS: dict[str, tuple[dict[str, Any], int]] = {
    "mean": ({"use": "mean"}, 1),
    "sampled": ({"use": "sampled"}, 1),
    "particles 4": ({"use": "particles", "particles": 4}, 4),
    "particles 16": ({"use": "particles", "particles": 16}, 16),
    "particles 16, CVaR": ({"use": "particles", "particles": 16, "risk": "cvar"}, 16),
    "unscented": ({"use": "unscented", "components": 2}, 0),
}
"""Settings of a planner, and simulated trajectories for each sample; 0: as many as there are sigma points."""


def main() -> None:
    """Run the systems asked for and print a table for each."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--systems", nargs="+", default=["pendulum", "cartpole", "skid_steer"])
    parser.add_argument("--beliefs", nargs="+", choices=("prior", "posterior"), default=["prior", "posterior"])
    parser.add_argument("--runs", type=int, default=12)
    parser.add_argument("--budget", type=int, default=512)
    parser.add_argument("--steps", type=int, default=200)
    parser.add_argument("--horizon", type=int, help="control periods ahead, where not as usual for the system")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, help="file of JSON lines to append runs to, and to resume from")
    args = parser.parse_args()
    for name in args.systems:
        rows = {belief: _runs(name, belief, args) for belief in args.beliefs}
        print(f"\n{name}: mean cost of a step ± sd over {args.runs} runs of {args.steps} steps, over the informed's")
        print(f"| θ | {' | '.join(args.beliefs)} |\n|---{'|---' * len(rows)}|")
        for way in (*WAYS, "informed"):
            print(f"| {way} | {' | '.join(_cell(way, results) for results in rows.values())} |")


def _runs(name: str, belief: str, args: argparse.Namespace) -> list[dict[str, Any]]:
    labels = {"system": name, "belief": belief, "seed": args.seed, "budget": args.budget, "steps": args.steps}
    labels["horizon"] = args.horizon
    return gather(resume(_trial(name, belief, args), args.runs, args.out, labels), args.runs, f"{name} {belief}")


def _cell(way: str, rows: list[dict[str, Any]]) -> str:
    """Mean ± sd of a way's cost, and the median of its ratio to the informed one's."""
    costs, informed = (np.array([row[w] for row in rows]) for w in (way, "informed"))
    return f"{costs.mean():.3g} ± {costs.std(ddof=1):.2g} (× {np.median(costs / informed):.2f})"


def _trial(name: str, kind: str, args: argparse.Namespace) -> Callable[[int], dict[str, Any]]:
    """What one run gives, as a function of its number."""
    entry = lookup(name)
    if entry.planned is None:
        raise SystemExit(f"{name} has no task that one can plan for.")
    system, task, box = entry.system(), entry.planned(), entry.system().parameters
    points = 2 * (2 * box.size + (box.size < 3))
    ahead = {} if args.horizon is None else {"horizon": args.horizon}
    ways = {
        way: default_planner(
            "disco", name, system, task, **settings, **ahead, samples=max(args.budget // (each or points), 2)
        )
        for way, (settings, each) in WAYS.items()
    }
    ways["informed"] = ways["mean"]

    def believed(key: Any, truth: Any) -> Truncated:
        if kind == "prior":
            return Truncated.uniform(box, 2)
        near_key, far_key = jax.random.split(key)
        sd = 0.1 * box.width
        near = truth + sd * jax.random.normal(near_key, truth.shape)
        far = box.low + box.width * jax.random.uniform(far_key, truth.shape)
        trils = jnp.broadcast_to(jnp.diag(sd), (2, box.size, box.size))
        return Truncated.create(GaussianMixture(jnp.log(jnp.array([2.0, 1.0])), jnp.stack([near, far]), trils), box)

    @jax.jit
    def drive(key: Any, truth: Any) -> dict[str, Any]:
        belief_key, digest_key, key = jax.random.split(key, 3)
        belief = believed(belief_key, truth)
        target = SimulatedTarget(system, task, truth)
        costs = {}
        for way, planner in ways.items():
            sure = GaussianMixture(jnp.zeros(1), truth[None], 1e-6 * jnp.eye(box.size)[None])
            state = planner.disco.digest(digest_key, sure if way == "informed" else belief)
            seen = target.record(key, planner.policy(state, deterministic=True), args.steps)
            costs[way] = -seen.rewards.sum() / jnp.maximum(seen.valid.sum(), 1)
        return costs

    def make(index: int) -> dict[str, Any]:
        truth_key, key = jax.random.split(jax.random.fold_in(jax.random.key(args.seed), index))
        truth = jax.random.uniform(truth_key, box.low.shape, minval=box.low, maxval=box.high)
        return jax.tree.map(float, drive(key, truth)) | {"truth": np.asarray(truth)}

    return make


if __name__ == "__main__":
    main()
