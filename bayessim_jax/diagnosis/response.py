"""A simulator's linear response around recorded motion: what any force would have changed in what was measured.

Let x̄ be the smoothed motion. The deviation e = x − x̄ of a simulation with further forces f obeys

    e_{t+1} = A_t e_t + (F(x̄_t, u_t; θ) − x̄_{t+1}) + B_t f_t + O(e²)

with F one row's step of the simulator and A, B its derivatives at x̄. It is expanded around the motion itself and not
around a prediction: for the right forces e is no larger than the error of the smoothing, however strong they are, so
that candidates are compared without simulating any of them, and without compiling one either. What is fitted is what
`inference.shooting` fits: θ, the candidate's parameters and every window's initial state, to what was measured.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from bayessim_jax.engines.batch import map_in_blocks
from bayessim_jax.inference.arrow import Curvature, cost_of
from bayessim_jax.inference.shooting import COMPILER_OPTIONS, FEW_CALLS
from bayessim_jax.programs import trace_once
from bayessim_jax.systems.mjcf import displace

__all__ = [
    "Beside",
    "Forcing",
    "Linearized",
    "Motion",
    "Numbers",
    "Readings",
    "Rest",
    "Ways",
    "Windowed",
    "assess",
    "bound_gains",
    "cross_validate",
    "differ",
    "expand_response",
    "find_gaps",
    "find_heavier",
    "move_steps",
    "respond",
    "weigh",
]

EASY = 1e-6
"""Precision of forces that may be any, to what they move on average."""
Numbers = Array | np.ndarray
"""What is put together on the host, or comes from a program."""


@struct.dataclass
class Motion:
    """Smoothed motion in windows, and the commands."""

    qpos: Float[Array, "windows rows nq"]
    qvel: Float[Array, "windows rows nv"]
    ctrl: Float[Array, "windows steps nu"]
    past: Float[Array, "windows before nu"]
    start: Float[Array, " windows"]
    """s in its recording."""
    earlier: tuple[Float[Array, "windows before nq"], Float[Array, "windows before nv"]] | None = None
    """Positions and velocities before the windows, in as many rows as `past`."""


@struct.dataclass
class Linearized:
    """One row's step around the motion, for every row; n = 2 nv is (move along every degree of freedom, velocity)."""

    a: Float[Array, "windows steps n n"]
    b: Float[Array, "windows steps n nv"]
    """Per generalized force held for the row."""
    along: Float[Array, "windows steps n k"]
    """Along θ's z and the model's own parameters of a candidate."""
    gap: Float[Array, "windows steps n"]
    """F(x̄_t, u_t; θ) − x̄_{t+1}."""


@struct.dataclass
class Windowed:
    """What was measured, and how it is seen of a deviation."""

    y: Float[Array, "windows rows obs"]
    measured: Bool[Array, "windows rows obs"]
    seen: Float[Array, "windows rows obs"]
    """Of the motion itself."""
    c: Float[Array, "windows rows obs n"]
    spread: Float[Array, " n"]
    """Standard deviation of an initial state."""


@struct.dataclass
class Readings:
    """What a candidate does to readings: they are `scale · reading + shift`; the scale is 1 where it does nothing."""

    scale: Float[Numbers, "windows rows obs"]
    shift: Float[Numbers, "windows rows obs"]
    along: Float[Numbers, "windows rows obs e"]
    first_along: Float[Numbers, "windows n e"]
    """How the motion's first state moves with what readings are restored by."""


@struct.dataclass
class Forcing:
    """What a candidate adds to every row's step, and does to readings, at one point of its first e parameters.

    It may have more of them, which then do nothing there.
    """

    force: Float[Numbers, "windows steps nv"]
    along: Float[Numbers, "windows steps nv e"]
    readings: Readings | None = None


@struct.dataclass
class Rest:
    """What no candidate changes to first order: how readings over σ move with θ's z and with initial states."""

    slopes: Float[np.ndarray, "windows dn rowsobs"]
    """0 where nothing was measured."""
    products: Float[np.ndarray, "windows dn dn"]
    """Of the slopes, summed over rows and channels."""


