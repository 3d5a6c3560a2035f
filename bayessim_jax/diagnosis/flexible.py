"""A residual force without a name: the ceiling that named effects are held against."""

from __future__ import annotations

import jax.numpy as jnp
import mujoco
import numpy as np

from bayessim_jax.effects import EffectParameter, ForceEffect, Moment, Scales
from bayessim_jax.effects.contract import Memory, Number, Values
from bayessim_jax.effects.places import joints

__all__ = ["FEATURES", "FLEXIBLE", "UNITS", "FlexibleForce", "features"]

RANDOM = 18
FIXED = 6
FEATURES = RANDOM + FIXED
UNITS = ("centre", "position", "speed", "force")
_DRAWS = np.random.default_rng(7)
FREQUENCIES = _DRAWS.normal(size=(RANDOM, 3)) * np.array([1.6, 1.6, 1.0])
PHASES = _DRAWS.uniform(0, 2 * np.pi, size=RANDOM)


def features(position: Number, velocity: Number, drive: Number, units: Values) -> list[Number]:
    """Random Fourier features of a joint's scaled state and drive, and steps and slopes in its velocity.

    Source: Rahimi and Recht 2007
    """
    q = (position - units["centre"]) / units["position"]
    v, u = velocity / units["speed"], drive / units["force"]
    waves = [jnp.cos(w[0] * q + w[1] * v + w[2] * u + b) for w, b in zip(FREQUENCIES, PHASES, strict=True)]
    return [*waves, jnp.tanh(v / 0.05), jnp.tanh(v / 0.3), v, v * abs(v), q, u]


class FlexibleForce(ForceEffect):
    """τ = F Σ w_k φ_k(q, v, u): any smooth force of one joint's own state and drive, with F the joint's scale.

    The units that recordings decide are parameters as well, within a range too narrow to matter: programs know only
    that there are such numbers, and serve other recordings.
    """

    name = "flexible_force"

    def places(self, model: mujoco.MjModel) -> list[str]:
        """Every hinge and slide."""
        return joints(model)

    def parameters(self, place: str, scales: Scales) -> tuple[EffectParameter, ...]:
        """The weights, and the units."""
        weights = (EffectParameter(f"w{k}", "", -0.6, 0.6, 0.0, 0.01) for k in range(FEATURES))
        return (*weights, *(_fixed(name, getattr(scales, name)) for name in UNITS))

    def force(self, values: Values, memory: Memory, moment: Moment) -> tuple[Number, Memory]:
        """The weighted sum."""
        phi = features(moment.position, moment.velocity, moment.drive, values)
        return values["force"] * sum(values[f"w{k}"] * x for k, x in enumerate(phi)), memory


FLEXIBLE = FlexibleForce()
"""The one there is: programs that it stands in are found again."""


def _fixed(name: str, value: float) -> EffectParameter:
    """A number that hardly moves."""
    room = 1e-9 * max(abs(value), 1e-3)
    return EffectParameter(name, "", value - room, value + room, value, value)
