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
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, ArrayLike, Bool, Float

from bayessim_jax.contracts import Scalar
from bayessim_jax.engines.batch import TASKS, WIDE
from bayessim_jax.inference.arrow import (
    Curvature,
    cost_of,
    eliminate,
    normal_equations,
    own_pulls,
    propose,
    within_reach,
)
from bayessim_jax.programs import trace_once

__all__ = [
    "COMPILER_OPTIONS",
    "FEW_CALLS",
    "ROUGH",
    "absorb",
    "Fit",
    "Predict",
    "Shots",
    "expand",
    "in_units",
    "predict_all",
    "Ridge",
    "profile",
    "residuals",
    "ridge",
    "robust_covariance",
    "solve",
]

Predict = Callable[[Float[Array, " d"], Float[Array, " n"], Any], Float[Array, "rows obs"]]
"""`predict(z, δ, window)`: what the sensors show of one window, in every row."""


TOLERANCE, ROUGH, DAMPING = 1e-7, 1e-4, 1e-3
"""Of the solver: the share of the cost that it ends with, where simulators are smooth and where not, and the damping
that it begins with."""
SETTLED = 1e-3
"""By how much the cost may still fall where the last step, a twentieth of a standard deviation, is not simulated."""
LEAST, STUCK = 1e-9, 1e9
"""Damping at least, and so much that no step helps."""
MANY = 16
"""Windows that fill a processor's vectors, so that points are simulated one after the other."""
LONGEST = 2.0
"""The longest step of z."""


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
class Fit:
    """Where the solver ended, in NumPy's numbers."""

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
    steps: int
    converged: bool
    damping: float = DAMPING
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
            z=np.asarray(self.z)[:d],
            precision=precision[:d, :d] - precision[:d, d:] @ along,
            pulls=pulls[:, :d] - pulls[:, d:] @ along,
            slopes=np.delete(slopes, np.s_[d : len(precision)], axis=1),
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
    predict: Predict,
    shots: Shots,
    z: Array,
    delta: Array,
    sigma: Array,
    step: float = 0.0,
    live: int | None = None,
    alone: Bool[Array, ""] | bool = False,
) -> tuple[Float[Array, "windows k"], Float[Array, "windows dn k"]]:
    """Residuals of every window and the derivatives of its predictions along (z, δ/S), both in units of σ.

    Differences of length ε^⅓, with ε what numbers of this kind resolve: central ones along z, where a ridge must not
    look informed, and forward ones along δ, which move far less than a simulator bends. Where it is not smooth all are
    central, of length `step`. The point and those beside it are simulated by one loop or as one batch: the compiler
    meets a simulator once, where forward-mode derivatives of it make a program several times as large
    (`docs/architecture.md`). A simulator that is not smooth is MuJoCo's C engine, which takes batches and is not
    compiled. Of z only the first `live` matter to the simulator, all unless told. With the point `alone` slopes need
    not be right.
    """
    d, n, windows = z.size if live is None else live, delta.shape[-1], delta.shape[0]
    still = jnp.zeros(z.size - d, z.dtype)
    length = step or float(jnp.finfo(z.dtype).eps) ** (1 / 3)
    both = d + n if step else d
    count = 1 + d + n + both
    ways = length * jnp.concatenate([jnp.zeros((1, d + n)), jnp.eye(d + n), -jnp.eye(both, d + n)])
    # points outside and windows inside: z is common to all windows, and theirs lie side by side
    moved = lambda way: z + jnp.concatenate([way[:d], still])  # noqa: E731
    run = lambda way: predict_all(predict, shots, moved(way), delta + way[d:] * shots.spread)  # noqa: E731
    nothing = jnp.zeros((count, *shots.y.shape), jnp.result_type(z, shots.y))
    put = lambda k, y: y.at[k].set(run(ways[k]))  # noqa: E731
    if step:
        y = jax.lax.cond(alone, lambda: put(0, nothing), lambda: jax.vmap(run)(ways))
    elif jax.default_backend() == "cpu" and windows >= MANY:
        y = jax.lax.fori_loop(0, jnp.where(alone, 1, count), put, nothing)
    else:
        y = jax.vmap(run)(ways)
    value, ahead, behind = y[0], y[1 : 1 + d + n], y[1 + d + n :]
    slopes = [(ahead[:both] - behind) / (2 * length), (ahead[both:] - value) / length]
    slopes = jnp.moveaxis(jnp.concatenate(slopes), 0, 1)
    r = jnp.where(shots.measured, (shots.y - value) / sigma, 0.0)
    slopes = jnp.where(shots.measured[:, None], slopes / sigma, 0.0)
    slopes = slopes.reshape(windows, d + n, -1)
    none = jnp.zeros((windows, still.size, slopes.shape[-1]), slopes.dtype)
    return r.reshape(windows, -1), jnp.concatenate([slopes[:, :d], none, slopes[:, d:]], 1)


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


