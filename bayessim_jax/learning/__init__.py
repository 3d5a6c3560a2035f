"""Learners improve a policy against a belief over θ."""

from __future__ import annotations

from bayessim_jax.learning.policies import NetworkPolicy as NetworkPolicy
from bayessim_jax.learning.ppo import Ppo as Ppo

__all__ = ["NetworkPolicy", "Ppo"]
