"""The likelihood of recordings, written down: windows of a deterministic simulator, each with its own start, and noise.

A recording is cut into windows. Window w is simulated from its own initial state x_w, a correction δ_w of the recorded
one, under the recorded commands; what the sensors show is the prediction plus independent Gaussian noise:

    y_wtc = h_c(x_t(θ, x_w)) + σ_c ε,    z ~ N(m, I) with θ = θ(z) and m = 0,    δ_w ~ N(0, S²)

θ is common to all windows. The least-squares problem in (z, δ₁, …, δ_W) has the shape of an arrow: every δ_w is
eliminated from the normal equations by itself, so a step costs as much as W small problems. Because the initial states
are inferred with θ, a wrong initial state is not taken for physics.

Source: Bock 1983 (multiple shooting); Marquardt 1963 (damping); Nocedal and Wright 2006, chapter 10
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax.scipy.special import ndtr, ndtri
from jax.scipy.stats import norm
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from bayessim_jax.contracts import Scalar
from bayessim_jax.engines.batch import TASKS, WIDE
from bayessim_jax.programs import trace_once

__all__ = [
    "COMPILER_OPTIONS",
    "FEW_CALLS",
    "absorb",
    "Curvature",
    "Fit",
    "Predict",
    "Shots",
    "expand",
    "in_units",
    "normal_equations",
    "predict_all",
    "Ridge",
    "profile",
    "residuals",
    "ridge",
    "robust_covariance",
    "solve",
    "stride",
]

Predict = Callable[[Float[Array, " d"], Float[Array, " n"], Any], Float[Array, "rows obs"]]
"""`predict(z, δ, window)`: what the sensors show of one window, in every row."""


TOLERANCE, ROUGH, DAMPING = 1e-7, 1e-4, 1e-3
"""Of the solver: the share of the cost that it ends with, where simulators are smooth and where not, and the damping
that it begins with."""
LONGEST, OUTERMOST = 2.0, 1e-4
"""The longest step of z, and the share of an interval at either end into which no step from the other one leads."""


@struct.dataclass
class Shots:
    """Windows of recordings, stacked: what a simulation starts from, and what it is compared with."""

    inputs: Any
    """Whatever `predict` needs of a window, with a leading axis over windows."""
    y: Float[Array, "windows rows obs"]
    measured: Bool[Array, "windows rows obs"]
    """Numbers that are compared; the rest counts nowhere."""
    spread: Float[Array, " n"]
    """Prior standard deviation S of the correction of an initial state, for each of its coordinates."""
    center: Float[Array, " d"] | float = 0.0
    """Prior mean of z."""
    shift: Float[Array, "windows n"] | float = 0.0
    """Prior mean of δ."""
    bounded: Bool[Array, " d"] | bool = False
    """Which of z say where a value is in an interval, Φ(z)."""
    axes: Any = struct.field(pytree_node=False, default=0)
    """`vmap`'s `in_axes` of the inputs: None for what all windows share."""


@struct.dataclass
class Curvature:
    """The normal equations of all windows at one point, the initial states eliminated one by one."""

    cost: Scalar
    """½ (Σ residuals² + zᵀz + Σ δᵀS⁻²δ)."""
    hessian: Float[Array, "d d"]
    """Of z, with z's prior."""
    gradient: Float[Array, " d"]
    own: Float[Array, "windows n n"]
    """Of every δ_w, with its prior."""
    cross: Float[Array, "windows n d"]
    own_gradient: Float[Array, "windows n"]
    pulls: Float[Array, "windows d"]
    """Every window's part of the gradient of z."""