def separate(model: mujoco.MjModel, origin: Float[Array, " nq"], to: Float[Array, " nq"]) -> Float[Array, " nv"]:
    """The move along every degree of freedom that leads from one pose to another: the inverse of `displace`."""
    pieces, free, ball = [], mujoco.mjtJoint.mjJNT_FREE, mujoco.mjtJoint.mjJNT_BALL
    for joint in range(model.njnt):
        q, kind = int(model.jnt_qposadr[joint]), model.jnt_type[joint]
        if kind == free:
            pieces += [to[q : q + 3] - origin[q : q + 3], _rotation(origin[q + 3 : q + 7], to[q + 3 : q + 7])]
        elif kind == ball:
            pieces.append(_rotation(origin[q : q + 4], to[q : q + 4]))
        else:
            pieces.append(to[q : q + 1] - origin[q : q + 1])
    return jnp.concatenate(pieces)


def _rotation(origin: Float[Array, "4"], to: Float[Array, "4"]) -> Float[Array, "3"]:
    """Rotation vector of a small turn: 2 vec(origin⁻¹ to)."""
    w, v, ow, ov = to[0], to[1:], origin[0], origin[1:]
    turn = ow * v - w * ov - jnp.cross(ov, v)
    return 2.0 * jnp.sign(ow * w + ov @ v) * turn


def _rows(motion: Motion) -> tuple[Array, ...]:
    """Positions and velocities of every row and of the next one, and the command between them."""
    return motion.qpos[:, :-1], motion.qvel[:, :-1], motion.qpos[:, 1:], motion.qvel[:, 1:], motion.ctrl


def _miss(engine: Any, substeps: int, row: tuple[Array, ...], move: Array, force: Array, inner: Array) -> Array:
    """How far one row's step from beside the motion, under a force, leads from the next row."""
    q, v, q_next, v_next, u = row
    nv = engine.model.nv
    state = engine.init(inner, displace(engine.model, q, move[:nv]), v + move[nv:])
    after = engine.step(inner, state, u, force, substeps)
    return jnp.concatenate([separate(engine.model, q_next, engine.qpos(after)), engine.qvel(after) - v_next])


def _miss_all(engine: Any, substeps: int, motion: Motion, move: Array, force: Array, inner: Array) -> Array:
    """The same of every row of every window."""
    windows, steps, _ = motion.ctrl.shape
    rows = [x.reshape(windows * steps, x.shape[-1]) for x in _rows(motion)]
    found = map_in_blocks(lambda *row: _miss(engine, substeps, row, move, force, inner), *rows)
    return found.reshape(windows, steps, 2 * engine.model.nv)


@struct.dataclass
class Beside:
    """Points beside a motion from which steps are taken: k of them, the first is the motion itself."""

    x: Float[Numbers, "k m"]
    """`numbers(x)` is the engine's θ."""
    move: Float[Numbers, "k n"]
    """Of the state."""
    force: Float[Numbers, "k nv"]


@trace_once(static_argnames=("engine", "numbers", "substeps"), compiler_options=COMPILER_OPTIONS)
def find_gaps(
    engine: Any, numbers: Any, motion: Motion, beside: Beside, count: int | Int[Array, ""], substeps: int
) -> Float[Array, "k windows steps n"]:
    """Where every row's step leads from several points, less the next row; only the first `count` are looked at."""

    def put(k: Array, every: Array) -> Array:
        inner = numbers(beside.x[k])
        return every.at[k].set(_miss_all(engine, substeps, motion, beside.move[k], beside.force[k], inner))

    shape = (len(beside.x), *motion.ctrl.shape[:2], 2 * engine.model.nv)
    return jax.lax.fori_loop(0, count, put, jnp.zeros(shape))


