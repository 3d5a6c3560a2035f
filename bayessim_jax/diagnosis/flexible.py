"""A residual force without a name: the ceiling that named effects are held against."""

from __future__ import annotations

import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float

from bayessim_jax.effects import EffectParameter, ForceEffect, Moment, Scales
from bayessim_jax.effects.contract import Memory, Number, Values
from bayessim_jax.effects.places import joints
from bayessim_jax.trigonometry import sincos

__all__ = ["FEATURES", "FLEXIBLE", "UNITS", "FlexibleForce", "features"]

RANDOM = 18
FIXED = 6
FEATURES = RANDOM + FIXED
UNITS = ("centre", "position", "speed", "force")
_DRAWS = np.random.default_rng(7)
FREQUENCIES = _DRAWS.normal(size=(RANDOM, 3)) * np.array([1.6, 1.6, 1.0])
PHASES = _DRAWS.uniform(0, 2 * np.pi, size=RANDOM)


def features(position: Number, velocity: Number, drive: Number, units: Values) -> Float[Array, "... features"]:
    """Random Fourier features of a joint's scaled state and drive, and steps and slopes in its velocity.

    Source: Rahimi and Recht 2007
    """
    q = (position - units["centre"]) / units["position"]
    v, u = velocity / units["speed"], drive / units["force"]
    state = jnp.stack([q, v, u], -1)
    steps = jnp.stack([jnp.tanh(v / 0.05), jnp.tanh(v / 0.3), v, v * abs(v), q, u], -1)
    angles = (state[..., None, :] * FREQUENCIES).sum(-1) + PHASES
    return jnp.concatenate([sincos(angles)[1], steps], -1)


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
        weights = jnp.stack([values[f"w{k}"] for k in range(FEATURES)])
        return weights @ _forces(values, moment), memory

    def slopes(self, values: Values, moment: Moment) -> Float[Array, " numbers"]:
        """Along the weights F φ_k, and 0 along the units, which do not move."""
        return jnp.append(_forces(values, moment), jnp.zeros(len(UNITS)))


FLEXIBLE = FlexibleForce()
"""The one there is: programs that it stands in are found again."""


def _forces(values: Values, moment: Moment) -> Float[Array, " features"]:
    """F φ_k."""
    return values["force"] * features(moment.position, moment.velocity, moment.drive, values)


def _fixed(name: str, value: float) -> EffectParameter:
    """A number that hardly moves."""
    room = 1e-9 * max(abs(value), 1e-3)
    return EffectParameter(name, "", value - room, value + room, value, value)
