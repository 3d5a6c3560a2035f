"""A pipeline for Brax: its generalized dynamics, with contacts and stops solved to the end, by Runge-Kutta steps.

Brax's own takes four steps of a projected gradient on ½ |A f + b|²: it stops long before forces balance, and where a
foot slides the least squares are not what holds there. Here f is what the constraints' complementarity asks for,

    f ≥ 0,   A f + b ≥ 0,   fᵀ (A f + b) = 0,

with A = J M⁻¹ Jᵀ + R and b = J M⁻¹ τ − a_ref as Brax makes them, by sweeps of projected Gauss-Seidel; and a time step
is one of the classical fourth order, contacts solved anew in each of its four stages, as MuJoCo takes it for a model
that asks for it. For hinges and slides: what has a quaternion is not integrated.

Source: Todorov 2014; Freeman et al. 2021
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

__all__ = ["SWEEPS", "Motion", "init", "solve_complementarity", "step"]

SWEEPS = 10
"""After these, forces on a foot with two contacts change what is seen less than engines differ otherwise."""


@struct.dataclass
class Motion:
    """Coordinates and rates."""

    q: Float[Array, " n"]
    qd: Float[Array, " n"]


def init(model: Any, q: Float[Array, " n"], qd: Float[Array, " n"]) -> Motion:
    """The state with these coordinates and rates."""
    return Motion(q, qd)


def step(model: Any, state: Motion, act: Float[Array, " act"]) -> Motion:
    """One time step."""
    h = model.opt.timestep

    def stage(slope: Motion, share: Array) -> tuple[Motion, Motion]:
        there = jax.tree.map(lambda x, s: x + share * h * s, state, slope)
        slope = Motion(there.qd, _accelerate(model, there, act))
        return slope, slope

    still = jax.tree.map(jnp.zeros_like, state)
    _, slopes = jax.lax.scan(stage, still, jnp.array([0.0, 0.5, 0.5, 1.0]))
    weights = jnp.array([1.0, 2.0, 2.0, 1.0]) / 6.0
    return jax.tree.map(lambda x, s: x + h * weights @ s, state, slopes)


def solve_complementarity(a: Float[Array, "n n"], b: Float[Array, " n"], sweeps: int = SWEEPS) -> Float[Array, " n"]:
    """The f ≥ 0 with A f + b ≥ 0 and fᵀ (A f + b) = 0, for a positive semi-definite A; 0 where A has an empty row."""
    diagonal = jnp.diagonal(a)
    live = diagonal > 1e-9
    rows, offsets = (jnp.where(live, x.T / jnp.where(live, diagonal, 1.0), 0.0).T for x in (a, b))

    def sweep(f: Array, _: None) -> tuple[Array, None]:
        for i in range(b.size):
            f = f.at[i].set(jnp.maximum(f[i] - rows[i] @ f - offsets[i], 0.0))
        return f, None

    return jax.lax.scan(sweep, jnp.zeros_like(b), None, length=sweeps)[0]


def _accelerate(model: Any, state: Motion, act: Float[Array, " act"]) -> Float[Array, " n"]:
    """Accelerations, with the mass matrix inverted where Brax would improve an inverse that it carries along."""
    actuator = import_module("brax.actuator")
    dynamics, pipeline = (import_module(f"brax.generalized.{name}") for name in ("dynamics", "pipeline"))
    there = pipeline.init(model, state.q, state.qd)
    free = dynamics.forward(model, there, actuator.to_tau(model, act, state.q, state.qd))
    weighed = there.con_jac @ there.mass_mx_inv
    a = weighed @ there.con_jac.T + jnp.diag(there.con_diag)
    f = solve_complementarity(a, weighed @ free - there.con_aref)
    return there.mass_mx_inv @ (free + there.con_jac.T @ f)