@struct.dataclass
class Ways:
    """Which of the points lie along what; a way has its point ahead, and one behind if differences are central."""

    width: Float[Numbers, " w"]
    """Between the two, or from the motion to the one ahead."""
    own: Int[Numbers, " e"]
    """Ways along a candidate's own parameters, and the places of these among p; a place beyond the last is none."""
    places: Int[Numbers, " e"]
    force: Int[Numbers, " nv"]
    state: Int[Numbers, " n"]
    theta: Int[Numbers, " d"]


@partial(jax.jit, static_argnames="central", compiler_options=COMPILER_OPTIONS)
def differ(
    lin: Linearized | None, gaps: Float[Array, "k windows steps n"], ways: Ways, forced: bool, central: bool
) -> Linearized:
    """Linearized steps by differences of `gaps`.

    With `lin` only what a candidate's own parameters do is new, and what forces do if it is `forced`; the rest is as
    it was linearized elsewhere.
    """
    gap = gaps[0]
    ahead, behind = (gaps[1::2], gaps[2::2]) if central else (gaps[1:], gap[None] + jnp.zeros((len(gaps) - 1, 1, 1, 1)))

    def slopes(rows: Int[Numbers, " r"]) -> Float[Array, "windows steps n r"]:
        return jnp.moveaxis((ahead[rows] - behind[rows]) / ways.width[rows, None, None, None], 0, -1)

    theta = slopes(ways.theta) if lin is None else lin.along[..., : ways.theta.size]
    along = jnp.pad(theta, [(0, 0)] * 3 + [(0, ways.own.size)])
    along = along.at[..., ways.places].set(slopes(ways.own), mode="drop")
    if lin is None:
        return Linearized(slopes(ways.state), slopes(ways.force), along, gap)
    return Linearized(lin.a, jnp.where(forced, slopes(ways.force), lin.b), along, gap)


@trace_once(static_argnames=("engine", "numbers", "substeps"), compiler_options=COMPILER_OPTIONS)
def move_steps(
    engine: Any,
    numbers: Any,
    motion: Motion,
    x: Float[Numbers, " m"],
    b: Float[Array, "windows steps n nv"],
    heavier: Float[Array, "windows steps d nv nv"] | None,
    shift: Float[Numbers, " d"],
    substeps: int,
) -> tuple[Float[Array, "windows steps n"], Float[Array, "windows steps n nv"], Bool[Array, ""]]:
    """`gap` and `b` of linearized steps where only θ is another, by `shift`; forces do what `find_heavier` says.

    And whether every joint gives way to a force on it: inertia that is not linear in θ may come out negative.
    """
    nv = engine.model.nv
    gap = _miss_all(engine, substeps, motion, jnp.zeros(2 * nv), jnp.zeros(nv), numbers(x))
    if heavier is not None:
        grown = jnp.einsum("wtdij,d->wtij", heavier, shift)
        b = _divide(b, jnp.eye(nv) + jnp.einsum("wtij,wtjk->wtik", grown, b[..., nv:, :]))
    return gap, b, (jnp.diagonal(b[..., nv:, :], axis1=-2, axis2=-1) > 0.0).all()


def _divide(b: Float[Array, "windows steps n nv"], by: Float[Array, "windows steps nv nv"]) -> Array:
    """Many small matrices b by⁻¹, `by` near to positive multiples of 1: elimination without a choice of pivots.

    Written out, for a solver that is called for each of them takes six times as long.
    """
    nv = by.shape[-1]
    rows, found = [[by[..., j, i] for j in range(nv)] for i in range(nv)], [b[..., i] for i in range(nv)]
    for k in range(nv):
        for i in (i for i in range(nv) if i != k):
            share = rows[i][k] / rows[k][k]
            rows[i][k + 1 :] = [x - share * y for x, y in zip(rows[i][k + 1 :], rows[k][k + 1 :], strict=True)]
            found[i] = found[i] - share[..., None] * found[k]
    return jnp.stack([found[k] / rows[k][k][..., None] for k in range(nv)], -1)