@struct.dataclass
class Fit:
    """Where the solver ended."""

    z: Float[Array, " d"]
    delta: Float[Array, "windows n"]
    sigma: Float[Array, " obs"]
    """Noise, in each channel's unit."""
    precision: Float[Array, "d d"]
    """Of z with every δ eliminated: the inverse of Laplace's covariance."""
    pulls: Float[Array, "windows d"]
    """Every window's part of the gradient of z, its δ eliminated."""
    r: Float[Array, "windows rows obs"]
    """(y − prediction) / σ, zero where nothing was measured."""
    slopes: Float[Array, "windows dn k"]
    """Derivatives of predictions / σ along (z, δ/S)."""
    cost: Scalar
    steps: Int[Array, ""]
    converged: Bool[Array, ""]
    damping: Scalar | float = DAMPING
    """Of the solver's last step."""

    @property
    def misses(self) -> Float[np.ndarray, "windows rows obs"]:
        """What was measured less what is predicted, in the channels' units."""
        return np.asarray(self.r) * np.asarray(self.sigma)

    @property
    def usual_move(self) -> Float[np.ndarray, " n"]:
        """How far initial states are moved, as a standard deviation that few wild ones do not change."""
        return 1.4826 * np.median(np.abs(np.asarray(self.delta)), axis=0)

    def marginal(self, d: int) -> Fit:
        """The fit of the first d of z alone, the others eliminated."""
        precision, pulls, slopes = map(np.asarray, (self.precision, self.pulls, self.slopes))
        along = np.linalg.solve(precision[d:, d:], precision[d:, :d])
        return dataclasses.replace(
            self,
            z=jax.device_put(np.asarray(self.z)[:d]),
            precision=jax.device_put(precision[:d, :d] - precision[:d, d:] @ along),
            pulls=jax.device_put(pulls[:, :d] - pulls[:, d:] @ along),
            slopes=jax.device_put(np.delete(slopes, np.s_[d : len(precision)], axis=1)),
        )

    @property
    def along_states(self) -> Float[np.ndarray, "windows n k"]:
        """Derivatives of predictions along δ/S, in the channels' units."""
        return in_units(np.asarray(self.slopes)[:, self.z.size :], self.sigma)


def in_units(slopes: Float[np.ndarray, "windows n k"], sigma: Float[Array, " obs"]) -> Float[np.ndarray, "windows n k"]:
    """Derivatives of predictions / σ, rows and channels in one axis, in the channels' units."""
    return (slopes.reshape(*slopes.shape[:-1], -1, sigma.size) * np.asarray(sigma)).reshape(slopes.shape)


def residuals(predict: Predict, shots: Shots, z: Array, delta: Array, sigma: Array) -> Float[Array, "windows rows obs"]:
    """(y − prediction) / σ, zero where nothing was measured; not finite where the simulation is not."""
    return jnp.where(shots.measured, (shots.y - predict_all(predict, shots, z, delta)) / sigma, 0.0)


def predict_all(predict: Predict, shots: Shots, z: Array, delta: Array) -> Float[Array, "windows rows obs"]:
    """What the sensors show of all windows."""
    return jax.vmap(predict, in_axes=(None, 0, shots.axes))(z, delta, shots.inputs)


def expand(
    predict: Predict, shots: Shots, z: Array, delta: Array, sigma: Array, step: float = 0.0, live: int | None = None
) -> tuple[Float[Array, "windows k"], Float[Array, "windows dn k"]]:
    """Residuals of every window and the derivatives of its predictions along (z, δ/S), both in units of σ.

    Differences of length ε^⅓, with ε what numbers of this kind resolve: central ones along z, where a ridge must not
    look informed, and forward ones along δ, which move far less than a simulator bends. Where it is not smooth all are
    central, of length `step`. They and the point itself are one batch of simulations: the compiler meets a simulator
    once, where forward-mode derivatives of it make a program several times as large (`docs/architecture.md`). Of z
    only the first `live` matter to the simulator, all unless told.
    """
    d, n, windows = z.size if live is None else live, delta.shape[-1], delta.shape[0]
    still = jnp.zeros(z.size - d, z.dtype)
    length = step or float(jnp.finfo(z.dtype).eps) ** (1 / 3)
    both = d + n if step else d
    ways = length * jnp.concatenate([jnp.zeros((1, d + n)), jnp.eye(d + n), -jnp.eye(both, d + n)])
    # points outside and windows inside: z is common to all windows, and theirs lie side by side
    moved = lambda way: z + jnp.concatenate([way[:d], still])  # noqa: E731
    run = lambda way: predict_all(predict, shots, moved(way), delta + way[d:] * shots.spread)  # noqa: E731
    y = jax.vmap(run)(ways)
    value, ahead, behind = y[0], y[1 : 1 + d + n], y[1 + d + n :]
    slopes = [(ahead[:both] - behind) / (2 * length), (ahead[both:] - value) / length]
    slopes = jnp.moveaxis(jnp.concatenate(slopes), 0, 1)
    r = jnp.where(shots.measured, (shots.y - value) / sigma, 0.0)
    slopes = jnp.where(shots.measured[:, None], slopes / sigma, 0.0)
    slopes = slopes.reshape(windows, d + n, -1)
    none = jnp.zeros((windows, still.size, slopes.shape[-1]), slopes.dtype)
    return r.reshape(windows, -1), jnp.concatenate([slopes[:, :d], none, slopes[:, d:]], 1)


