"""Engines step systems, and targets are what is to be controlled."""

from __future__ import annotations

from bayessim_jax.engines.gymnasium import GymnasiumTarget as GymnasiumTarget
from bayessim_jax.engines.gymnasium import gymnasium_target as gymnasium_target
from bayessim_jax.engines.simulated import SimulatedTarget as SimulatedTarget

__all__ = ["GymnasiumTarget", "SimulatedTarget", "gymnasium_target"]
