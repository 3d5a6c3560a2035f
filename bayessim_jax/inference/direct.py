"""The posterior of θ by its likelihood: an optimum, Laplace's approximation, and a sampler that corrects it.

For a deterministic simulator with sensor noise nothing has to be learned: the likelihood of a recording is written
down (`inference.shooting`). The noise is estimated with θ, because a likelihood means nothing without it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any

import blackjax
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from bayessim_jax.beliefs.margins import Margins
from bayessim_jax.inference.draws import PosteriorDraws
from bayessim_jax.inference.shooting import Fit, Predict, Ridge, Shots, profile, residuals, ridge, solve

__all__ = ["estimate_noise", "fit_direct", "sample_direct"]

SCREENED = 48
"""Draws of the prior that are simulated once to find where to begin."""
STARTS = 3
"""Of these, how many are begun from, beside the prior's centre."""
ROUNDS = 6
"""Rounds of noise estimate and fit, at most."""
DRAWS = 512
"""Laplace draws that are weighed, and how many of them have to be worth something."""
SOUND = 0.25
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
    squares = (np.asarray(fit.misses) ** 2).sum((0, 1))
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
    return jnp.maximum(jnp.asarray(np.sqrt(squares / np.maximum(counts * share, 1))), floor)


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
    say: Callable[[str], None] = lambda text: None,
) -> Fit:
    """Fit z, every window's initial state, and the noise of every channel, from several points of the prior.

    With `start` only that point is begun from, with its noise.
    """
    windows, n = shots.y.shape[0], shots.spread.size
    floor = noise_floor(shots)
    free = jnp.ones(d, bool)
    run = lambda z, delta, sigma, count: solve(predict, shots, z, delta, sigma, free, steps=count, step=step)  # noqa: E731
    if start is None:
        spread = jnp.asarray(_spreads(shots))
        sigma = jnp.maximum(0.05 * spread, floor)
        delta = jnp.zeros((windows, n))
        points = jax.random.normal(key, (SCREENED, d)).at[0].set(0.0)
        costs = np.asarray(_screen(predict, shots, points, delta, 0.3 * spread))
        order = np.argsort(np.where(np.isfinite(costs), costs, np.inf))
        chosen = [0, *[int(i) for i in order if i != 0 and np.isfinite(costs[i])][: starts if d else 0]]
        say(f"{len(chosen)} starts, the best of {SCREENED} draws of the prior")
        fits = [run(points[i], delta, sigma, 15) for i in chosen]
        finite = [fit for fit in fits if np.isfinite(float(fit.cost))]
        if not finite:
            raise ValueError(
                "no parameter value in the prior gives a finite simulation; check the model and the prior."
            )
        best = min(finite, key=lambda fit: float(fit.cost))
    else:
        best = run(start.z, start.delta, start.sigma, steps)
    for _ in range(ROUNDS):
        sigma = estimate_noise(shots, best, floor)
        change = float(jnp.abs(jnp.log(sigma / best.sigma)).max())
        best = run(best.z, best.delta, sigma, steps)
        if change < 0.02:
            break
    return best


def _spreads(shots: Shots) -> np.ndarray:
    y, measured = np.asarray(shots.y), np.asarray(shots.measured)
    columns = [y[..., c][measured[..., c]] for c in range(y.shape[-1])]
    return np.array([max(float(x.std()), 1e-9) if x.size else 1.0 for x in columns])


def _screen_impl(predict: Predict, shots: Shots, points: Array, delta: Array, sigma: Array) -> Array:
    def one(z: Array) -> Array:
        r = residuals(predict, shots, z, delta, sigma)
        return jnp.minimum(r**2, 100.0).sum() + 0.0 * r.sum()

    return jax.lax.map(one, points, batch_size=16)