_look = trace_once(
    expand, static_argnames=("predict", "step", "live"), compiler_options=COMPILER_OPTIONS, to_numpy=True
)


@dataclass(frozen=True)
class _Point:
    """Where a fit stands."""

    z: Float[np.ndarray, " d"]
    delta: Float[np.ndarray, "windows n"]
    r: Float[np.ndarray, "windows k"]
    slopes: Float[np.ndarray, "windows dn k"]
    curvature: Curvature
    left: float
    """`within_reach`: infinite where something is not finite."""


class _Problem:
    """What is fitted to what, in NumPy's numbers."""

    def __init__(
        self, predict: Predict, shots: Shots, sigma: np.ndarray, free: np.ndarray, step: float, live: int | None
    ) -> None:
        self.predict, self.shots, self.sigma, self.free, self.step, self.live = predict, shots, sigma, free, step, live
        self.center, self.shift = np.asarray(shots.center), np.asarray(shots.shift)
        self.spread, self.bounded = np.asarray(shots.spread), np.asarray(shots.bounded)

    def look(self, z: np.ndarray, delta: np.ndarray, alone: bool = False) -> tuple[np.ndarray, np.ndarray]:
        """Residuals over σ and slopes; these are wrong where the point is simulated `alone`."""
        return _look(self.predict, self.shots, z, delta, self.sigma, self.step, self.live, np.asarray(alone))

    def cost(self, z: np.ndarray, delta: np.ndarray) -> float:
        """What is made least."""
        return cost_of(self.look(z, delta, alone=True)[0], z - self.center, (delta - self.shift) / self.spread)

    def at(self, z: np.ndarray, delta: np.ndarray, seen: tuple[np.ndarray, np.ndarray] | None = None) -> _Point:
        """A point; what is `seen` there is simulated unless told."""
        r, slopes = self.look(z, delta) if seen is None else seen
        curvature = normal_equations(r, slopes, z - self.center, (delta - self.shift) / self.spread)
        return _Point(z, delta, r, slopes, curvature, within_reach(curvature, self.free))

    def propose(self, point: _Point, damping: float) -> tuple[np.ndarray, np.ndarray, float]:
        """Where a damped step leads, and by how much the cost should fall."""
        return propose(point.curvature, damping, self.free, self.bounded, self.spread, point.z, point.delta, LONGEST)

    def finish(self, point: _Point) -> _Point:
        """The last step, which is so short that residuals are linear."""
        z, delta, _ = self.propose(point, 0.0)
        move = np.concatenate(
            [np.broadcast_to(z - point.z, (len(delta), z.size)), (delta - point.delta) / self.spread], 1
        )
        return self.at(z, delta, (point.r - (move[:, None] @ point.slopes)[:, 0], point.slopes))

    def end(self, point: _Point, **how: Any) -> Fit:
        """A point as a fit."""
        c, held, known = point.curvature, self.free, point.left < np.inf
        precision, _, _, shift = eliminate(c) if known else (c.hessian, None, None, np.zeros_like(c.own_gradient))
        pulls = own_pulls(c, shift)
        found: dict[str, Any] = {
            "precision": np.where(np.outer(held, held), precision, np.eye(held.size, dtype=point.z.dtype)),
            "pulls": np.where(held, pulls, 0.0),
            "r": point.r.reshape(self.shots.y.shape),
            "cost": c.cost if known else np.inf,
            "z": point.z,
            "delta": point.delta,
            "sigma": self.sigma,
            "slopes": point.slopes,
        }
        return Fit(**found, **how)


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
    damping: float = DAMPING,
    live: int | None = None,
    known: Fit | None = None,
    tolerance: float | None = None,
) -> Fit:
    """Levenberg-Marquardt on (z, δ₁, …, δ_W) from a starting point; z stays as it is where it is not `free`.

    The simulator depends on the first `live` of z, on all unless told. `known` is a fit of the same to the same windows
    that ended at the starting point, with whatever noise: what was found there is not simulated again.

    A step that does not lower the cost, or leads to a number that is not finite, is refused and shortened; where the
    cost falls by less than a quarter of what the slopes promise, the next one is shorter, too. `damping` is where that
    begins. A point that is tried is simulated once, and those beside it only where it is better. The solver has
    converged when the slopes promise that the cost falls by less than 1e-3 to its least, and takes that step without
    simulating it; when two accepted steps in a row lower the cost by less than a `tolerance` of it, 1e-7 (1e-4 where
    `step` is told, as where bodies collide); or when no step does.

    Only the simulation of points and of those beside them is compiled.
    """
    kind = jnp.result_type(z)
    at, beside, noise = (np.asarray(x, kind) for x in (z, delta, sigma))
    problem = _Problem(predict, shots, noise, np.asarray(free), step, live)
    least = (ROUGH if step else TOLERANCE) if tolerance is None else tolerance
    damping, small, count = float(damping), 0, 1
    with np.errstate(all="ignore"):
        point = problem.at(at, beside, _rescaled(known, noise))
        while count < steps and SETTLED <= point.left < np.inf and small < 2 and damping < STUCK:
            count += 1
            to, moved, promised = problem.propose(point, damping)
            cost = point.curvature.cost
            fall = cost - problem.cost(to, moved)
            there = problem.at(to, moved) if fall >= 0.0 else None
            # where a simulation ends well those beside it may not
            if there is None or there.left == np.inf:
                damping *= 8
                continue
            eased = 1 / 5 if fall > 0.75 * promised else 1 if fall > 0.25 * promised else 2
            damping, point = max(damping * eased, LEAST), there
            small = small + 1 if fall < least * max(abs(cost), 1e-12) else 0
        converged = small >= 2 or damping >= STUCK or point.left < SETTLED
        point = problem.finish(point) if point.left < SETTLED else point
        return problem.end(point, steps=count, converged=converged, damping=damping)


