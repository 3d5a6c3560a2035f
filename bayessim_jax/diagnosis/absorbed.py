"""Effects that are not there to be found, because other parameters of the simulator do the same.

At a point the predictions' derivatives along an effect's parameters are held against those along θ and along the
initial states. Where these leave nothing of them, the effect is a change of θ: wheels that slip are smaller wheels.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from bayessim_jax.diagnosis.bench import NEAR, Candidate, begin_point
from bayessim_jax.diagnosis.simulated_scene import SimulatedScene

__all__ = ["find_absorbed"]

NOTHING = 1e-6
"""Share of a derivative's length that counts as nothing."""


def find_absorbed(scene: SimulatedScene, z: Float[Array, " d"], sigma: Array) -> list[str]:
    """Names of the effects that θ and the initial states can take the place of, as far as their priors let them."""
    still = jnp.zeros((len(scene.shots.y), scene.shots.spread.size))
    found = []
    for k in range(len(scene.pairs)):
        candidate = Candidate((k,))
        own = begin_point(scene.parameters[k], scene.margin[k], NEAR)
        point = np.zeros(scene.d + scene.slots)
        point[: scene.d], point[scene.d : scene.d + len(own)] = z[: scene.d], own
        _, slopes = scene.expand(candidate, point, still, sigma)
        if _is_absorbed(np.asarray(slopes), scene.d, len(own), scene.slots):
            found.append(scene.name(candidate))
    return found


def _is_absorbed(slopes: Float[np.ndarray, "windows kn k"], d: int, own: int, slots: int) -> bool:
    """Whether the derivatives along a candidate's parameters lie in the span of those along θ and the states."""
    states, _ = np.linalg.qr(np.swapaxes(slopes[:, d + slots :], 1, 2))
    flat = np.swapaxes(slopes[:, : d + own], 1, 2)
    size = np.sqrt((flat[..., d:] ** 2).sum((0, 1)))
    left = (flat - states @ (np.swapaxes(states, 1, 2) @ flat)).reshape(-1, d + own)
    theta, effect = left[:, :d], left[:, d:]
    rest = effect - theta @ np.linalg.lstsq(theta, effect, rcond=None)[0]
    return bool((size > 0).any() and (np.sqrt((rest**2).sum(0)) <= NOTHING * size).all())
