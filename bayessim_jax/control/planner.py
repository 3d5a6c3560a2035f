"""The planner as a learner: what it learns is the belief it plans with."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float, Int, PRNGKeyArray

from bayessim_jax.beliefs import Particles, Truncated
from bayessim_jax.contracts import Belief, Restartable, Scalar, Task
from bayessim_jax.control.disco import Disco
from bayessim_jax.control.mppi import Plan

__all__ = ["Planner", "PlannerInfo", "PlannerPolicy"]


@struct.dataclass
class PlannerPolicy:
    """Replans at every control period; its memory is the plan. Its only chance is that of the samples of MPPI.

    Where `jitter` is not zero the action is disturbed by so many of the plan's standard deviations, within its limits.
    """

    disco: Disco
    knowledge: Particles
    jitter: Scalar

    def init(self) -> Plan:
        """Nothing planned yet."""
        return self.disco.init()

    def act(self, key: PRNGKeyArray, memory: Plan, observation: Float[Array, " obs"]) -> tuple[Any, Plan]:
        """The first action of the improved plan, and the rest of it."""
        plan_key, jitter_key = jax.random.split(key)
        action, memory, _ = self.disco.steer(plan_key, memory, observation, self.knowledge)
        mppi = self.disco.mppi
        if mppi.rounded:
            return action, memory
        noise = self.jitter * mppi.sigma * jax.random.normal(jitter_key, mppi.sigma.shape)
        return jnp.clip(action + noise, mppi.low, mppi.high), memory


@struct.dataclass
class PlannerInfo:
    """Nothing is simulated to improve a planner, so there is no return; it has no gradients to be wrong."""

    return_mean: Scalar
    """NaN."""
    nonfinite: Int[Array, ""]
    skipped: Int[Array, ""]


@struct.dataclass
class Planner:
    """A `Learner` whose state is what `Disco.digest` makes of the belief; the first belief is the uniform prior."""

    disco: Disco
    jitter: Scalar
    """Disturbance of recorded actions, in standard deviations of the plan's perturbations; none when judged."""

    @classmethod
    def create(cls, system: Restartable[Any], task: Task[Any], *, jitter: float = 0.0, **disco: Any) -> Planner:
        """`disco` are the arguments of `Disco.create`."""
        if jitter < 0:
            raise ValueError(f"planner: jitter is {jitter}; it must not be negative.")
        return cls(Disco.create(system, task, **disco), jnp.asarray(jitter, float))

    def init(self, key: PRNGKeyArray) -> Particles:
        """The prior."""
        return self.disco.digest(key, Truncated.uniform(self.disco.system.parameters, self.disco.components))

    def step(self, key: PRNGKeyArray, state: Particles, belief: Belief) -> tuple[Particles, PlannerInfo]:
        """Replace the belief."""
        return self.disco.digest(key, belief), PlannerInfo(jnp.array(jnp.nan), jnp.array(0), jnp.array(0))

    def policy(self, state: Particles, deterministic: bool = False) -> PlannerPolicy:
        """The planner with the belief of this state; `deterministic` leaves the jitter out."""
        return PlannerPolicy(self.disco, state, jnp.zeros_like(self.jitter) if deterministic else self.jitter)