@trace_once(compiler_options=FEW_CALLS)
def find_heavier(
    lin: Linearized, gaps: Float[Array, "d k windows steps n"], width: Float[Numbers, " nv"], by: Float[Numbers, " d"]
) -> Float[Array, "windows steps d nv nv"]:
    """∂(b_v⁻¹)/∂θ_j, with b_v the rows of b that are velocities: what withstands forces grows linearly with masses.

    From gaps with each θ larger by so much: without a force, and with one of a width each.
    """
    nv = len(width)
    there = (gaps[:, 1 : nv + 1] - gaps[:, :1]) / width[:, None, None, None]
    there = jnp.transpose(there[..., nv:], (2, 3, 0, 4, 1))
    found = (jnp.linalg.inv(there) - jnp.linalg.inv(lin.b[..., None, nv:, :])) / by[:, None, None]
    return jnp.where(jnp.isfinite(found), found, 0.0)


def _see(
    lin: Linearized, windowed: Windowed, first: Float[Array, "windows n k"], added: Float[Array, "windows steps n k"]
) -> Float[Array, "windows rows obs k"]:
    """What the sensors show of several deviations, e_{t+1} = A_t e_t + g_t.

    Windows lie along the last axis, where a processor's vectors take several at once, and sums over the few
    coordinates of a state are written out: as products of small matrices they take three times as long.
    """
    first, added = (jnp.moveaxis(x, 0, -1) for x in (first, added))
    a, c = (jnp.transpose(x, (1, 3, 2, 0)) for x in (lin.a, windowed.c))

    def apply(by: Float[Array, "... n m windows"], e: Float[Array, "... n k windows"]) -> Array:
        return sum(by[..., j, :, None, :] * e[..., j, None, :, :] for j in range(e.shape[-3]))  # pyright: ignore[reportReturnType]

    def once(e: Array, now: tuple[Array, Array]) -> tuple[Array, Array]:
        after = apply(now[0], e) + now[1]
        return after, after

    e = jnp.concatenate([first[None], jax.lax.scan(once, first, (a, added))[1]])
    return jnp.moveaxis(apply(c, e), -1, 0)


@trace_once(static_argnames="d", compiler_options=FEW_CALLS, to_numpy=True)
def respond(lin: Linearized, windowed: Windowed, d: int) -> Float[Array, "windows dn rowsobs"]:
    """How readings move with θ's z and with the initial state: what no candidate changes to first order."""
    count, steps, n = lin.gap.shape
    first = jnp.broadcast_to(jnp.eye(n, d + n, d), (count, n, d + n))
    added = jnp.concatenate([lin.along[..., :d], jnp.zeros((count, steps, n, n))], -1)
    slopes = jnp.moveaxis(_see(lin, windowed, first, added).reshape(count, -1, d + n), 1, 2)
    return slopes.at[:, d:].multiply(windowed.spread[:, None])


def weigh(shared: Float[np.ndarray, "windows dn rowsobs"], windowed: Windowed, sigma: Float[Array, " obs"]) -> Rest:
    """What `respond` says, over σ."""
    weight = np.where(np.asarray(windowed.measured), 1.0 / np.asarray(sigma), 0.0)
    return _rest_of(shared * weight.reshape(len(weight), 1, -1))


def _rest_of(slopes: Float[np.ndarray, "windows dn rowsobs"]) -> Rest:
    return Rest(slopes, slopes @ slopes.swapaxes(1, 2))


def _read(rest: Rest, readings: Readings | None) -> Rest:
    """The same as a candidate's sensors show it."""
    if readings is None:
        return rest
    return _rest_of(rest.slopes * np.asarray(readings.scale).reshape(len(rest.slopes), 1, -1))


