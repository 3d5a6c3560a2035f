"""After θ* changes in mid-run: the cost of a step on the circle, round by round, beside that of who knows θ*.

    python scripts/change_of_truth.py --change load --runs 8 --out runs/change.jsonl
    python scripts/change_of_truth.py --change ice --runs 8 --out runs/change.jsonl

`load`: the robot drives rounds 1 to `--before` as it is, and from then on with worn wheels and its load at the other
end; the informed planner knows θ*. `ice`: the vehicle, whose wheels are late and slip, drives on asphalt and from then
on on ice; there is no true θ of the model, so the informed planner has the one that predicts the vehicle best on its
ground, a second ahead, over long drives without noise. The loop forgets with probability `--forget`; planners of a
round start from the same pose as the informed one.
"""

from __future__ import annotations

import argparse
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import least_squares
from trials import gather, resume

from bayessim_jax import online
from bayessim_jax.beliefs import GaussianMixture
from bayessim_jax.control import default_planner
from bayessim_jax.effects.vehicle import TERRAINS, OnVehicle, SkidSteerVehicle
from bayessim_jax.engines.simulated import SimulatedTarget
from bayessim_jax.systems import FollowCircle, SkidSteer

if TYPE_CHECKING:
    from collections.abc import Callable

ROBOT = (0.0625, 0.475, 0.2)
WORN = (0.045, 0.475, -0.2)
AHEAD = 20
"""Control periods over which the informed planner's θ predicts best."""


def main() -> None:
    """Run what is asked for and print a line for each round."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--change", choices=("load", "ice"), default="load")
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
        f"mean cost of a step ± sd over {args.runs} runs; beliefs are those after the round; {args.change} after round "
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

    def know(theta: Any) -> Any:
        sure = GaussianMixture(jnp.zeros(1), theta[None], 1e-6 * jnp.eye(3)[None])
        return planner.step(jax.random.key(0), learner, sure)[0]

    learner = planner.init(jax.random.key(0))
    if args.change == "load":
        targets = [SimulatedTarget(system, task, jnp.asarray(theta)) for theta in (ROBOT, WORN)]
    else:
        vehicle: Any = SkidSteerVehicle(system)
        on_vehicle: Any = OnVehicle(task)
        thetas = [vehicle.theta(jnp.asarray(ROBOT), **TERRAINS[name]) for name in ("asphalt", "ice")]
        targets = [SimulatedTarget(vehicle, on_vehicle, theta) for theta in thetas]

    @cache
    def known(changed: int) -> Any:
        target: Any = targets[changed]
        if args.change == "load":
            return know(target.theta)
        return know(_best_predicting(planner.policy(know(target.system.apparent(target.theta))), target))

    def make(index: int) -> dict[str, Any]:
        key, judge_key = jax.random.split(jax.random.fold_in(jax.random.key(args.seed), index))
        keys = online.split(key)
        state = online.init(keys.init, setup)
        costs, informed, means, stale = [], [], [], float("nan")
        for k in range(args.before + args.after):
            changed = int(k >= args.before)
            target = targets[changed]
            at = jax.random.fold_in(judge_key, k)
            if k == args.before:
                stale = float(judge(at, target, state.learner))
            state, info = update(keys.update, setup, state, record(keys.record, setup, target, state))
            costs.append(judge(at, target, state.learner))
            informed.append(judge(at, target, known(changed)))
            means.append(info.belief.mean())
        return {"cost": np.array(costs), "informed": np.array(informed), "stale": stale, "means": np.stack(means)}

    return make


def _best_predicting(policy: Any, target: Any) -> Any:
    """θ of the robot by least squares on how poses go on, from every tenth row of eight drives without noise."""
    vehicle = target.system
    exact = target.replace(system=vehicle.replace(robot=vehicle.robot.replace(noise=jnp.zeros(3))))
    drive = jax.jit(jax.vmap(lambda key: exact.record(key, policy, 400)))
    seen = drive(jax.random.split(jax.random.key(0), 8))

    @jax.jit
    def gaps(theta: Any) -> Any:
        def one(poses: Any, actions: Any, row: Any) -> Any:
            step = lambda state, action: (vehicle.robot.step(theta, state, action),) * 2  # noqa: E731
            begin = vehicle.robot.restart(theta, poses[row])
            end, _ = jax.lax.scan(step, begin, jax.lax.dynamic_slice_in_dim(actions, row, AHEAD))
            return vehicle.robot.observe(theta, end) - poses[row + AHEAD]

        rows = jnp.arange(0, 400 - AHEAD, 10)
        each = jax.vmap(jax.vmap(one, (None, None, 0)), (0, 0, None))
        return each(seen.observations, seen.actions, rows).ravel()

    start = np.asarray(vehicle.apparent(target.theta))
    return jnp.asarray(least_squares(lambda theta: np.asarray(gaps(jnp.asarray(theta))), start, x_scale=start).x)


if __name__ == "__main__":
    main()
