"""A pipeline for Brax: its generalized dynamics, with contacts and stops solved to the end, by Runge-Kutta steps.

Brax's own takes four steps of a projected gradient on ½ |A f + b|²: it stops long before forces balance, and where a
foot slides the least squares are not what holds there. Here accelerations a are those of Gauss's principle,

    min ½ (a − M⁻¹ τ)ᵀ M (a − M⁻¹ τ) + ½ Σᵢ min(0, Jᵢ a − a_refᵢ)² / Rᵢ,

with M, J, R and a_ref as Brax makes them, found by Newton's method; and a time step is one of the classical fourth
order, contacts solved anew in each of its four stages, as MuJoCo takes it for a model that asks for it. For hinges and
slides: what has a quaternion is not integrated.

Source: Todorov 2014; Freeman et al. 2021
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

__all__ = ["NEWTON", "Motion", "init", "solve_constraints", "step"]

NEWTON = 6
"""Enough for two contacts and a stop in every one of a thousand states; four steps are in nearly all."""


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


def solve_constraints(
    mass: Float[Array, "n n"],
    force: Float[Array, " n"],
    jacobian: Float[Array, "m n"],
    compliance: Float[Array, " m"],
    wanted: Float[Array, " m"],
    steps: int = NEWTON,
) -> Float[Array, " n"]:
    """The a with M a = τ + Jᵀ f, f = max(0, a_ref − J a) / R; rows of no compliance are not there.

    Newton's method on a convex cost that is piecewise quadratic: where the rows that push are the right ones, one step
    ends there. Its steps are whole ones, which from the motion without constraints is enough for few of them.
    """
    stiffness = jnp.where(compliance > 0.0, 1.0 / jnp.where(compliance > 0.0, compliance, 1.0), 0.0)

    def newton(pushes: Array, _: None) -> tuple[Array, Array]:
        weighed = jacobian.T * pushes
        a = _solve(mass + weighed @ jacobian, force + weighed @ wanted)
        return jnp.where(jacobian @ a < wanted, stiffness, 0.0), a

    return jax.lax.scan(newton, jnp.zeros_like(wanted), None, length=1 + steps)[1][-1]


def _solve(a: Float[Array, "n n"], b: Float[Array, " n"]) -> Float[Array, " n"]:
    """A⁻¹ b of a small positive definite A, by Cholesky's factors written out: in batches quicker than LAPACK."""
    n = b.size
    lower: list[list[Any]] = [[0.0] * n for _ in range(n)]
    for j in range(n):
        lower[j][j] = jnp.sqrt(a[j, j] - sum(lower[j][k] ** 2 for k in range(j)))
        for i in range(j + 1, n):
            lower[i][j] = (a[i, j] - sum(lower[i][k] * lower[j][k] for k in range(j))) / lower[j][j]
    below: list[Any] = []
    for i in range(n):
        below.append((b[i] - sum(lower[i][k] * below[k] for k in range(i))) / lower[i][i])
    found: list[Any] = [0.0] * n
    for i in reversed(range(n)):
        found[i] = (below[i] - sum(lower[k][i] * found[k] for k in range(i + 1, n))) / lower[i][i]
    return jnp.stack(found)


def _accelerate(model: Any, state: Motion, act: Float[Array, " act"]) -> Float[Array, " n"]:
    """Accelerations of the state."""
    actuator, kinematics = import_module("brax.actuator"), import_module("brax.kinematics")
    base, constraint, dynamics, mass = (
        import_module(f"brax.generalized.{name}") for name in ("base", "constraint", "dynamics", "mass")
    )
    x, xd = kinematics.forward(model, state.q, state.qd)
    there = dynamics.transform_com(model, base.State.init(state.q, state.qd, x, xd))
    there = constraint.jacobian(model, there)
    force = dynamics.forward(model, there, actuator.to_tau(model, act, state.q, state.qd))
    return solve_constraints(mass.matrix(model, there), force, there.con_jac, there.con_diag, there.con_aref)
