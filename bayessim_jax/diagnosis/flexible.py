"""A residual force without a name: the ceiling that named effects are held against."""

from __future__ import annotations

import jax.numpy as jnp
import mujoco
import numpy as np

from bayessim_jax.effects import EffectParameter, ForceEffect, Moment, Scales
from bayessim_jax.effects.contract import Memory, Number, Values

__all__ = ["FEATURES", "FlexibleForce", "features"]

RANDOM = 18
FIXED = 6
FEATURES = RANDOM + FIXED
_DRAWS = np.random.default_rng(7)
FREQUENCIES = _DRAWS.normal(size=(RANDOM, 3)) * np.array([1.6, 1.6, 1.0])
PHASES = _DRAWS.uniform(0, 2 * np.pi, size=RANDOM)


def features(position: Number, velocity: Number, drive: Number, scales: Scales) -> list[Number]:
    """Random Fourier features of a joint's scaled state and drive, and steps and slopes in its velocity.

    Source: Rahimi and Recht 2007
    """
    q = (position - scales.centre) / scales.position
    v, u = velocity / scales.speed, drive / scales.force
    waves = [jnp.cos(w[0] * q + w[1] * v + w[2] * u + b) for w, b in zip(FREQUENCIES, PHASES, strict=True)]
    return [*waves, jnp.tanh(v / 0.05), jnp.tanh(v / 0.3), v, v * abs(v), q, u]


class FlexibleForce(ForceEffect):
    """τ = F Σ w_k φ_k(q, v, u): any smooth force of one joint's own state and drive, with F the joint's scale."""

    name = "flexible_force"

    def __init__(self, place: str, scales: Scales) -> None:
        self.place, self.scales = place, scales

    def places(self, model: mujoco.MjModel) -> list[str]:
        """The one joint that it is made for."""
        return [self.place]

    def parameters(self, place: str, scales: Scales) -> tuple[EffectParameter, ...]:
        """The weights."""
        return tuple(EffectParameter(f"w{k}", "", -0.6, 0.6, 0.0, 0.01) for k in range(FEATURES))

    def force(self, values: Values, memory: Memory, moment: Moment) -> tuple[Number, Memory]:
        """The weighted sum."""
        phi = features(moment.position, moment.velocity, moment.drive, self.scales)
        return self.scales.force * sum(values[f"w{k}"] * x for k, x in enumerate(phi)), memory