def _foresee(
    lin: Linearized,
    windowed: Windowed,
    forcing: Forcing,
    moved: Float[Array, " k"],
    delta: Float[Array, "windows n"],
    sigma: Float[Array, " obs"],
    d: int,
) -> tuple[Float[Array, "windows rowsobs"], Float[Array, "windows e rowsobs"]]:
    """Residuals over σ, and derivatives of what is predicted over σ along the candidate's parameters, after d of θ."""
    count, e = len(delta), forcing.along.shape[-1]
    forced = lin.gap + jnp.einsum("wtnv,wtv->wtn", lin.b, forcing.force) + lin.along @ moved
    columns = lin.along[..., d : d + e] + jnp.einsum("wtnv,wtvk->wtnk", lin.b, forcing.along)
    readings = forcing.readings
    first = jnp.zeros((*delta.shape, e)) if readings is None else readings.first_along
    first = jnp.concatenate([delta[..., None], first], -1)
    seen = _see(lin, windowed, first, jnp.concatenate([forced[..., None], columns], -1))
    value, own = windowed.seen + seen[..., 0], seen[..., 1:]
    if readings is not None:
        value = readings.scale * value + readings.shift
        own = readings.scale[..., None] * own + readings.along
    weight = jnp.where(windowed.measured, 1.0 / sigma, 0.0)
    r = jnp.where(windowed.measured, (windowed.y - value) / sigma, 0.0).reshape(count, -1)
    return r, jnp.moveaxis((own * weight[..., None]).reshape(count, -1, e), 1, 2)


_foreseen = trace_once(_foresee, static_argnames="d", compiler_options=COMPILER_OPTIONS, to_numpy=True)


@np.errstate(all="ignore")
def assess(
    lin: Linearized,
    rest: Rest,
    windowed: Windowed,
    forcing: Forcing,
    moved: Float[np.ndarray, " k"],
    p: Float[np.ndarray, " k"],
    delta: Float[Array, "windows n"],
    sigma: Float[Array, " obs"],
) -> tuple[Curvature, Float[np.ndarray, "windows rows obs"]]:
    """Normal equations, and residuals over σ.

    p is [θ's z, the candidate's x], each with a standard normal prior, and `moved` how far it is from where the steps
    were found; `rest` is of steps linearized there or nearby. Only what the candidate changes is computed anew.
    """
    (windows, n), scaled = delta.shape, np.asarray(delta) / np.asarray(windowed.spread)
    d = rest.slopes.shape[1] - n
    r, own = _foreseen(lin, windowed, forcing, moved, delta, sigma, d)
    rest = _read(rest, forcing.readings)
    both = np.concatenate([own, r[:, None]], 1).swapaxes(1, 2)
    along_rest, along_own = rest.slopes @ both, own @ both
    beside, pull = along_rest[..., :-1], along_rest[..., -1]
    k = d + own.shape[1]
    hessian, room = np.eye(p.size), p.size - k
    hessian[:d, :d] += rest.products[:, :d, :d].sum(0)
    hessian[:d, d:k] = beside[:, :d].sum(0)
    hessian[d:k, :d] = hessian[:d, d:k].T
    hessian[d:k, d:k] += along_own[..., :-1].sum(0)
    pulls = np.concatenate([pull[:, :d], along_own[..., -1], np.zeros((windows, room))], 1)
    curvature = Curvature(
        cost=cost_of(r, p, scaled),
        hessian=hessian,
        gradient=pulls.sum(0) - p,
        own=rest.products[:, d:, d:] + np.eye(n),
        cross=np.concatenate([rest.products[:, d:, :d], beside[:, d:], np.zeros((windows, n, room))], -1),
        own_gradient=pull[:, d:] - scaled,
        pulls=pulls,
    )
    return curvature, r.reshape(windowed.y.shape)


def expand_response(
    lin: Linearized,
    rest: Rest,
    windowed: Windowed,
    forcing: Forcing,
    moved: Float[np.ndarray, " k"],
    delta: Float[Array, "windows n"],
    sigma: Float[Array, " obs"],
) -> tuple[Float[np.ndarray, "windows rows obs"], Float[np.ndarray, "windows kn rowsobs"]]:
    """Residuals over σ, and the derivatives of what is predicted over σ along p and the initial states."""
    d = rest.slopes.shape[1] - delta.shape[-1]
    r, own = _foreseen(lin, windowed, forcing, moved, delta, sigma, d)
    slopes = _read(rest, forcing.readings).slopes
    own = np.pad(own, ((0, 0), (0, moved.size - d - own.shape[1]), (0, 0)))
    return r.reshape(windowed.y.shape), np.concatenate([slopes[:, :d], own, slopes[:, d:]], 1)


