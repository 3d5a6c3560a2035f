"""How far an object can be struck in Fetch Slide, by friction, and the share of goals that lie within.

    python scripts/slide_reach.py --frictions 0.1 0.23 0.64 1.2 2.0

A strike goes behind the object, pushes it along a line, at a speed, for some time, and lets go; the cross-entropy
method seeks the one after which the object lies farthest ahead, from places beside each other. The simulator is the one
that policies are trained in, without noise. Goals that are farther ahead than that, and than the 5 cm that are allowed,
are likely out of reach of every policy: the gripper has a greatest speed v, the arm an end, and what is let go comes to
rest after v² / 2μg. It is a search: a farther strike may exist.

Source: Rubinstein 1999
"""

from __future__ import annotations

import argparse
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from bayessim_jax.systems import Fetch, MoveTo
from bayessim_jax.systems.fetch import REACH, THRESHOLD

MEAN = jnp.array([0.09, 0.0, 0.0, 0.0, 0.9, 10.0])
SPREAD = jnp.array([0.03, 0.01, 0.1, 0.005, 0.4, 8.0])
"""A strike: m behind the object and aside, rad off straight ahead, m above its middle, speed in actions, steps."""
APPROACH = 20
"""Steps to get behind the object."""
ELITES = 8
PLACES = ((0.0, -0.1), (0.0, 0.1), (0.1, 0.0))
"""Of the object, from the middle of where episodes put it, m."""
GOALS = 4000


def main() -> None:
    """Print a line for each friction."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frictions", nargs="+", type=float, default=[0.1, 0.23, 0.64, 1.2, 2.0])
    parser.add_argument("--tries", type=int, default=96, help="strikes in a generation")
    parser.add_argument("--generations", type=int, default=8)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    system = Fetch.create("slide", noise=0.0)
    keys = jax.random.split(jax.random.key(args.seed), GOALS)
    starts = jax.vmap(lambda key: system.reset(key, jnp.ones(1)))(keys)
    middle, goals = np.asarray(starts.hand[0, :2]), np.asarray(starts.goal[:, 0])
    search = make_search(system, args.tries, args.generations)
    for friction in args.frictions:
        ends = [
            float(search(key, jnp.array([friction]), jnp.asarray(middle + np.array(place), jnp.float32)))
            for key, place in zip(keys[: len(PLACES)], PLACES, strict=True)
        ]
        within = np.mean(goals <= max(ends) + THRESHOLD)
        print(
            f"friction {friction}: ends at most {max(ends) - middle[0]:.2f} m ahead of where the gripper begins "
            f"({', '.join(f'{end - middle[0]:.2f}' for end in ends)}); {within:.0%} of goals lie within",
            flush=True,
        )


def make_search(system: Fetch, tries: int, generations: int) -> Any:
    """(key, θ, place of the object) → where along x the object lies after the best strike, m."""
    steps = MoveTo().steps

    def strike(theta: Any, begun: Any, numbers: Any) -> Any:
        behind, aside, turn, above, speed, lasts = numbers
        thing = begun.physics.qpos[-7:-4]
        along = jnp.array([jnp.cos(turn), jnp.sin(turn)])
        start = thing[:2] - behind * along + aside * jnp.array([-along[1], along[0]])
        low = thing[2] + above

        def step(state: Any, t: Any) -> Any:
            grip = state.hand[:3]
            off = start - grip[:2]
            height = jnp.where(jnp.sum(off**2) < 0.02**2, low, thing[2] + 0.08)
            approach = jnp.append(off, height - grip[2]) / REACH
            push = jnp.append(speed * along, (low - grip[2]) / REACH)
            share = jnp.clip(lasts - (t - APPROACH), 0.0, 1.0)
            action = jnp.where(t < APPROACH, approach, share * push)
            return system.step(theta, state, jnp.append(action, 0.0)), None

        last, _ = jax.lax.scan(step, begun, jnp.arange(steps, dtype=float))
        place = last.physics.qpos[-7:-4]
        on_table = jnp.abs(place[2] - thing[2]) < THRESHOLD
        return jnp.where(on_table & jnp.isfinite(place[0]), place[0], -jnp.inf)

    def search(key: Any, theta: Any, place: Any) -> Any:
        begun = system.begin(theta, place, jnp.zeros(3))
        many = jax.vmap(strike, (None, None, 0))

        def generation(carry: Any, key: Any) -> Any:
            mean, spread, best = carry
            numbers = mean + spread * jax.random.normal(key, (tries, len(MEAN)))
            ends = many(theta, begun, numbers)
            elite = numbers[jnp.argsort(-ends)[:ELITES]]
            return (elite.mean(0), elite.std(0) + 0.02 * SPREAD, jnp.maximum(best, ends.max())), None

        start = (MEAN, SPREAD, jnp.array(-jnp.inf))
        return jax.lax.scan(generation, start, jax.random.split(key, generations))[0][2]

    return jax.jit(search)


if __name__ == "__main__":
    main()
