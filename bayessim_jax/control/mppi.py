"""Model predictive path integral control: a plan improved by the weighted mean of its random perturbations."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float, PRNGKeyArray

from bayessim_jax.contracts import Box, Discrete, Scalar
from bayessim_jax.control.noise import NOISES, PlanNoise
from bayessim_jax.spelling import find_named

__all__ = ["Mppi", "MppiInfo", "Plan"]

_HALVINGS = 16
_WORST = 1e30


@struct.dataclass
class Plan:
    """Actions from now on, one for each control period: what the next step starts from."""

    actions: Float[Array, "horizon act"]


@struct.dataclass
class MppiInfo:
    """What a person wants to see of one control step."""

    actions: Float[Array, "horizon act samples"]
    """The perturbed plans that were tried, within their limits."""
    costs: Float[Array, " samples"]
    """What each would cost, without the control cost; 1e30 where a number was not finite."""
    weights: Float[Array, " samples"]
    temperature: Scalar
    """λ."""
    effective: Scalar
    """1/Σ w²: how many samples the new plan stands on."""


@struct.dataclass
class Mppi:
    """Improves a plan u by perturbations ε ~ N(0, Σ) whose cost S has been simulated:

        w ∝ exp(−(S + α λ uᵀ Σ⁻¹ ε)/λ),   u ← u + Σ w ε

    and shifts it by one control period after the first action is taken. Perturbed actions are clipped to their limits
    before they are simulated, and ε is what is left. An index of a `Discrete` action is planned as a real number and
    rounded where it acts.

    Source: Williams et al. 2018
    """

    low: Float[Array, " act"]
    high: Float[Array, " act"]
    sigma: Float[Array, " act"]
    """Standard deviation of the perturbations, in the actions' units."""
    temperature: Scalar
    """λ, in the unit of the cost; with `share` its largest value."""
    control_cost: Scalar
    """α: 1 charges deviations from doing nothing as the theory has it, 0 nothing."""
    share: Scalar | None
    """Where given, λ is lowered at every step until no more than this share of the samples is in effect."""
    noise: PlanNoise
    samples: int = struct.field(pytree_node=False)
    rounded: bool = struct.field(pytree_node=False)

    @classmethod
    def create(
        cls,
        actions: Box | Discrete,
        horizon: int = 30,
        samples: int = 500,
        *,
        sigma: float | Float[Array, " act"] = 0.5,
        temperature: float = 10.0,
        control_cost: float = 1.0,
        share: float | None = None,
        noise: str | PlanNoise = "white",
    ) -> Mppi:
        """`sigma` is in half-widths of the actions' limits, the other numbers as documented above."""
        if horizon < 1 or samples < 1:
            raise ValueError(f"MPPI: horizon is {horizon} and samples {samples}; both must be positive.")
        if not temperature > 0:
            raise ValueError(f"MPPI: temperature is {temperature}; it must be above 0.")
        if share is not None and not 0 < share < 1:
            raise ValueError(f"MPPI: share is {share}; it must lie between 0 and 1.")
        if isinstance(actions, Discrete):
            low, high = jnp.full(1, -0.5), jnp.full(1, actions.count - 0.5)
        else:
            low, high = actions.low, actions.high
        return cls(
            low=low,
            high=high,
            sigma=jnp.broadcast_to(jnp.asarray(sigma, float), low.shape) * (high - low) / 2,
            temperature=jnp.asarray(temperature, float),
            control_cost=jnp.asarray(control_cost, float),
            share=None if share is None else jnp.asarray(share, float),
            noise=find_named(noise, NOISES, "unknown noise")(horizon) if isinstance(noise, str) else noise,
            samples=samples,
            rounded=isinstance(actions, Discrete),
        )

    def init(self) -> Plan:
        """The middle of the limits all along."""
        return Plan(jnp.broadcast_to((self.low + self.high) / 2, (self.noise.horizon, self.low.size)))

    def improve(
        self,
        key: PRNGKeyArray,
        plan: Plan,
        cost: Callable[[Float[Array, "horizon act samples"]], Float[Array, " samples"]],
    ) -> tuple[Plan, MppiInfo]:
        """The better plan, not shifted yet; `cost` is asked once, for all perturbed plans."""
        u = plan.actions[..., None]
        epsilon = self.sigma[:, None] * self.noise.draw(key, self.low.size, self.samples)
        tried = jnp.clip(u + epsilon, self.low[:, None], self.high[:, None])
        epsilon = tried - u
        costs = cost(self.act(tried))
        costs = jnp.where(jnp.isfinite(costs), costs, _WORST)
        middle = (self.low + self.high) / 2
        effort = jnp.einsum("ha,hak->k", self.noise.whiten(plan.actions - middle) / self.sigma**2, epsilon)
        temperature = self._temperature(costs)
        weights = jax.nn.softmax(-(costs - costs.min()) / temperature - self.control_cost * effort)
        actions = plan.actions + jnp.einsum("hak,k->ha", epsilon, weights)
        return Plan(actions), MppiInfo(tried, costs, weights, temperature, 1.0 / (weights**2).sum())

    def act(self, planned: Array) -> Array:
        """What the system takes for what was planned."""
        if not self.rounded:
            return planned
        return jnp.clip(jnp.round(planned), 0.0, self.high[0] - 0.5)

    def shift(self, plan: Plan) -> Plan:
        """The plan one control period later; its last action is held."""
        return Plan(jnp.concatenate([plan.actions[1:], plan.actions[-1:]]))

    def _temperature(self, costs: Float[Array, " samples"]) -> Scalar:
        """λ, or the lower λ at which the wanted share of samples is in effect, by bisection of its logarithm."""
        if self.share is None:
            return self.temperature
        gap, wanted = costs - costs.min(), self.share * costs.size

        def halve(_: int, bounds: tuple[Scalar, Scalar]) -> tuple[Scalar, Scalar]:
            low, high = bounds
            middle = 0.5 * (low + high)
            weights = jnp.exp(-gap * jnp.exp(-middle))
            many = weights.sum() ** 2 / (weights**2).sum() > wanted
            return jnp.where(many, low, middle), jnp.where(many, middle, high)

        top = jnp.log(self.temperature)
        return jnp.exp(jax.lax.fori_loop(0, _HALVINGS, halve, (top - 14.0, top + 1e-3))[1])