@trace_once(static_argnames="pieces", compiler_options=FEW_CALLS, to_numpy=True)
def bound_gains(
    lin: Linearized,
    rest: Rest,
    windowed: Windowed,
    forcing: Forcing,
    moved: Float[Array, " k"],
    p: Float[Array, " k"],
    delta: Float[Array, "windows n"],
    sigma: Float[Array, " obs"],
    pieces: int,
) -> Float[Array, " nv"]:
    """By how much the cost falls if any force acts on one degree of freedom, for each: no effect does better there.

    The force is constant in so many pieces of every window; θ, the candidate's x and initial states give way to it.
    """
    (count, steps, n), nv = lin.gap.shape, lin.b.shape[-1]
    d, readings = rest.slopes.shape[1] - n, forcing.readings
    r, own = _foresee(lin, windowed, forcing, moved, delta, sigma, d)
    scale = jnp.ones(()) if readings is None else jnp.asarray(readings.scale)
    slopes = rest.slopes * jnp.broadcast_to(scale, windowed.y.shape).reshape(count, 1, -1)
    held = jnp.arange(steps)[:, None] * pieces // steps == jnp.arange(pieces)
    added = jnp.einsum("wtnv,tb->wtnvb", lin.b, held).reshape(count, steps, n, -1)
    seen = _see(lin, windowed, jnp.zeros((count, n, nv * pieces)), added)
    weight = scale * jnp.where(windowed.measured, 1.0 / sigma, 0.0)
    pushed = (seen * weight[..., None]).reshape(count, -1, nv, pieces)
    size = jnp.sqrt((pushed**2).sum((0, 1, 3)) / (count * pieces))
    pushed = pushed / jnp.maximum(size, 1e-30)[:, None]
    shared = jnp.concatenate([slopes[:, :d], own], 1)
    point, states = p[: shared.shape[1]], delta / windowed.spread
    alike = jnp.einsum("wik,wjk->ij", shared, shared) + jnp.eye(len(point))
    pull = jnp.einsum("wik,wk->i", shared, r) - point

    def gain(
        free: Float[Numbers, "windows m rowsobs"], prior: Float[Array, " m"], at: Float[Array, "windows m"]
    ) -> Array:
        """By how much the cost falls in a step of Gauss and Newton along what is shared and what each window has."""
        alone = jnp.einsum("wik,wjk->wij", free, free) + jnp.diag(prior)
        beside = jnp.einsum("wik,wjk->wij", free, shared)
        gradient = jnp.einsum("wik,wk->wi", free, r) - prior * at
        solved = jnp.linalg.solve(alone, jnp.concatenate([beside, gradient[..., None]], -1))
        hessian = alike - jnp.einsum("wmi,wmj->ij", beside, solved[..., :-1])
        slope = pull - jnp.einsum("wmi,wm->i", beside, solved[..., -1])
        return 0.5 * (jnp.vdot(gradient, solved[..., -1]) + slope @ jnp.linalg.solve(hessian, slope))

    def under(force: Float[Array, "windows rowsobs pieces"]) -> Array:
        free = jnp.concatenate([slopes[:, d:], jnp.moveaxis(force, 1, 2)], 1)
        prior = jnp.concatenate([jnp.ones(n), jnp.full(pieces, EASY)])
        return gain(free, prior, jnp.pad(states, ((0, 0), (0, pieces))))

    still = gain(slopes[:, d:], jnp.ones(n), states)
    return jax.lax.map(under, jnp.moveaxis(pushed, 2, 0)) - still


