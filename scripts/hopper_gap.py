"""What separates Brax's hopper from Gymnasium's `Hopper-v5` at the same friction: after one step, and after many.

    python scripts/hopper_gap.py --episodes 40

Both start from the environment's own states and take the same random actions: the median difference of what is seen
after so many control periods without being set right, in the worst channel. Then the friction that Brax's hopper needs
to follow the environment's while its foot slides, over the true one: what an inference through it would be off by.
"""

from __future__ import annotations

import argparse
import time
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np

from bayessim_jax.engines.gymnasium import GYMNASIUM
from bayessim_jax.systems import Hop, Hopper
from bayessim_jax.systems.hopper import PIPELINES

AHEAD = (1, 5, 10, 15)
RATIOS = np.linspace(0.6, 1.8, 121)
WORLDS, STEPS = 256, 50
"""Of the timing."""


def main() -> None:
    """Print a line for each pipeline and horizon."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--pipelines", nargs="+", choices=PIPELINES, default=list(PIPELINES))
    parser.add_argument("--episodes", type=int, default=40)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    states, actions, thetas = record(args.episodes, max(AHEAD), args.seed)
    sliding = record(args.episodes, max(AHEAD), args.seed, speed=1.0)
    for pipeline in args.pipelines:
        system = Hopper.create(pipeline=pipeline, noise=0.0)
        gaps, rewards, ends = compare(system, states, actions, thetas)
        for ahead in AHEAD:
            row = gaps[:, ahead - 1]
            position, rate = np.median(row[:, :5], 0).max(), np.median(row[:, 5:], 0).max()
            print(
                f"{pipeline:12s} after {ahead:2d}: positions {position:.1e} (90 % below {spread(row[:, :5]):.1e}), "
                f"rates {rate:.1e} (90 % below {spread(row[:, 5:]):.1e}); {len(row)} episodes"
            )
        print(f"{pipeline:12s} reward of the first step {np.median(rewards):.1e}; same end {ends.mean():.3f}")
        errors = follow(system, *sliding)
        each, together = RATIOS[errors.argmin(1)], RATIOS[errors.sum(0).argmin()]
        print(
            f"{pipeline:12s} friction that follows a sliding foot, over the true one: {together:.2f} for all, "
            f"single ones {np.mean(each):.2f} ± {np.std(each):.2f}; {count_steps(system):.2g} control steps/s"
        )


def spread(values: np.ndarray) -> float:
    """The 90 % quantile of the worst channel."""
    return float(np.quantile(values.max(-1), 0.9))


def record(episodes: int, steps: int, seed: int, speed: float = 0.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The environment's (q, q̇) [episode, steps + 1, 12] from random moments of random hops, its actions, and θ.

    With a speed the hops begin when the recording does, and slide to either side.
    """
    env_id, configure, _ = GYMNASIUM["hopper"]
    env: Any = gymnasium.make(env_id, disable_env_checker=True).unwrapped
    rng = np.random.default_rng(seed)
    states, actions, thetas = [], [], []
    while len(states) < episodes:
        theta = rng.uniform(0.1, 0.5, 1)
        configure(env, theta)
        env.reset(seed=int(rng.integers(2**31)))
        before = 0 if speed else rng.integers(0, 20)
        if speed:
            env.set_state(env.data.qpos, env.data.qvel + speed * rng.choice([-1, 1]) * np.eye(6)[0])
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


def follow(system: Hopper, states: np.ndarray, actions: np.ndarray, thetas: np.ndarray) -> np.ndarray:
    """Squared difference of all rates over a recording, for θ times each of the ratios [episode, ratio]."""
    scaled = (thetas[:, None] * RATIOS[:, None]).reshape(-1, 1)
    gaps, *_ = compare(system, *(np.repeat(x, len(RATIOS), axis=0) for x in (states, actions)), scaled)
    return (gaps[..., 5:] ** 2).sum((1, 2)).reshape(-1, len(RATIOS))


def count_steps(system: Hopper) -> float:
    """Control steps per second of a batch."""
    thetas = jnp.full((WORLDS, 1), 0.3)

    @jax.jit
    def go(key: Any) -> Any:
        def step(states: Any, key: Any) -> Any:
            actions = jax.random.uniform(key, (WORLDS, 3), minval=-1.0, maxval=1.0)
            return jax.vmap(system.step)(thetas, states, actions), None

        begun = jax.vmap(system.reset)(jax.random.split(key, WORLDS), thetas)
        return jax.lax.scan(step, begun, jax.random.split(key, STEPS))[0].qpos

    go(jax.random.key(0)).block_until_ready()
    began = time.perf_counter()
    go(jax.random.key(1)).block_until_ready()
    return WORLDS * STEPS / (time.perf_counter() - began)


if __name__ == "__main__":
    main()