def normal_equations(
    r: Float[Array, "windows k"], slopes: Float[Array, "windows dn k"], own: Float[Array, " d"], scaled: Array
) -> Curvature:
    """Of residuals and slopes as `expand` gives them; `own` and `scaled` are z and δ/S less their priors' means."""
    d, n = own.size, scaled.shape[-1]
    products = jnp.einsum("wik,wjk->wij", slopes, slopes)
    pulls = jnp.einsum("wik,wk->wi", slopes, r)
    return Curvature(
        cost=0.5 * ((r**2).sum() + own @ own + (scaled**2).sum()),
        hessian=products[:, :d, :d].sum(0) + jnp.eye(d),
        gradient=pulls[:, :d].sum(0) - own,
        own=products[:, d:, d:] + jnp.eye(n),
        cross=products[:, d:, :d],
        own_gradient=pulls[:, d:] - scaled,
        pulls=pulls[:, :d],
    )


def eliminate(c: Curvature, damping: Scalar | float = 0.0) -> tuple[Array, Array, Array, Array]:
    """Precision of z after the δ are eliminated, its gradient, and per window own⁻¹ cross and own⁻¹ gradient."""
    n = c.own.shape[-1]
    own = c.own + damping * jnp.eye(n) * jnp.diagonal(c.own, axis1=-2, axis2=-1)[..., None]
    solved = jnp.linalg.solve(own, jnp.concatenate([c.cross, c.own_gradient[..., None]], axis=-1))
    toward, shift = solved[..., :-1], solved[..., -1]
    precision = c.hessian - jnp.einsum("wni,wnj->ij", c.cross, toward)
    gradient = c.gradient - jnp.einsum("wni,wn->i", c.cross, shift)
    return precision, gradient, toward, shift


COMPILER_OPTIONS = {
    "xla_backend_optimization_level": 1,
    "xla_cpu_use_fusion_emitters": False,
    "xla_disable_hlo_passes": TASKS,
    **WIDE,
}
"""For programs of small arrays on a CPU: compilation takes less than half as long, vectors are wide, and no operation
of a time step is cut up for a pool of threads."""
FEW_CALLS = COMPILER_OPTIONS | {"xla_backend_optimization_level": 0}
"""For programs of which a person waits for the compiler and not for the few times that they run: compiled in a third of
the time, and some three times slower."""


@struct.dataclass
class _March:
    """Where Levenberg and Marquardt's method stands: a point that is tried, and the best one so far."""

    tried: tuple[Float[Array, " d"], Float[Array, "windows n"]]
    kept: tuple[Float[Array, " d"], Float[Array, "windows n"]]
    seen: tuple[Float[Array, "windows k"], Float[Array, "windows dn k"]]
    """Residuals and slopes at the best one."""
    here: Curvature
    damping: Scalar
    promised: Scalar
    """By how much the cost should fall from the best one to the one that is tried."""
    count: Int[Array, ""]
    small: Int[Array, ""]
    """Accepted steps in a row that lowered the cost by next to nothing."""


@struct.dataclass
class _Terms:
    """What a fit is held by beside the recordings, and what it may change."""

    free: Bool[Array, " d"]
    center: Float[Array, " d"] | float
    shift: Float[Array, "windows n"] | float
    spread: Float[Array, " n"]
    bounded: Bool[Array, " d"] | bool
    tolerance: float


def _set_out(z: Array, delta: Array, rest: int, damping: float | Scalar) -> _March:
    """Before anything is simulated, of NumPy's numbers."""
    kind, d, (windows, n) = z.dtype, z.size, delta.shape
    zeros: Any = partial(np.zeros, dtype=kind)
    nothing = Curvature(
        cost=zeros(()) + np.inf,
        hessian=zeros((d, d)),
        gradient=zeros(d),
        own=zeros((windows, n, n)),
        cross=zeros((windows, n, d)),
        own_gradient=zeros((windows, n)),
        pulls=zeros((windows, d)),
    )
    seen = (zeros((windows, rest)), zeros((windows, d + n, rest)))
    none: Any = np.zeros((), int)
    return _March((z, delta), (z, delta), seen, nothing, jnp.asarray(damping, kind), zeros(()), none, none)


