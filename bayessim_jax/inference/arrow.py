"""Normal equations in the shape of an arrow: numbers z that all windows share, and numbers δ that each has of its own.

Every δ is eliminated by itself, so that a step costs as much as many small problems. They are NumPy's, on the host: a
few megaflops between simulations, for which a compiler takes longer than all of them.

Source: Nocedal and Wright 2006, chapter 10; Marquardt 1963 (damping)
"""

from __future__ import annotations

import numpy as np
from flax import struct
from jaxtyping import Bool, Float
from scipy.special import ndtr, ndtri

__all__ = ["Curvature", "cost_of", "eliminate", "normal_equations", "own_pulls", "propose", "stride", "within_reach"]

OUTERMOST = 1e-4
"""Share of an interval at either end into which no step from the other one leads."""


@struct.dataclass
class Curvature:
    """The normal equations of all windows at one point, the initial states eliminated one by one."""

    cost: float
    """`cost_of` it."""
    hessian: Float[np.ndarray, "d d"]
    """Of z, with z's prior."""
    gradient: Float[np.ndarray, " d"]
    own: Float[np.ndarray, "windows n n"]
    """Of every δ_w, with its prior."""
    cross: Float[np.ndarray, "windows n d"]
    own_gradient: Float[np.ndarray, "windows n"]
    pulls: Float[np.ndarray, "windows d"]
    """Every window's part of the gradient of z."""


def cost_of(r: np.ndarray, own: Float[np.ndarray, " d"], scaled: Float[np.ndarray, "windows n"]) -> float:
    """½ (Σ r² + zᵀz + Σ δᵀS⁻²δ), where `own` and `scaled` are z and δ/S less their priors' means."""
    return float(0.5 * ((r**2).sum() + own @ own + (scaled**2).sum()))


@np.errstate(all="ignore")
def normal_equations(
    r: Float[np.ndarray, "windows k"],
    slopes: Float[np.ndarray, "windows dn k"],
    own: Float[np.ndarray, " d"],
    scaled: Float[np.ndarray, "windows n"],
) -> Curvature:
    """Of residuals and slopes as `expand` gives them; `own` and `scaled` as in `cost_of`."""
    d, n = own.size, scaled.shape[-1]
    products = slopes @ slopes.swapaxes(1, 2)
    pulls = (slopes @ r[..., None])[..., 0]
    return Curvature(
        cost=cost_of(r, own, scaled),
        hessian=products[:, :d, :d].sum(0) + np.eye(d, dtype=own.dtype),
        gradient=pulls[:, :d].sum(0) - own,
        own=products[:, d:, d:] + np.eye(n, dtype=own.dtype),
        cross=products[:, d:, :d],
        own_gradient=pulls[:, d:] - scaled,
        pulls=pulls[:, :d],
    )


def eliminate(c: Curvature, damping: float = 0.0) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Precision of z after the δ are eliminated, its gradient, and per window own⁻¹ cross and own⁻¹ gradient."""
    own = c.own + damping * np.eye(c.own.shape[-1], dtype=c.own.dtype) * c.own.diagonal(axis1=1, axis2=2)[..., None]
    solved = _solve(own, np.concatenate([c.cross, c.own_gradient[..., None]], axis=-1))
    toward, shift = solved[..., :-1], solved[..., -1]
    precision = c.hessian - np.tensordot(c.cross, toward, ((0, 1), (0, 1)))
    return precision, c.gradient - np.tensordot(c.cross, shift, ((0, 1), (0, 1))), toward, shift


def _solve(a: Float[np.ndarray, "*some n n"], b: np.ndarray) -> np.ndarray:
    """The solution of a x = b, no numbers where there is none."""
    try:
        return np.linalg.solve(a, b)
    except np.linalg.LinAlgError:
        return np.full_like(b, np.nan)


def own_pulls(c: Curvature, shift: Float[np.ndarray, "windows n"]) -> Float[np.ndarray, "windows d"]:
    """Every window's part of the gradient of z where its δ, eliminated, takes a step."""
    return c.pulls - (c.cross.swapaxes(1, 2) @ shift[..., None])[..., 0]


def _lead(
    c: Curvature, damping: float, free: Bool[np.ndarray, " d"]
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """A step of z, how every δ follows it, their own steps, and the gradient of z with every δ eliminated."""
    precision, gradient, toward, shift = eliminate(c, damping)
    k = np.flatnonzero(free)
    move = np.zeros_like(gradient)
    damped = precision[np.ix_(k, k)] + damping * np.diag(c.hessian.diagonal()[k])
    move[k] = _solve(damped, gradient[k])
    return move, toward, shift, gradient


def within_reach(c: Curvature, free: Bool[np.ndarray, " d"]) -> float:
    """By how much the cost falls to its least, were residuals linear and only what is `free` of z changed.

    Infinite where something is not finite.
    """
    move, _, shift, gradient = _lead(c, 0.0, free)
    fall = float(0.5 * (move @ gradient + (shift * c.own_gradient).sum()))
    return fall if np.isfinite(fall) and np.isfinite(c.cost) else np.inf


@np.errstate(all="ignore")
def propose(
    c: Curvature,
    damping: float,
    free: Bool[np.ndarray, " d"],
    bounded: Bool[np.ndarray, " d"] | bool,
    spread: Float[np.ndarray, " n"],
    z: Float[np.ndarray, " d"],
    delta: Float[np.ndarray, "windows n"],
    longest: float,
) -> tuple[Float[np.ndarray, " d"], Float[np.ndarray, "windows n"], float]:
    """Where a damped step leads from (z, δ), and by how much the cost falls there were residuals linear."""
    move, toward, shift, _ = _lead(c, damping, free)
    to, move = stride(z, move, bounded, longest)
    states = shift - toward @ move
    bend = move @ c.hessian @ move + ((c.own @ states[..., None])[..., 0] * states).sum()
    fall = c.gradient @ move + (c.own_gradient * states).sum() - 0.5 * bend - (states * (c.cross @ move)).sum()
    return to, delta + states * spread, float(fall)


def stride(
    z: Float[np.ndarray, " d"],
    move: Float[np.ndarray, " d"],
    bounded: Bool[np.ndarray, " d"] | bool,
    longest: float,
) -> tuple[Float[np.ndarray, " d"], Float[np.ndarray, " d"]]:
    """Where a step along the slopes at z leads, and the part of it that is taken.

    What is `bounded` is at Φ(z) of its interval. At its ends Φ is flat: a step back from there would be far too long,
    and so small a part of it would be taken, of all other directions as well. Such a step is as long as it is in Φ.
    Of all others none is longer than `longest`.
    """

    def lead(move: Float[np.ndarray, " d"]) -> Float[np.ndarray, " d"]:
        density = np.exp(-0.5 * z**2) / np.sqrt(2.0 * np.pi)
        inward = ndtri(np.clip(ndtr(z) + density * move, OUTERMOST, 1.0 - OUTERMOST)) - z
        return np.where(bounded & (inward * move > 0.0) & (np.abs(inward) < np.abs(move)), inward, move)

    whole = np.where(lead(move) == move, np.abs(move), 0.0).max(initial=0.0)
    taken = move * min(1.0, longest / max(whole, 1e-12))
    return (z + lead(taken)).astype(z.dtype), taken.astype(z.dtype)
