"""DISCO: model predictive path integral control whose model is a belief over θ."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float, PRNGKeyArray

from bayessim_jax.beliefs import GaussianMixture, Particles, reduce
from bayessim_jax.contracts import Belief, Restartable, Scalar, Task
from bayessim_jax.control.mppi import Mppi, MppiInfo, Plan
from bayessim_jax.control.risk import RISKS, Mean, Risk
from bayessim_jax.control.unscented import components, sigma_points
from bayessim_jax.spelling import find_named, near_miss

__all__ = ["USES", "Disco"]

USES = ("mean", "sampled", "particles", "unscented")
_DRAWS = 1024


@struct.dataclass
class Disco:
    """Plans with a system's model under a belief; `use` says how θ enters the simulated plans:

    - `mean`: every plan under E θ;
    - `sampled`: every plan under a θ of its own, so that the weights of MPPI average over the belief too;
    - `particles`: every plan under the same few draws, judged by their risk;
    - `unscented`: every plan under the sigma points of every component of the belief, with their weights.

    θ, and so the belief, is traced: a new one never recompiles. Planning begins in the state that `system.restart`
    makes of an observation.

    Source: Barcelos et al. 2020
    """

    system: Restartable[Any]
    task: Task[Any]
    mppi: Mppi
    risk: Risk
    use: str = struct.field(pytree_node=False)
    particles: int = struct.field(pytree_node=False)
    """Draws of θ for `particles`."""
    components: int = struct.field(pytree_node=False)
    """Gaussians for `unscented`; those of a belief that has more are merged."""

    @classmethod
    def create(
        cls,
        system: Restartable[Any],
        task: Task[Any],
        use: str = "mean",
        *,
        risk: str | Risk = "mean",
        particles: int = 16,
        components: int = 5,
        **mppi: Any,
    ) -> Disco:
        """`mppi` are the arguments of `Mppi.create`."""
        if not hasattr(system, "restart"):
            raise ValueError("DISCO plans from what the sensors show: give the system a `restart(theta, observation)`.")
        if use not in USES:
            raise ValueError(f"unknown use of θ {use!r}: {near_miss(use, USES)}")
        risk = find_named(risk, RISKS, "unknown risk")() if isinstance(risk, str) else risk
        if use in ("mean", "sampled") and not isinstance(risk, Mean):
            raise ValueError(
                f"use {use!r} sees one θ for each plan and has no risk over θ: take particles or unscented."
            )
        if particles < 1 or components < 1:
            raise ValueError(f"DISCO: particles is {particles}, components {components}; both must be positive.")
        return cls(system, task, Mppi.create(system.actions, **mppi), risk, use, particles, components)

    def init(self) -> Plan:
        """The controller's state at the start of an episode."""
        return self.mppi.init()

    def act(
        self, key: PRNGKeyArray, plan: Plan, observation: Float[Array, " obs"], belief: Belief
    ) -> tuple[Float[Array, " act"], Plan, MppiInfo]:
        """The action for an observation, the plan from the next step on, and what was considered."""
        digest_key, key = jax.random.split(key)
        return self.steer(key, plan, observation, self.digest(digest_key, belief))

    def digest(self, key: PRNGKeyArray, belief: Any) -> Particles:
        """What `steer` needs of a belief, to be computed once where the belief is used for many control steps."""
        if self.use == "mean":
            return Particles(belief.mean()[None], jnp.zeros(1))
        if self.use == "unscented":
            points, weights = sigma_points(_resize(components(belief), self.components))
            box = self.system.parameters
            return Particles(jnp.clip(points, box.low, box.high), jnp.log(weights))
        count = max(_DRAWS, self.mppi.samples)
        return Particles(jax.vmap(belief.sample)(jax.random.split(key, count)), jnp.zeros(count))

    def steer(
        self, key: PRNGKeyArray, plan: Plan, observation: Float[Array, " obs"], digest: Particles
    ) -> tuple[Float[Array, " act"], Plan, MppiInfo]:
        """`act` with the belief's `digest`."""
        pick_key, key = jax.random.split(key)
        better, info = self.mppi.improve(key, plan, lambda u: self._judge(pick_key, observation, digest, u))
        return self.mppi.act(better.actions[0]), self.mppi.shift(better), info

    def _judge(
        self,
        key: PRNGKeyArray,
        observation: Float[Array, " obs"],
        digest: Particles,
        actions: Float[Array, "horizon act samples"],
    ) -> Float[Array, " samples"]:
        """The risk of every plan."""
        if self.use == "sampled":
            theta = _pick(key, digest, actions.shape[-1]).positions
            state = jax.vmap(self.system.restart, (0, None))(theta, observation)
            return self._simulate(theta, state, actions, 0)
        points = _pick(key, digest, self.particles) if self.use == "particles" else digest

        def under(theta: Float[Array, " d"]) -> Float[Array, " samples"]:
            state = self.system.restart(theta, observation)
            every = jax.tree.map(lambda x: jnp.broadcast_to(x, (actions.shape[-1], *jnp.shape(x))), state)
            return self._simulate(theta, every, actions, None)

        return self.risk(jax.vmap(under)(points.positions), points.weights)

    def _simulate(
        self, theta: Array, state: Any, actions: Float[Array, "horizon act samples"], axis: int | None
    ) -> Float[Array, " samples"]:
        """Σ cost along every plan; the samples are the last axis of all that is computed, for the vector units."""

        def one(theta: Any, state: Any, action: Any) -> tuple[Any, Scalar]:
            after = self.system.step(theta, state, action)
            return after, -self.task.reward(state, action, after)

        def step(carry: Any, action: Float[Array, "act samples"]) -> Any:
            state, total = carry
            after, cost = jax.vmap(one, (axis, 0, -1))(theta, state, action)
            return (after, total + cost), None

        return jax.lax.scan(step, (state, jnp.zeros(actions.shape[-1])), actions)[0][1]


def _resize(mixture: GaussianMixture, count: int) -> GaussianMixture:
    """So many components, the missing ones without weight: the shape of a digest is that of the next one."""
    missing = count - mixture.log_weights.size
    if missing <= 0:
        return reduce(mixture, count)
    filled = jax.tree.map(lambda leaf: jnp.concatenate([leaf, jnp.repeat(leaf[:1], missing, 0)]), mixture)
    return filled.replace(log_weights=filled.log_weights.at[-missing:].set(-jnp.inf))


def _pick(key: PRNGKeyArray, digest: Particles, count: int) -> Particles:
    """A stretch of independent draws, at random: as good as drawing anew, and cheaper."""
    size = digest.log_weights.size
    rows = (jax.random.randint(key, (), 0, size) + jnp.arange(count)) % size
    return Particles(digest.positions[rows], jnp.zeros(count))
