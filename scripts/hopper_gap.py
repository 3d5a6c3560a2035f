"""What separates Brax's hopper from Gymnasium's `Hopper-v5` at the same friction: after one step, and after many.

    python scripts/hopper_gap.py --episodes 40

Both start from the environment's own states and take the same random actions. `one step` is the median difference of
what is seen after one control period; `recording` is that after each number of periods without being set right.
"""

from __future__ import annotations

import argparse
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np

from bayessim_jax.engines.gymnasium import GYMNASIUM
from bayessim_jax.systems import Hop, Hopper
from bayessim_jax.systems.hopper import PIPELINES

AHEAD = (1, 5, 10, 15)


def main() -> None:
    """Print a line for each pipeline and horizon."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--pipelines", nargs="+", choices=PIPELINES, default=list(PIPELINES))
    parser.add_argument("--episodes", type=int, default=40)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    states, actions, thetas = record(args.episodes, max(AHEAD), args.seed)
    for pipeline in args.pipelines:
        gaps, rewards, ends = compare(Hopper.create(pipeline=pipeline, noise=0.0), states, actions, thetas)
        for ahead in AHEAD:
            row = gaps[:, ahead - 1]
            position, rate = np.median(row[:, :5], 0).max(), np.median(row[:, 5:], 0).max()
            print(
                f"{pipeline:12s} after {ahead:2d}: positions {position:.1e} (90 % below {spread(row[:, :5]):.1e}), "
                f"rates {rate:.1e} (90 % below {spread(row[:, 5:]):.1e}); {len(row)} episodes"
            )
        print(f"{pipeline:12s} reward of the first step {np.median(rewards):.1e}; same end {ends.mean():.3f}")


def spread(values: np.ndarray) -> float:
    """The 90 % quantile of the worst channel."""
    return float(np.quantile(values.max(-1), 0.9))


def record(episodes: int, steps: int, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The environment's (q, q̇) [episode, steps + 1, 12] from random moments of random hops, its actions, and θ."""
    env_id, configure, _ = GYMNASIUM["hopper"]
    env: Any = gymnasium.make(env_id, disable_env_checker=True).unwrapped
    rng = np.random.default_rng(seed)
    states, actions, thetas = [], [], []
    while len(states) < episodes:
        theta = rng.uniform(0.1, 0.5, 1)
        configure(env, theta)
        env.reset(seed=int(rng.integers(2**31)))
        before = rng.integers(0, 20)
        chosen = rng.uniform(-1, 1, (before + steps, 3)).astype(np.float32)
        rows, fallen = [], False
        for action in chosen:
            rows.append(np.concatenate([env.data.qpos, env.data.qvel]))
            *_, terminated, _, _ = env.step(action)
            fallen |= terminated
        rows.append(np.concatenate([env.data.qpos, env.data.qvel]))
        if not fallen:
            states.append(np.stack(rows[before:]))
            actions.append(chosen[before:])
            thetas.append(theta)
    return np.stack(states), np.stack(actions), np.stack(thetas)


def compare(system: Hopper, states: np.ndarray, actions: np.ndarray, thetas: np.ndarray) -> tuple[np.ndarray, ...]:
    """Differences of what is seen [episode, step, channel], of the first step's reward, and whether ends agree."""
    task = Hop()

    @jax.jit
    @jax.vmap
    def run(theta: Any, states: Any, actions: Any) -> Any:
        begun = system.begin(theta, states[0, :6], states[0, 6:])

        def step(state: Any, x: Any) -> Any:
            action, there = x
            after = system.step(theta, state, action)
            theirs = jnp.concatenate([there[1:6], jnp.clip(there[6:], -10.0, 10.0)])
            return after, (jnp.abs(system.observe(theta, after) - theirs), task.reward(state, action, after))

        last, (gaps, rewards) = jax.lax.scan(step, begun, (actions, states[1:]))
        speed = (states[1, 0] - states[0, 0]) / system.dt
        theirs = speed + 1.0 - 1e-3 * jnp.sum(actions[0] ** 2)
        return gaps, jnp.abs(rewards[0] - theirs), ~task.terminated(last)

    return tuple(np.asarray(x) for x in run(*(jnp.asarray(x, jnp.float32) for x in (thetas, states, actions))))


if __name__ == "__main__":
    main()