@trace_once(compiler_options=FEW_CALLS, to_numpy=True)
def cross_validate(
    r: Float[Array, "windows rows obs"],
    slopes: Float[Array, "windows kn rowsobs"],
    measured: Bool[Array, "windows rows obs"],
    p: Float[Array, " k"],
    free: Bool[Array, " k"],
    sigma: Float[Array, " obs"],
    floor: Float[Array, " obs"],
    folds: Bool[Array, "folds windows"],
    scaled: Float[Array, "windows n"],
    shared: Bool[Array, " n"],
) -> Float[Array, " windows"]:
    """Log predictive density of every window by fits without the windows of its fold, linear around one fit to all.

    Noise is that of the training windows; a window's own initial state, δ/S = `scaled` in the fit, is profiled out, and
    what only this candidate has of it, not `shared`, is integrated out: who remembers more has to be right for more of
    it. With J = ∂r/∂(δ/S), H = I + Jᵀ J, indices m for these and s for what is shared,

        log p(y) = log N(y; ŷ(δ), σ²) − ½ |δₘ/Sₘ|² − ½ (log det H − log det Hₛₛ).
    """
    k, n = p.size, scaled.shape[-1]
    flat = r.reshape(len(r), -1)
    free_all = jnp.concatenate([free, jnp.ones(n, bool)])
    slopes = jnp.where(free_all[:, None], slopes, 0.0)
    own = jnp.einsum("wik,wjk->wij", slopes[:, k:], slopes[:, k:]) + jnp.eye(n)
    common = jnp.where(shared[:, None] & shared, own, jnp.eye(n))
    width = 0.5 * (jnp.linalg.slogdet(own)[1] - jnp.linalg.slogdet(common)[1])

    def fit(weight: Array) -> tuple[Array, Array]:
        """Of the fit to windows of some weight, what is left of every window at its own best state, and that δ/S."""
        cross = jnp.einsum("wik,wjk->wij", slopes[:, k:], slopes[:, :k])
        pull = jnp.einsum("wik,wk->wi", slopes, flat).at[:, k:].add(-scaled)
        toward = jnp.linalg.solve(own, jnp.concatenate([cross, pull[:, k:, None]], -1))
        hessian = jnp.einsum("wik,wjk->wij", slopes[:, :k], slopes[:, :k]) - jnp.einsum(
            "wni,wnj->wij", cross, toward[..., :k]
        )
        gradient = pull[:, :k] - jnp.einsum("wni,wn->wi", cross, toward[..., k])
        total = jnp.einsum("w,wij->ij", weight, hessian) + jnp.eye(k)
        move = jnp.linalg.solve(total, jnp.einsum("w,wi->i", weight, gradient) - p)
        move = jnp.where(free, move, 0.0)
        move = move / jnp.maximum(jnp.abs(move).max(initial=0.0), 1.0)
        state = toward[..., k] - toward[..., :k] @ move
        left = flat - jnp.einsum("wik,i->wk", slopes[:, :k], move) - jnp.einsum("wik,wi->wk", slopes[:, k:], state)
        return left.reshape(r.shape), scaled + state

    def one(out: Array) -> Array:
        weight = jnp.where(out.all(), 1.0, 1.0 - out)
        left, state = fit(weight)
        counts = jnp.einsum("w,wro->o", weight, measured.astype(flat.dtype))
        share = jnp.maximum(1.0 - (k + n * weight.sum()) / jnp.maximum(counts.sum(), 1.0), 0.2)
        ratio = jnp.sqrt(jnp.einsum("w,wro->o", weight, left**2) / jnp.maximum(counts * share, 1.0))
        ratio = jnp.maximum(ratio, floor / sigma)
        logs = jnp.where(measured, -0.5 * (left / ratio) ** 2 - jnp.log(ratio * sigma), 0.0)
        return jnp.where(out, logs.sum((1, 2)) - 0.5 * (state**2 * ~shared).sum(-1) - width, 0.0)

    return jax.vmap(one)(folds).sum(0)
