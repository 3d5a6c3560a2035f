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

from bayessim_jax.beliefs.triangular import solve_positive
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
    of the draws teach what is usual: Δy = B (1, y, u) + e by least squares; of every recording how long it lasts, mean
    and logarithmic spread of each channel of y and of e, and the least squares of its own e on (1, y, u); of these
    numbers the mean under each policy and one covariance, shrunk towards its diagonal. D, the sum over recordings of
    squared Mahalanobis distances, is then taken of the other draws and of what was observed, and

        strangeness = (log D − mean log D) / sd log D,

    sd the root mean square of those above the mean, for distances are skewed. 0 is usual; NaN where nothing counts, or
    there are less than `FEWEST` draws. Parameters differ between draws, so that what they explain is not strange.
    """
    draws = min(simulated.valid.shape[0], MOST)
    if draws < FEWEST:
        return jnp.array(jnp.nan)
    simulated = jax.tree.map(lambda leaf: leaf[:draws], simulated)
    taught = draws // 2
    counts = use & ~observed.diverged
    centre, unit = _moments(simulated, simulated.valid & counts[:, None])
    x, moves = _standardize(simulated, centre, unit)
    taken = jnp.where(counts[:, None, None], x[:taught], 0.0)
    slopes = _least_squares(taken.reshape(-1, x.shape[-1]), moves[:taught].reshape(-1, moves.shape[-1]), RIDGE)
    summaries = _summarize(x, moves, slopes)
    seen = _summarize(*_standardize(observed, centre, unit), slopes)

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


def _transitions(recordings: Recording) -> tuple[Array, Array]:
    """(y, u) and Δy."""
    now, later = recordings.observations[..., :-1, :], recordings.observations[..., 1:, :]
    return jnp.concatenate([now, recordings.actions], -1), later - now


def _moments(recordings: Recording, valid: Bool[Array, "*batch steps"]) -> tuple[Array, Array]:
    """Mean and standard deviation of what is observed and commanded."""
    given, _ = _transitions(recordings)
    mask = valid[..., None]
    total, axes = jnp.maximum(mask.sum(), 1), tuple(range(given.ndim - 1))
    mean = jnp.where(mask, given, 0.0).sum(axes) / total
    spread = jnp.sqrt(jnp.where(mask, (given - mean) ** 2, 0.0).sum(axes) / total)
    return mean, spread + 1e-6


def _standardize(recordings: Recording, centre: Array, unit: Array) -> tuple[Array, Array]:
    """(1, y, u) and Δy; rows of zeros where a transition did not happen."""
    given, moves = _transitions(recordings)
    given, moves = (given - centre) / unit, moves / unit[: moves.shape[-1]]
    x = jnp.concatenate([jnp.ones_like(given[..., :1]), jnp.clip(given, -10.0, 10.0)], -1)
    mask = recordings.valid[..., None]
    return jnp.where(mask, x, 0.0), jnp.where(mask, jnp.clip(moves, -10.0, 10.0), 0.0)


def _least_squares(
    x: Float[Array, "*batch rows k"], y: Float[Array, "*batch rows obs"], ridge: float
) -> Float[Array, "*batch k obs"]:
    """Slopes of y on x, held by a ridge of so much for every row that is not zero."""
    rows = jnp.maximum(x[..., 0].sum(-1), 1.0)[..., None, None]
    gram = jnp.einsum("...ti,...tj->...ij", x, x) + ridge * rows * jnp.eye(x.shape[-1])
    return solve_positive(gram, jnp.einsum("...ti,...tj->...ij", x, y))


def _summarize(x: Array, moves: Array, slopes: Array) -> Float[Array, "*batch k"]:
    """How long a recording lasts; the least squares of what `slopes` miss of its moves; mean and logarithmic spread of
    that, and of every channel.
    """
    size, there = moves.shape[-1], x[..., :1]
    count = jnp.maximum(there.sum(-2), 1.0)
    missed = moves - x @ slopes
    own = _least_squares(x, missed, OWN_RIDGE)
    parts = [there.mean(-2), own.reshape(*own.shape[:-2], -1)]
    for values in (x[..., 1 : 1 + size], missed):
        mean = values.sum(-2) / count
        square = (there * (values - mean[..., None, :]) ** 2).sum(-2) / count
        parts += [mean, 0.5 * jnp.log(square + 1e-8)]
    return jnp.concatenate(parts, -1)
