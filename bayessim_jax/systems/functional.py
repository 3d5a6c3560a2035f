"""A system from three functions: the shortest way to bring one's own simulator."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float, PRNGKeyArray

from bayessim_jax.contracts import Box, Discrete

if TYPE_CHECKING:
    from collections.abc import Callable

__all__ = ["FunctionalSystem", "from_functions"]


@struct.dataclass
class FunctionalSystem:
    """A `System` that calls the user's functions; made by `from_functions`."""

    parameters: Box
    observations: Box
    actions: Box | Discrete
    noise: Float[Array, " obs"]
    dt: float = struct.field(pytree_node=False)
    reset_fn: Callable[..., Any] = struct.field(pytree_node=False)
    step_fn: Callable[..., Any] = struct.field(pytree_node=False)
    observe_fn: Callable[..., Any] = struct.field(pytree_node=False)

    def reset(self, key: PRNGKeyArray, theta: Float[Array, " d"]) -> Any:
        """Draw an initial state."""
        return self.reset_fn(key, theta)

    def step(self, theta: Float[Array, " d"], state: Any, action: Float[Array, " act"]) -> Any:
        """Advance the state by one control period."""
        return self.step_fn(theta, state, action)

    def observe(self, theta: Float[Array, " d"], state: Any) -> Float[Array, " obs"]:
        """What the sensors show of a state, before noise."""
        return self.observe_fn(theta, state)


def from_functions(
    *,
    parameters: Box,
    observations: Box,
    actions: Box | Discrete,
    noise: float | Float[Array, " obs"],
    dt: float,
    reset: Callable[..., Any],
    step: Callable[..., Any],
    observe: Callable[..., Any] = lambda theta, state: state,
) -> FunctionalSystem:
    """Build a `System` from `reset(key, θ)`, `step(θ, state, action)` and `observe(θ, state)`, and try it once.

    Shapes and numbers are checked at the centre of the parameters' box, so that a slip is told here in one line and
    not from inside a compiled loop. Raises `ValueError`.
    """
    if not dt > 0:
        raise ValueError(f"dt is {dt}; it is the control period in seconds, above 0.")
    sd = np.asarray(noise, float)
    if sd.shape not in ((), (observations.size,)) or not (sd >= 0).all():
        raise ValueError(
            f"noise is {sd.tolist()}; it is a standard deviation, 0 or more, for all {observations.size} "
            "observations or for each."
        )
    system = FunctionalSystem(
        parameters=parameters,
        observations=observations,
        actions=actions,
        noise=jnp.broadcast_to(jnp.asarray(sd, float), (observations.size,)),
        dt=dt,
        reset_fn=reset,
        step_fn=step,
        observe_fn=observe,
    )
    theta = (parameters.low + parameters.high) / 2
    state = system.reset(jax.random.key(0), theta)
    action = jnp.zeros(1) if isinstance(actions, Discrete) else (actions.low + actions.high) / 2
    after = system.step(theta, state, action)
    before, now = (jax.tree.map(_kind, s) for s in (state, after))
    if jax.tree.structure(state) != jax.tree.structure(after) or before != now:
        raise ValueError(f"step returned a state of {now}; reset made {before}. Return the same.")
    seen = jnp.asarray(system.observe(theta, after))
    if seen.shape != (observations.size,):
        raise ValueError(
            f"observe returned shape {seen.shape}; observations name {observations.size} channels "
            f"{observations.names}: return shape ({observations.size},)."
        )
    if not bool(jnp.isfinite(seen).all()):
        raise ValueError(
            f"step gives non-finite observations {seen.tolist()} at the centre of the prior, θ = {theta.tolist()}; "
            "check its equations or narrow the parameters' box."
        )
    return system


def _kind(leaf: Any) -> str:
    """Type and shape, as `float32[2]`."""
    array = jnp.asarray(leaf)
    return f"{array.dtype}{list(array.shape)}"