def _rescaled(known: Fit | None, sigma: Float[np.ndarray, " obs"]) -> tuple[np.ndarray, np.ndarray] | None:
    """Residuals and slopes of a fit, if there is one, over another noise."""
    if known is None:
        return None
    by = np.asarray(known.sigma) / sigma
    r, slopes = np.asarray(known.r) * by, np.asarray(known.slopes)
    scaled = slopes.reshape(*slopes.shape[:2], -1, by.size) * by
    return r.reshape(len(r), -1), scaled.reshape(slopes.shape)


def robust_covariance(fit: Fit) -> Float[np.ndarray, "d d"]:
    """Covariance of z where the model is only nearly right: Laplace's, wider where windows disagree more than noise.

    With H⁻¹ = L Lᵀ the windows' gradients g have Σ Lᵀ g gᵀ L = I on average if the model is right. Where an eigenvalue
    of it is larger, the covariance is larger by as much (the sandwich H⁻¹ Σ g gᵀ H⁻¹); it is never smaller.

    Source: White 1982
    """
    root = np.linalg.inv(np.linalg.cholesky(np.asarray(fit.precision))).T
    pulls = np.asarray(fit.pulls) @ root
    values, axes = np.linalg.eigh(pulls.T @ pulls)
    wide = root @ (axes * np.sqrt(np.maximum(values, 1.0)))
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
