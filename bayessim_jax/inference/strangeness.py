"""Whether recordings look like any that the simulator makes: what no posterior can say of itself.

A network answers for whatever it is given. Where the simulator lacks something, what it lacks is read as parameters,
and the posterior is as narrow as ever. What is compared here has nothing to do with networks: how every channel moves,
given where it is and what is commanded, beside sets of recordings that were simulated under the same policies with
parameters from around the belief.

Source: Gelman, Meng and Stern 1996; Schmitt et al. 2024
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from bayessim_jax.contracts import Recording, Scalar

__all__ = ["STRANGE", "strangeness"]

STRANGE = 5.0
"""Standard deviations from which recordings are called strange."""
FEWEST = 32
"""Draws that say what is usual."""
MOST = 256
"""More say no more."""
RIDGE, OWN_RIDGE = 1e-3, 1e-2
"""On least squares in standard units: over all recordings, and of one."""


def strangeness(simulated: Recording, observed: Recording, use: Bool[Array, " set"]) -> Scalar:
    """By how many standard deviations observed recordings lie farther out than simulated ones, of which it is a set.

    `simulated` has axes (draw of θ, recording, …), `observed` the axis of recordings, and `use` says which count. Half
    of the draws teach what is usual: Δy = B (1, y, u) + e by least squares, and of the mean and the logarithmic spread
    of y and of e, channel by channel in every recording, the mean under each policy and one covariance. D, the sum over
    recordings of squared Mahalanobis distances, is then taken of the other draws and of what was observed, and

        strangeness = (log D − mean log D) / sd log D,

    sd the root mean square of those above the mean, for distances are skewed. 0 is usual; NaN where nothing counts, or
    there are less than `FEWEST` draws. Parameters differ between draws, so that what they explain is not strange.
    """
    draws = simulated.valid.shape[0]
    if draws < FEWEST:
        return jnp.array(jnp.nan)
    simulated = jax.tree.map(lambda leaf: leaf[:MOST], simulated)
    taught = min(draws, MOST) // 2
    counts = use & ~observed.diverged
    centre, unit = _moments(simulated, simulated.valid & counts[:, None])
    standard = lambda recording: _standardize(recording, centre, unit)  # noqa: E731
    x, dy, valid = standard(simulated)
    weights = (valid & counts[:, None]).at[taught:].set(False).reshape(-1).astype(x.dtype)
    rows, moves = x.reshape(-1, x.shape[-1]), dy.reshape(-1, dy.shape[-1])
    gram = (rows * weights[:, None]).T @ rows
    slopes = jnp.linalg.solve(
        gram + RIDGE * jnp.maximum(weights.sum(), 1.0) * jnp.eye(gram.shape[0]), (rows * weights[:, None]).T @ moves
    )
    summaries = _summarize(x, dy, valid, slopes)
    seen = _summarize(*standard(observed), slopes)

    means = summaries[:taught].mean(0)
    left = jnp.where(counts[:, None], summaries[:taught] - means, 0.0).reshape(-1, summaries.shape[-1])
    recordings = jnp.maximum(taught * counts.sum(), 1)
    units = jnp.sqrt((left**2).sum(0) / recordings) + 1e-6
    left = left / units
    shrunk = left.shape[1] / (left.shape[1] + recordings)
    covariance = (1 - shrunk) * left.T @ left / recordings + (shrunk + 1e-4) * jnp.eye(left.shape[1])
    root = jnp.linalg.cholesky(covariance)

    def distance(summary: Float[Array, "set k"]) -> Scalar:
        off = jnp.where(counts[:, None], summary - means, 0.0) / units
        return jnp.sum(jax.scipy.linalg.solve_triangular(root, off.T, lower=True) ** 2)

    usual = jnp.log(jax.vmap(distance)(summaries[taught:]) + 1e-9)
    over = jnp.maximum(usual - usual.mean(), 0.0)
    spread = jnp.sqrt((over**2).sum() / jnp.maximum((over > 0).sum(), 1))
    found = (jnp.log(distance(seen) + 1e-9) - usual.mean()) / (spread + 1e-6)
    return jnp.where(counts.any(), found, jnp.nan)


def _moments(recording: Recording, valid: Bool[Array, "*batch steps"]) -> tuple[Array, Array]:
    """Mean and standard deviation of what is observed and commanded."""
    both = jnp.concatenate([recording.observations[..., :-1, :], recording.actions], -1)
    mask = valid[..., None]
    total, axes = jnp.maximum(mask.sum(), 1), tuple(range(both.ndim - 1))
    mean = jnp.where(mask, both, 0.0).sum(axes) / total
    spread = jnp.sqrt(jnp.where(mask, (both - mean) ** 2, 0.0).sum(axes) / total)
    return mean, spread + 1e-6


def _standardize(recording: Recording, centre: Array, unit: Array) -> tuple[Array, Array, Array]:
    """(1, y, u), Δy, and which transitions there are."""
    size = recording.observations.shape[-1]
    now = recording.observations[..., :-1, :]
    both = (jnp.concatenate([now, recording.actions], -1) - centre) / unit
    moves = (recording.observations[..., 1:, :] - now) / unit[:size]
    mask = recording.valid[..., None]
    x = jnp.concatenate([jnp.ones_like(both[..., :1]), jnp.clip(both, -10.0, 10.0)], -1)
    return jnp.where(mask, x, 0.0), jnp.where(mask, jnp.clip(moves, -10.0, 10.0), 0.0), recording.valid


def _summarize(x: Array, dy: Array, valid: Array, slopes: Array) -> Float[Array, "*batch k"]:
    """How long it lasts; mean and logarithmic spread of every channel, and of what the least squares miss of its moves;
    and the least squares of the latter.
    """
    size = dy.shape[-1]
    count = jnp.maximum(valid.sum(-1), 1)[..., None]
    missed = jnp.where(valid[..., None], dy - x @ slopes, 0.0)
    gram = jnp.einsum("...ti,...tj->...ij", x, x) + OWN_RIDGE * count[..., None] * jnp.eye(x.shape[-1])
    own = jnp.linalg.solve(gram, jnp.einsum("...ti,...tj->...ij", x, missed))
    parts = [valid.mean(-1, keepdims=True), own.reshape(*own.shape[:-2], -1)]
    for values in (x[..., 1 : 1 + size], missed):
        mean = values.sum(-2) / count
        square = jnp.where(valid[..., None], (values - mean[..., None, :]) ** 2, 0.0).sum(-2) / count
        parts += [mean, 0.5 * jnp.log(square + 1e-8)]
    return jnp.concatenate(parts, -1)