def _advance(march: _March, seen: tuple[Array, Array], terms: _Terms) -> _March:
    """One step, after the point that is tried has been simulated."""
    tried, here, damping = march.tried, march.here, march.damping
    there = normal_equations(*seen, tried[0] - terms.center, (tried[1] - terms.shift) / terms.spread)
    sound = jnp.isfinite(there.cost) & jnp.isfinite(there.gradient).all() & jnp.isfinite(there.hessian).all()
    better = sound & (there.cost <= here.cost)
    gain = jnp.where(better, (here.cost - there.cost) / jnp.maximum(jnp.abs(here.cost), 1e-12), 1.0)
    gain = jnp.where(jnp.isfinite(gain), gain, 1.0)
    fulfilled = (here.cost - there.cost) / jnp.maximum(march.promised, 1e-300)
    eased = jnp.where(fulfilled > 0.75, damping / 5, jnp.where(fulfilled > 0.25, damping, damping * 2))
    damping = jnp.where(better, jnp.maximum(eased, 1e-9), damping * 8).astype(march.damping.dtype)
    small = jnp.where(better & (gain < terms.tolerance), march.small + 1, jnp.where(better, 0, march.small))
    best = (march.kept, march.seen, here)
    kept, seen, here = jax.tree.map(lambda x, y: jnp.where(better, x, y), (tried, seen, there), best)
    tried, promised = _propose(kept, here, damping, terms)
    return _March(tried, kept, seen, here, damping, promised, march.count + 1, small)


def _propose(
    at: tuple[Array, Array], here: Curvature, damping: Array, terms: _Terms
) -> tuple[tuple[Array, Array], Array]:
    """Where a step leads, and by how much the cost should fall."""
    free = terms.free
    precision, gradient, toward, shift = eliminate(here, damping)
    precision = jnp.where(jnp.outer(free, free), precision, jnp.eye(free.size))
    precision = precision + damping * jnp.diag(jnp.diagonal(here.hessian))
    move = jnp.where(free, jnp.linalg.solve(precision, jnp.where(free, gradient, 0.0)), 0.0)
    to, move = stride(at[0], move, terms.bounded, LONGEST)
    moves = shift - toward @ move
    stiff = move**2 @ jnp.diagonal(here.hessian) + (moves**2 * jnp.diagonal(here.own, axis1=-2, axis2=-1)).sum()
    promised = 0.5 * (move @ here.gradient + (moves * here.own_gradient).sum() + damping * stiff)
    return (to, at[1] + moves * terms.spread), promised


def stride(
    z: Float[Array, " d"], move: Float[Array, " d"], bounded: Bool[Array, " d"] | bool, longest: float
) -> tuple[Float[Array, " d"], Float[Array, " d"]]:
    """Where a step along the slopes at z leads, and the part of it that is taken.

    What is `bounded` is at Φ(z) of its interval. At its ends Φ is flat: a step back from there would be far too long,
    and so small a part of it would be taken, of all other directions as well. Such a step is as long as it is in Φ.
    Of all others none is longer than `longest`.
    """

    def lead(move: Float[Array, " d"]) -> Float[Array, " d"]:
        inward = ndtri(jnp.clip(ndtr(z) + norm.pdf(z) * move, OUTERMOST, 1.0 - OUTERMOST)) - z
        return jnp.where(bounded & (inward * move > 0.0) & (jnp.abs(inward) < jnp.abs(move)), inward, move)

    free = jnp.where(lead(move) == move, jnp.abs(move), 0.0).max(initial=0.0)
    taken = move * jnp.minimum(1.0, longest / jnp.maximum(free, 1e-12))
    return z + lead(taken), taken


def _arrive(march: _March, sigma: Array, terms: _Terms, shape: tuple[int, ...]) -> Fit:
    """The best point as a fit."""
    (z, delta), (r, slopes), here, free = march.kept, march.seen, march.here, terms.free
    precision, _, _, shift = eliminate(here)
    return Fit(
        z=z,
        delta=delta,
        sigma=sigma,
        precision=jnp.where(jnp.outer(free, free), precision, jnp.eye(free.size)),
        pulls=jnp.where(free, here.pulls - jnp.einsum("wni,wn->wi", here.cross, shift), 0.0),
        r=r.reshape(shape),
        slopes=slopes,
        cost=here.cost,
        steps=march.count,
        converged=(march.small >= 2) | (march.damping >= 1e9),
        damping=march.damping,
    )


_look = trace_once(expand, static_argnames=("predict", "step", "live"), compiler_options=COMPILER_OPTIONS)
_go_on = trace_once(_advance, compiler_options=COMPILER_OPTIONS)
_end = trace_once(_arrive, static_argnames="shape", compiler_options=FEW_CALLS, to_numpy=True)


