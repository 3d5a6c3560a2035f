"""The posterior of θ by its likelihood: an optimum, Laplace's approximation, and a sampler that corrects it.

For a deterministic simulator with sensor noise nothing has to be learned: the likelihood of a recording is written
down (`inference.shooting`). The noise is estimated with θ, because a likelihood means nothing without it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from bayessim_jax.beliefs.margins import Margins
from bayessim_jax.inference.draws import PosteriorDraws
from bayessim_jax.inference.shooting import (
    COMPILER_OPTIONS,
    Fit,
    Predict,
    Ridge,
    Shots,
    profile,
    residuals,
    ridge,
    solve,
)
from bayessim_jax.programs import trace_once

__all__ = ["estimate_noise", "fit_direct", "sample_direct"]

SCREENED = 48
"""Draws of the prior that are simulated once to find where to begin."""
STARTS = 3
"""Of these, how many are begun from, beside the prior's centre."""
ROUNDS = 6
"""Rounds of noise estimate and fit, at most."""
DRAWS = 512
"""Draws around Laplace's optimum that are weighed."""
SOUND = 0.25
"""Of them that have to be worth something."""
FREEDOM = 7
"""Degrees of freedom of Student's t, from which they are drawn."""
SMOOTH = 0.15
"""Standard deviations of Laplace's by which resampled draws are spread, so that few of them coincide."""
CHAINS, LENGTH = 64, 120
WIDE = 20.0
"""Precision below which a direction is wide: a standard deviation of 0.22 of the prior's."""
WALK, STRIDE, STEPS = 40, 0.2, 15
"""Most steps of a profile to each side, their length in z, and steps of the solver at each."""


LEAST_SHARE = 0.1
"""Of the numbers measured, that noise is taken to have in the residuals however many are fitted."""


def estimate_noise(
    shots: Shots, fit: Fit, floor: Float[Array, " obs"], free: int | None = None, least: float = LEAST_SHARE
) -> Float[Array, " obs"]:
    """Noise of every channel from what a fit leaves; of z so many are `free`, all unless told (`noise_level`)."""
    counts = np.asarray(shots.measured).sum((0, 1))
    squares = (fit.misses**2).sum((0, 1))
    return noise_level(squares, counts, (fit.z.size if free is None else free) + fit.delta.size, floor, least)


def noise_level(
    squares: Float[np.ndarray, " obs"],
    counts: Float[np.ndarray, " obs"],
    fitted: int,
    floor: Float[Array, " obs"],
    least: float = LEAST_SHARE,
) -> Float[Array, " obs"]:
    """√(Σ r² / (n (1 − k/N))) of every channel for k numbers fitted to N, or `floor`; 1 − k/N is at least `least`."""
    share = max(1.0 - fitted / max(counts.sum(), 1), least)
    return jnp.asarray(np.maximum(np.sqrt(squares / np.maximum(counts * share, 1)), np.asarray(floor)))


def noise_floor(shots: Shots) -> Float[Array, " obs"]:
    """What a channel cannot resolve: a ten-thousandth of its spread, or its smallest step over √12."""
    y, measured = np.asarray(shots.y), np.asarray(shots.measured)
    floors = []
    for c in range(y.shape[-1]):
        values = y[..., c][measured[..., c]]
        if not values.size:
            floors.append(1.0)
            continue
        steps = np.diff(np.unique(values))
        steps = steps[steps > 1e-9 * max(np.abs(values).max(), 1e-12)]
        resolution = float(np.quantile(steps, 0.01)) / np.sqrt(12) if steps.size else 0.0
        floors.append(max(1e-4 * float(values.std()), min(resolution, 1e-2 * float(values.std())), 1e-9))
    return jnp.asarray(np.array(floors))


def fit_direct(
    key: PRNGKeyArray,
    predict: Predict,
    shots: Shots,
    d: int,
    *,
    start: Fit | None = None,
    starts: int = STARTS,
    steps: int = 40,
    step: float = 0.0,
    tolerance: float | None = None,
    say: Callable[[str], None] = lambda text: None,
) -> Fit:
    """Fit z, every window's initial state, and the noise of every channel, from several points of the prior.

    With `start` only that point is begun from, with its noise. `step` and `tolerance` are the solver's.
    """
    windows, n = shots.y.shape[0], shots.spread.size
    floor = noise_floor(shots)
    free = np.ones(d, bool)
    fixed = {"step": step, "tolerance": tolerance}
    run = lambda z, delta, sigma, **how: solve(predict, shots, z, delta, sigma, free, **fixed, **how)  # noqa: E731
    if start is None:
        spread = _spreads(shots)
        sigma = jnp.asarray(np.maximum(0.05 * spread, np.asarray(floor)))
        delta = np.zeros((windows, n))
        points = np.array(jax.random.normal(key, (SCREENED, d)))
        points[0] = 0.0
        costs = np.asarray(_screen(predict, shots, points, delta, 0.3 * spread))
        order = np.argsort(np.where(np.isfinite(costs), costs, np.inf))
        chosen = [0, *[int(i) for i in order if i != 0 and np.isfinite(costs[i])][: starts if d else 0]]
        say(f"{len(chosen)} starts, the best of {SCREENED} draws of the prior")
        fits = [run(points[i], delta, sigma, steps=15) for i in chosen]
        finite = [fit for fit in fits if np.isfinite(float(fit.cost))]
        if not finite:
            raise ValueError(
                "no parameter value in the prior gives a finite simulation; check the model and the prior."
            )
        best = min(finite, key=lambda fit: float(fit.cost))
    else:
        best = run(start.z, start.delta, start.sigma, steps=steps)
    for _ in range(ROUNDS):
        sigma = estimate_noise(shots, best, floor)
        change = float(np.abs(np.log(np.asarray(sigma) / np.asarray(best.sigma))).max())
        best = run(best.z, best.delta, sigma, steps=steps, known=best)
        if change < 0.02:
            break
    return best


