"""A simulated target: a system of this package whose θ is hidden from everything else."""

from __future__ import annotations

from typing import Any

from flax import struct
from jaxtyping import Array, Float, PRNGKeyArray

from bayessim_jax.contracts import Policy, Recording, System, Task
from bayessim_jax.rollout import rollout

__all__ = ["SimulatedTarget"]


@struct.dataclass
class SimulatedTarget:
    """A system with hidden parameters θ*, in the units of `system.parameters`; θ* is a leaf, so targets batch."""

    system: System[Any]
    task: Task[Any] | None
    """What is paid for; None for no reward, and episodes that never end."""
    theta: Float[Array, " d"]

    def record(self, key: PRNGKeyArray, policy: Policy, steps: int) -> Recording:
        """Let the policy act for at most `steps` control periods and return what was measured."""
        return rollout(key, self.system, self.theta, policy, steps, self.task)
