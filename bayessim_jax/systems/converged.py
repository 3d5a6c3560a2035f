"""A pipeline for Brax: its generalized dynamics, with the forces of contacts and stops solved to the end.

Brax's own takes four steps of a projected gradient on ½ |A f + b|²: it stops long before forces balance, and where a
foot slides the least squares are not what holds there. Here f is what the constraints' complementarity asks for,

    f ≥ 0,   A f + b ≥ 0,   fᵀ (A f + b) = 0,

with A = J M⁻¹ Jᵀ + R and b = J M⁻¹ τ − a_ref as Brax makes them, by sweeps of projected Gauss-Seidel. The mass matrix
is inverted, where Brax improves an inverse that it carries along.

Source: Todorov 2014; Freeman et al. 2021
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

__all__ = ["SWEEPS", "init", "solve_complementarity", "step"]

SWEEPS = 10
"""After these, forces on a foot with two contacts change what is seen less than the integrator does."""


def init(model: Any, q: Float[Array, " q"], qd: Float[Array, " qd"]) -> Any:
    """Brax's state with these coordinates and rates."""
    return import_module("brax.generalized.pipeline").init(_exact(model), q, qd)


def step(model: Any, state: Any, act: Float[Array, " act"]) -> Any:
    """One time step."""
    actuator, kinematics = import_module("brax.actuator"), import_module("brax.kinematics")
    constraint, dynamics, integrator, mass = (
        import_module(f"brax.generalized.{name}") for name in ("constraint", "dynamics", "integrator", "mass")
    )
    model = _exact(model)
    state = state.replace(qf_smooth=dynamics.forward(model, state, actuator.to_tau(model, act, state.q, state.qd)))
    weighed = state.con_jac @ state.mass_mx_inv
    a = weighed @ state.con_jac.T + jnp.diag(state.con_diag)
    f = solve_complementarity(a, weighed @ state.qf_smooth - state.con_aref)
    state = integrator.integrate(model, state.replace(qf_constraint=state.con_jac.T @ f))
    x, xd = kinematics.forward(model, state.q, state.qd)
    state = dynamics.transform_com(model, state.replace(x=x, xd=xd))
    return constraint.jacobian(model, mass.matrix_inv(model, state, 0))


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


def _exact(model: Any) -> Any:
    """What Brax takes for "invert the mass matrix, and integrate joint damping implicitly"."""
    return model.replace(matrix_inv_iterations=0)
