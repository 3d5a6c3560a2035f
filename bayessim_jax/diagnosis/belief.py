"""What is believed of a candidate's numbers: Laplace's covariance, wider by what is not known of the laws' form."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from bayessim_jax.diagnosis.bench import Bench
from bayessim_jax.diagnosis.verdict import Entry
from bayessim_jax.inference.shooting import robust_covariance

__all__ = ["covariance_of", "moments_of_effects", "moments_of_theta"]


def covariance_of(bench: Bench, entry: Entry) -> Float[np.ndarray, "k k"]:
    """Covariance of z, θ's and the effects', in the coordinates of a fit.

    That of the fit, wide where windows disagree (`robust_covariance`), and for the number y = value(z) of an effect a
    variance (f y)² more, f its `EffectParameter.form`: recordings that fix a number to a thousandth fix it within one
    form of its law. For the moments of an event y is how far they are apart. θ follows the number as the likelihood
    lets it: −H_θθ⁻¹ H_θx with H the fit's precision.
    """
    d = bench.d
    size = d + len(bench.columns(entry.candidate))
    covariance = robust_covariance(entry.fit)[:size, :size].copy()
    form = np.array([bench.parameters[i].form for i in bench.columns(entry.candidate)])
    # no wider than the prior, whose standard deviation is 1
    own = np.minimum(form * _sizes(bench, entry) / np.maximum(_slopes(bench, entry), 1e-12), 1.0)
    precision = np.asarray(entry.fit.precision)[:size, :size]
    follow = np.concatenate([-np.linalg.solve(precision[:d, :d], precision[:d, d:]), np.eye(size - d)])
    return covariance + (follow * own**2) @ follow.T


def moments_of_effects(bench: Bench, entry: Entry) -> tuple[dict[str, float], dict[str, float]]:
    """Means and standard deviations of the numbers of a candidate's effects, by name."""
    means = bench.values(entry.candidate, entry.fit.z)
    wide = np.sqrt(np.diag(covariance_of(bench, entry))[bench.d :])
    return means, dict(zip(means, (_slopes(bench, entry) * wide).tolist(), strict=True))


def moments_of_theta(
    bench: Bench, entries: Sequence[Entry], weights: Sequence[float]
) -> tuple[Float[np.ndarray, " d"], Float[np.ndarray, " d"]]:
    """Mean of the system's own parameters under the first candidate, and how far the truth may be from it.

    Where others tie with the first, that is √Σ w (σ² + (μ − μ₁)²) over all of them, by their probabilities w: each has
    parameters of its own, and they cannot all be right.
    """
    d = bench.d
    share = np.asarray(weights) / np.sum(weights)
    means, variances = [], []
    for entry in entries:
        z = np.asarray(entry.fit.z)[:d]
        slopes = np.array([m.slope(x) for m, x in zip(bench.margins.each, z, strict=True)])
        means.append(np.array([m.value(x) for m, x in zip(bench.margins.each, z, strict=True)]))
        variances.append(slopes**2 * np.diag(covariance_of(bench, entry))[:d])
    apart = (np.array(means) - means[0]) ** 2
    return means[0], np.sqrt(share @ (np.array(variances) + apart))


def _slopes(bench: Bench, entry: Entry) -> Float[np.ndarray, " e"]:
    """How fast the effects' numbers change with their z."""
    own = np.asarray(entry.fit.z)[bench.d :]
    return np.array([abs(bench.each[i].slope(own[j])) for j, i in enumerate(bench.columns(entry.candidate))])


def _sizes(bench: Bench, entry: Entry) -> Float[np.ndarray, " e"]:
    """What the numbers of effects are known relative to: their magnitudes, and the time between several moments."""
    sizes, first = np.abs(list(bench.values(entry.candidate, entry.fit.z).values())), 0
    for k in entry.candidate.effects:
        own = bench.parameters[bench.first[k] : bench.first[k + 1]]
        moments = [first + j for j, parameter in enumerate(own) if parameter.moment]
        if len(moments) > 1:
            sizes[moments] = np.ptp(sizes[moments])
        first += len(own)
    return sizes