def solve(
    predict: Predict,
    shots: Shots,
    z: Float[ArrayLike, " d"],
    delta: Float[ArrayLike, "windows n"],
    sigma: Float[ArrayLike, " obs"],
    free: Bool[ArrayLike, " d"],
    *,
    steps: int = 30,
    step: float = 0.0,
    damping: float | Scalar = DAMPING,
    live: int | None = None,
) -> Fit:
    """Levenberg-Marquardt on (z, δ₁, …, δ_W) from a starting point; z stays as it is where it is not `free`.

    The simulator depends on the first `live` of z, on all unless told.

    A step that does not lower the cost, or leads to a number that is not finite, is refused and shortened; where the
    cost falls by less than a quarter of what the slopes promise, the next one is shorter, too. `damping` is where that
    begins. The solver has converged when two accepted steps in a row lower the cost by less than 1e-7 of it (1e-4 where
    `step` is told, as where bodies collide), or when no step does.

    Only the simulation and its derivatives are compiled for a `predict`; the algebra is compiled once for all of the
    same size.
    """
    kind = jnp.result_type(z)
    at, beside, noise = (jax.device_put(np.asarray(x, kind)) for x in (z, delta, sigma))
    terms = _Terms(
        jax.device_put(np.asarray(free)),
        shots.center,
        shots.shift,
        shots.spread,
        shots.bounded,
        ROUGH if step else TOLERANCE,
    )
    march = _set_out(at, beside, shots.y.shape[1] * shots.y.shape[2], damping)
    for _ in range(int(steps)):
        march = _go_on(march, _look(predict, shots, *march.tried, noise, step, live), terms)
        small, last, cost = jax.device_get((march.small, march.damping, march.here.cost))
        if small >= 2 or last >= 1e9 or not np.isfinite(cost):
            break
    return _end(march, noise, terms, shots.y.shape)


@trace_once(compiler_options=FEW_CALLS, to_numpy=True)
def robust_covariance(fit: Fit) -> Float[np.ndarray, "d d"]:
    """Covariance of z where the model is only nearly right: Laplace's, wider where windows disagree more than noise.

    With H⁻¹ = L Lᵀ the windows' gradients g have Σ Lᵀ g gᵀ L = I on average if the model is right. Where an eigenvalue
    of it is larger, the covariance is larger by as much (the sandwich H⁻¹ Σ g gᵀ H⁻¹); it is never smaller.

    Source: White 1982
    """
    root = jnp.linalg.inv(jnp.linalg.cholesky(fit.precision)).T
    values, axes = jnp.linalg.eigh(jnp.einsum("wi,wj->ij", fit.pulls @ root, fit.pulls @ root))
    wide = root @ (axes * jnp.sqrt(jnp.maximum(values, 1.0)))
    return wide @ wide.T


@struct.dataclass
class Ridge:
    """The likelihood around a fit as a function of z alone: how initial states follow z, and what they can absorb."""

    fit: Fit
    toward: Float[Array, "windows n d"]
    slopes: Float[Array, "windows n k"]
    inverse: Float[Array, "windows n n"]


@jax.jit
def ridge(fit: Fit) -> Ridge:
    """What follows of a fit's own linearization."""
    return Ridge(fit, *absorb(fit.slopes, fit.z.size))


def absorb(
    slopes: Float[Array, "windows dn k"], d: int
) -> tuple[Float[Array, "windows n d"], Float[Array, "windows n k"], Float[Array, "windows n n"]]:
    """How initial states follow z, derivatives along these states, and the inverse of their own curvature."""
    own = slopes[:, d:]
    inverse = jnp.linalg.inv(jnp.einsum("wik,wjk->wij", own, own) + jnp.eye(own.shape[1]))
    return inverse @ jnp.einsum("wik,wjk->wij", own, slopes[:, :d]), own, inverse


def profile(predict: Predict, shots: Shots, ridge: Ridge, z: Float[Array, " d"]) -> Scalar:
    """Log p(y, z) up to a constant, every initial state integrated out as in a linear model.

    δ follows z along the arrow that the fit found, δ(z) = δ̂ − own⁻¹ cross (z − ẑ), and what the residuals there still
    have along ∂y/∂δ at the fit is taken out exactly: one simulation of every window.
    """
    fit = ridge.fit
    delta = fit.delta - (ridge.toward @ (z - fit.z)) * shots.spread
    r = residuals(predict, shots, z, delta, fit.sigma)
    flat, scaled = r.reshape(r.shape[0], -1), (delta - shots.shift) / shots.spread
    pull = jnp.einsum("wnk,wk->wn", ridge.slopes, flat) - scaled
    left = (flat**2).sum() + (scaled**2).sum() - jnp.einsum("wn,wnm,wm->", pull, ridge.inverse, pull)
    log = -0.5 * (left + (z - shots.center) @ (z - shots.center))
    return jnp.where(jnp.isfinite(log), log, -jnp.inf)