def _spreads(shots: Shots) -> np.ndarray:
    y, measured = np.asarray(shots.y), np.asarray(shots.measured)
    columns = [y[..., c][measured[..., c]] for c in range(y.shape[-1])]
    return np.array([max(float(x.std()), 1e-9) if x.size else 1.0 for x in columns])


@trace_once(static_argnames="predict", compiler_options=COMPILER_OPTIONS)
def _screen(predict: Predict, shots: Shots, points: Array, delta: Array, sigma: Array) -> Float[Array, " points"]:
    """Cost of every point, each residual counted as ten of its σ at most; not finite where the simulation is not."""

    def one(z: Array) -> Array:
        r = residuals(predict, shots, z, delta, sigma)
        return jnp.minimum(r**2, 100.0).sum() + 0.0 * r.sum()

    return jax.lax.map(one, points, batch_size=16)


def sample_direct(
    key: PRNGKeyArray,
    predict: Predict,
    shots: Shots,
    margins: Margins,
    fit: Fit,
    *,
    draws: int = 2000,
    step: float = 0.0,
    exact: bool = True,
) -> PosteriorDraws:
    """Draw θ from the posterior: Laplace's draws, weighed by the likelihood; where too few are worth anything, chains.

    The proposal is Student's t with 7 degrees of freedom around the optimum. Where the posterior is wide along some
    direction, a thin ridge that may bend, its profile is walked; else random-walk Metropolis chains of BlackJAX start
    at weighed draws. Without `exact` Laplace's Gaussian is drawn from as it is.
    """
    d = fit.z.size
    if not exact:
        random = np.random.default_rng(np.asarray(jax.random.key_data(key)))
        z = jnp.asarray(np.asarray(fit.z) + random.standard_normal((draws, d)) @ _factor(fit).T)
        return PosteriorDraws(_values(margins, z), z, fit, "laplace")
    weigh_key, chain_key = jax.random.split(key)
    random = np.random.default_rng(np.asarray(jax.random.key_data(weigh_key)))
    weighed = _weigh(random, predict, shots, fit, draws)
    if weighed.efficiency >= SOUND:
        return PosteriorDraws(_values(margins, weighed.z), weighed.z, fit, "laplace, weighed", weighed.efficiency)
    if d > 1 and float(np.linalg.eigvalsh(np.asarray(fit.precision))[0]) < WIDE:
        z = _walk(random, predict, shots, fit, draws, step)
        return PosteriorDraws(_values(margins, z), z, fit, "profile along the widest direction", weighed.efficiency)
    first = weighed.points[random.choice(DRAWS, CHAINS, p=weighed.share)]
    z = _chains(chain_key, predict, shots, weighed.around, first, _factor(fit))
    z = z.reshape(-1, d)[:: max(z.size // d // draws, 1)]
    return PosteriorDraws(_values(margins, z), z, fit, "random-walk Metropolis", weighed.efficiency)


@dataclass(frozen=True)
class _Weighed:
    """Draws of Student's t around a fit, and of them again as the likelihood weighs them."""

    around: Ridge
    points: Float[np.ndarray, "points d"]
    share: Float[np.ndarray, " points"]
    efficiency: float
    """Effective share of the points as an importance sample."""
    z: Float[Array, "draws d"]


def _weigh(random: np.random.Generator, predict: Predict, shots: Shots, fit: Fit, draws: int) -> _Weighed:
    d, factor, around = fit.z.size, _factor(fit), ridge(fit)
    chi = random.chisquare(FREEDOM, (DRAWS, 1)) / FREEDOM
    white = random.standard_normal((DRAWS, d)) / np.sqrt(chi)
    points = np.asarray(fit.z) + white @ factor.T
    log_proposal = -0.5 * (FREEDOM + d) * np.log1p((white**2).sum(-1) / FREEDOM)
    log_weight = np.asarray(_profiles(predict, shots, around, points)) - log_proposal
    weight = np.nan_to_num(np.exp(log_weight - log_weight.max()))
    share = weight / weight.sum()
    center = share @ points
    z = points[random.choice(DRAWS, draws, p=share)]
    jitter = SMOOTH * random.standard_normal((draws, d)) @ factor.T
    z = center + (z + jitter - center) / np.sqrt(1 + SMOOTH**2)
    return _Weighed(around, points, share, float(1 / (share**2).sum() / DRAWS), jnp.asarray(z))


@partial(jax.jit, static_argnames="predict", compiler_options=COMPILER_OPTIONS)
def _profiles(predict: Predict, shots: Shots, around: Ridge, points: Array) -> Float[Array, " points"]:
    return jax.lax.map(lambda z: profile(predict, shots, around, z), points, batch_size=16)


def _factor(fit: Fit) -> Float[np.ndarray, "d d"]:
    """A root of Laplace's covariance."""
    return np.linalg.inv(np.linalg.cholesky(np.asarray(fit.precision))).T


@jax.jit
def _values(margins: Margins, z: Float[Array, "draws d"]) -> Float[Array, "draws d"]:
    """In raw units."""
    return jax.vmap(margins.theta)(z)


def _walk(
    random: np.random.Generator, predict: Predict, shots: Shots, fit: Fit, draws: int, step: float
) -> Float[Array, "draws d"]:
    """Draws along the widest direction of a fit, which may bend: a profile of it, walked step by step.

    In coordinates a with z = ẑ + B a, B the eigenvectors of the covariance, a₀ is held at successive values while the
    rest is fitted. The profile with Laplace's volume of the rest is the density of a₀; given a₀ the rest is Gaussian.

    Source: Raue et al. 2009 (profile likelihoods of ridges)
    """
    d = fit.z.size
    basis = np.linalg.eigh(np.asarray(fit.precision))[1]  # smallest precision first
    turned = dataclasses.replace(shots, center=jnp.asarray(basis.T @ np.asarray(shots.center - fit.z)), bounded=False)

    def along(a: Array, delta: Array, window: Any) -> Array:
        return predict(fit.z + basis @ a, delta, window)

    free = np.arange(d) > 0
    places, found = [], []
    for sign in (1.0, -1.0):
        a, slope, delta = np.zeros(d), np.zeros(d), fit.delta
        for k in range(0 if sign > 0 else 1, WALK):
            start = a + STRIDE * sign * slope
            start[0] = sign * STRIDE * k
            here = solve(along, turned, start, delta, fit.sigma, free, steps=STEPS, step=step)
            if not np.isfinite(float(here.cost)):
                break
            slope = (np.asarray(here.z) - a) / (STRIDE * sign) if k else slope
            a, delta = np.asarray(here.z), here.delta
            rest = np.asarray(here.precision)[1:, 1:]
            log = -float(here.cost) - 0.5 * float(np.linalg.slogdet(rest)[1])
            places.append(sign * STRIDE * k)
            found.append((log, a, rest))
            if log < max(f[0] for f in found) - 10.0:
                break
    order = np.argsort(places)
    grid, logs = np.array(places)[order], np.array([found[i][0] for i in order])
    fine = np.linspace(grid[0], grid[-1], 2001)
    density = np.exp(np.interp(fine, grid, logs) - logs.max())
    chosen = random.choice(fine, draws, p=density / density.sum())
    middle = np.stack([np.interp(chosen, grid, [float(found[i][1][j]) for i in order]) for j in range(d)], axis=-1)
    nearest = np.abs(chosen[:, None] - grid[None]).argmin(1)
    white = random.standard_normal((draws, d - 1))
    factors = [np.linalg.inv(np.linalg.cholesky(found[i][2])).T for i in order]
    middle[:, 1:] += np.einsum("nij,nj->ni", np.array(factors)[nearest], white) if d > 1 else 0.0
    return jnp.asarray(np.asarray(fit.z) + middle @ basis.T)


@partial(jax.jit, static_argnames="predict", compiler_options=COMPILER_OPTIONS)
def _chains(key: PRNGKeyArray, predict: Predict, shots: Shots, around: Ridge, first: Array, factor: Array) -> Array:
    """Random-walk Metropolis chains, side by side; the second half of each. Steps of many lengths pass bends."""
    with jax.ensure_compile_time_eval():
        import blackjax  # imported late: chains are the last resort

    def stride(key: Any, position: Array) -> Array:
        length_key, way_key = jax.random.split(key)
        length = 2.0 * 0.03 ** jax.random.uniform(length_key) / np.sqrt(position.size)
        return length * factor @ jax.random.normal(way_key, position.shape)

    kernel: Any = blackjax.additive_step_random_walk(lambda z: profile(predict, shots, around, z), stride)

    def advance(states: Any, key: Any) -> Any:
        states, _ = jax.vmap(kernel.step)(jax.random.split(key, CHAINS), states)
        return states, states.position

    _, positions = jax.lax.scan(advance, jax.vmap(kernel.init)(first), jax.random.split(key, LENGTH))
    return positions[LENGTH // 2 :].swapaxes(0, 1)