_screen = jax.jit(_screen_impl, static_argnums=0)


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
    factor = jnp.linalg.inv(jnp.linalg.cholesky(fit.precision)).T
    if not exact:
        z = fit.z + jax.random.normal(key, (draws, d)) @ factor.T
        return PosteriorDraws(jax.vmap(margins.theta)(z), z, fit, "laplace")
    t_key, pick_key, chain_key = jax.random.split(key, 3)
    nu = 7.0
    normal_key, chi_key = jax.random.split(t_key)
    chi = jax.random.chisquare(chi_key, nu, (DRAWS, 1)) / nu
    white = jax.random.normal(normal_key, (DRAWS, d)) / jnp.sqrt(chi)
    points = fit.z + white @ factor.T
    around = ridge(fit)
    log_target = _profiles(predict, shots, around, points)
    log_proposal = -0.5 * (nu + d) * jnp.log1p((white**2).sum(-1) / nu)
    log_weight = log_target - log_proposal
    weight = jnp.exp(log_weight - log_weight.max())
    weight = jnp.where(jnp.isfinite(weight), weight, 0.0)
    efficiency = float(weight.sum() ** 2 / (weight**2).sum() / DRAWS)
    if efficiency >= SOUND:
        share = weight / weight.sum()
        center = share @ points
        z = points[jax.random.choice(pick_key, DRAWS, (draws,), p=share)]
        jitter = SMOOTH * jax.random.normal(chain_key, (draws, d)) @ factor.T
        z = center + (z + jitter - center) / np.sqrt(1 + SMOOTH**2)
        return PosteriorDraws(jax.vmap(margins.theta)(z), z, fit, "laplace, weighed", efficiency)
    if d > 1 and float(jnp.linalg.eigvalsh(fit.precision)[0]) < WIDE:
        z = _walk(pick_key, predict, shots, fit, draws, step)
        return PosteriorDraws(jax.vmap(margins.theta)(z), z, fit, "profile along the widest direction", efficiency)
    first = points[jax.random.choice(pick_key, DRAWS, (CHAINS,), p=weight / weight.sum())]
    z = _chains(chain_key, predict, shots, around, first, factor)
    z = z.reshape(-1, d)[:: max(z.size // d // draws, 1)]
    return PosteriorDraws(jax.vmap(margins.theta)(z), z, fit, "random-walk Metropolis", efficiency)


def _walk(
    key: PRNGKeyArray, predict: Predict, shots: Shots, fit: Fit, draws: int, step: float
) -> Float[Array, "draws d"]:
    """Draws along the widest direction of a fit, which may bend: a profile of it, walked step by step.

    In coordinates a with z = ẑ + B a, B the eigenvectors of the covariance, a₀ is held at successive values while the
    rest is fitted. The profile with Laplace's volume of the rest is the density of a₀; given a₀ the rest is Gaussian.

    Source: Raue et al. 2009 (profile likelihoods of ridges)
    """
    d = fit.z.size
    basis = jnp.linalg.eigh(fit.precision)[1]  # smallest precision first
    turned = dataclasses.replace(shots, center=basis.T @ (shots.center - fit.z))

    def along(a: Array, delta: Array, window: Any) -> Array:
        return predict(fit.z + basis @ a, delta, window)

    free = jnp.arange(d) > 0
    places, found = [], []
    for sign in (1.0, -1.0):
        a, slope, delta = jnp.zeros(d), jnp.zeros(d), fit.delta
        for k in range(0 if sign > 0 else 1, WALK):
            start = (a + STRIDE * sign * slope).at[0].set(sign * STRIDE * k)
            here = solve(along, turned, start, delta, fit.sigma, free, steps=STEPS, step=step)
            if not bool(jnp.isfinite(here.cost)):
                break
            slope = (here.z - a) / (STRIDE * sign) if k else slope
            a, delta = here.z, here.delta
            rest = here.precision[1:, 1:]
            log = -float(here.cost) - 0.5 * float(jnp.linalg.slogdet(rest)[1])
            places.append(sign * STRIDE * k)
            found.append((log, a, rest))
            if log < max(f[0] for f in found) - 10.0:
                break
    order = np.argsort(places)
    grid, logs = np.array(places)[order], np.array([found[i][0] for i in order])
    fine = np.linspace(grid[0], grid[-1], 2001)
    density = np.exp(np.interp(fine, grid, logs) - logs.max())
    pick_key, rest_key = jax.random.split(key)
    shares = density / density.sum()
    chosen = np.asarray(jax.random.choice(pick_key, jnp.asarray(fine), (draws,), p=jnp.asarray(shares)))
    middle = np.stack([np.interp(chosen, grid, [float(found[i][1][j]) for i in order]) for j in range(d)], axis=-1)
    nearest = np.abs(chosen[:, None] - grid[None]).argmin(1)
    white = np.asarray(jax.random.normal(rest_key, (draws, d - 1)))
    factors = [np.linalg.inv(np.linalg.cholesky(np.asarray(found[i][2]))).T for i in order]
    middle[:, 1:] += np.einsum("nij,nj->ni", np.array(factors)[nearest], white) if d > 1 else 0.0
    return fit.z + jnp.asarray(middle) @ basis.T


@partial(jax.jit, static_argnames="predict")
def _profiles(predict: Predict, shots: Shots, around: Ridge, points: Array) -> Array:
    return jax.lax.map(lambda z: profile(predict, shots, around, z), points, batch_size=16)


@partial(jax.jit, static_argnames="predict")
def _chains(key: PRNGKeyArray, predict: Predict, shots: Shots, around: Ridge, first: Array, factor: Array) -> Array:
    """Random-walk Metropolis chains, side by side; the second half of each. Steps of many lengths pass bends."""

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
