"""From an embedding to a Gaussian mixture over standardized parameters: heads, and linear features for them."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float, PRNGKeyArray

from bayessim_jax.beliefs.mixture import GaussianMixture
from bayessim_jax.beliefs.triangular import invert
from bayessim_jax.inference.encoders import glorot

__all__ = ["MixtureHead"]


@struct.dataclass
class MixtureHead:
    """K full-covariance Gaussians whose parameters are a function of an embedding.

    The network gives logits, means μₖ and lower-triangular factors Aₖ of the precisions Λₖ = AₖᵀAₖ; the diagonal of
    Aₖ is an exponential, so it is positive. In these terms a log density needs no solve:

        log N(z | μ, Λ⁻¹) = Σ log diag A − ½ ‖A (z − μ)‖² − d/2 log 2π

    The last layer is linear in (μ, log diag A, A below the diagonal): a change of units of z is a change of it.

    Source: Bishop 1994
    """

    components: int = struct.field(pytree_node=False, default=5)
    hidden: int = struct.field(pytree_node=False, default=64)
    """Width of the layer before the outputs; 0 for outputs that are linear in the embedding."""

    def init(self, key: PRNGKeyArray, inputs: int, d: int) -> dict[str, Array]:
        """Small output weights, and means spread over the unit ball so that components differ."""
        mean_key, weights_key = jax.random.split(key)
        k, width = self.components, self.hidden or inputs
        below = d * (d - 1) // 2
        shapes = [(width, k * (1 + 2 * d + below))]
        if self.hidden:
            shapes.append((inputs, width))
        out, *hidden = glorot(weights_key, *shapes)
        params = {
            "logits": jnp.zeros(k),
            "mean": 0.7 * jax.random.normal(mean_key, (k, d)),
            "log_diagonal": jnp.zeros((k, d)),
            "below": jnp.zeros((k, below)),
            "out": 0.1 * out,
        }
        return params | ({"w": hidden[0], "b": jnp.zeros(width)} if self.hidden else {})

    def apply(self, params: Any, x: Float[Array, "*n inputs"]) -> tuple[Array, Array, Array]:
        """Log weights (*n, K), means (*n, K, d) and precision factors A (*n, K, d, d)."""
        if self.hidden:
            x = jax.nn.gelu(x @ params["w"] + params["b"])
        k, d = params["mean"].shape
        out = (x @ params["out"]).reshape(*x.shape[:-1], k, -1)
        logits, mean, log_diagonal, below = jnp.split(out, [1, 1 + d, 1 + 2 * d], axis=-1)
        log_diagonal = jnp.clip(log_diagonal + params["log_diagonal"], -7.0, 12.0)
        entries = jnp.concatenate([jnp.exp(log_diagonal), below + params["below"]], axis=-1)
        factor = jnp.dot(entries, _places(d), precision="highest").reshape(*entries.shape[:-1], d, d)
        return jax.nn.log_softmax(logits[..., 0] + params["logits"]), mean + params["mean"], factor

    def log_prob(self, params: Any, x: Float[Array, "*n inputs"], z: Float[Array, "*n d"]) -> Float[Array, "*n"]:
        """Log density log q(z | x)."""
        log_weights, means, factors = self.apply(params, x)
        residual = jnp.einsum("...ij,...j->...i", factors, z[..., None, :] - means)
        log_diagonal = jnp.log(jnp.diagonal(factors, axis1=-2, axis2=-1)).sum(-1)
        log_normal = log_diagonal - 0.5 * (residual**2).sum(-1) - 0.5 * z.shape[-1] * jnp.log(2 * jnp.pi)
        return jax.nn.logsumexp(log_weights + log_normal, axis=-1)

    def mixture(self, params: Any, x: Float[Array, " inputs"]) -> GaussianMixture:
        """q(z | x) as a belief."""
        log_weights, means, factors = self.apply(params, x)
        return GaussianMixture(log_weights, means, jax.vmap(invert)(factors))  # Σ = A⁻¹ A⁻ᵀ

    def change_units(self, params: Any, shift: Float[Array, " d"], scale: Float[Array, " d"]) -> Any:
        """The parameters that give the same density for z' = (z − shift) / scale."""
        k, d = params["mean"].shape
        rows, columns = jnp.tril_indices(d, -1)
        out = params["out"].reshape(-1, k, 1 + 2 * d + rows.size)
        logits, mean, log_diagonal, below = jnp.split(out, [1, 1 + d, 1 + 2 * d], axis=-1)
        out = jnp.concatenate([logits, mean / scale, log_diagonal, below * scale[columns]], axis=-1)
        return params | {
            "out": out.reshape(params["out"].shape),
            "mean": (params["mean"] - shift) / scale,
            "log_diagonal": params["log_diagonal"] + jnp.log(scale),
            "below": params["below"] * scale[columns],
        }


def _places(d: int) -> Float[np.ndarray, "entries d*d"]:
    """Where the diagonal and what is below it stand in a matrix read row by row.

    A product with it costs nothing to compile, and neither do its derivatives; writing to indices is a loop on a CPU.
    """
    rows, columns = (np.concatenate([np.arange(d), below]) for below in np.tril_indices(d, -1))
    places = np.zeros((rows.size, d * d), np.float32)
    places[np.arange(rows.size), d * rows + columns] = 1.0
    return places
