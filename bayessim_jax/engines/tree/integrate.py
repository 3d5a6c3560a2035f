"""One step of a tree in time, by MuJoCo's integrators."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco

from bayessim_jax.engines.tree.dynamics import bias_forces, mass_matrix, place_links
from bayessim_jax.engines.tree.folding import Folded, fold, settle, vector
from bayessim_jax.engines.tree.forces import Forces, joint_forces
from bayessim_jax.engines.tree.links import Link, Numbers
from bayessim_jax.engines.tree.solve import add_to_diagonal, solve

__all__ = ["advance"]

Coordinates = list[Folded]

SHORT = 2
"""Trees of more links than this have their equations computed once, and not anew for every joint's acceleration."""


def advance(
    model: mujoco.MjModel,
    numbers: Numbers,
    links: Sequence[Link],
    q: Coordinates,
    v: Coordinates,
    ctrl: Sequence[Folded],
    applied: Sequence[Folded],
) -> tuple[Coordinates, Coordinates]:
    """(q, q̇) after one time step h: semi-implicit Euler with (M + h D) q̈ = τ − b, or Runge-Kutta of order 4.

    D are the dampers (Euler), and the servos' damping too (implicitfast).
    """
    h = float(model.opt.timestep)
    if model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4:
        return _runge_kutta(model, numbers, links, q, v, ctrl, applied, h)
    matrix, right, forces = _equations(model, numbers, links, q, v, ctrl, applied)
    acceleration = solve(add_to_diagonal(matrix, [d * h for d in _implicit_damping(model, forces)]), right)
    v = [rate + a * h for rate, a in zip(v, acceleration, strict=True)]
    return [x + rate * h for x, rate in zip(q, v, strict=True)], v


def _equations(
    model: mujoco.MjModel,
    numbers: Numbers,
    links: Sequence[Link],
    q: Coordinates,
    v: Coordinates,
    ctrl: Sequence[Folded],
    applied: Sequence[Folded],
) -> tuple[list[list[Folded]], Coordinates, Forces]:
    """M with the armatures, τ − b, and the joints' forces."""
    poses = place_links(links, q)
    off = model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_GRAVITY
    gravity = vector([0.0 if off else numbers("gravity", k) for k in range(3)])
    bias = bias_forces(links, poses, gravity, v)
    armature = [numbers("dof_armature", j) for j in range(len(links))]
    matrix = add_to_diagonal(mass_matrix(links, poses), armature)
    forces = joint_forces(model, numbers, q, v, ctrl)
    right = [f + a - b for f, a, b in zip(forces.force, applied, bias, strict=True)]
    if len(links) > SHORT:
        matrix, right = _settle(matrix, right)
    return matrix, right, forces


def _settle(matrix: list[list[Folded]], right: Coordinates) -> tuple[list[list[Folded]], Coordinates]:
    size = len(right)
    (*lower,) = settle(*(matrix[i][j] for i in range(size) for j in range(i + 1)), *right)
    settled = iter(lower)
    matrix = [row[:] for row in matrix]
    for i in range(size):
        for j in range(i + 1):
            matrix[i][j] = matrix[j][i] = next(settled)
    return matrix, list(settled)


def _implicit_damping(model: mujoco.MjModel, forces: Forces) -> Coordinates:
    if model.opt.integrator == mujoco.mjtIntegrator.mjINT_IMPLICITFAST:
        return [a + b for a, b in zip(forces.damping, forces.servo_damping, strict=True)]
    if model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_EULERDAMP:
        return [fold(0.0)] * len(forces.damping)
    return forces.damping


def _runge_kutta(
    model: mujoco.MjModel,
    numbers: Numbers,
    links: Sequence[Link],
    q: Coordinates,
    v: Coordinates,
    ctrl: Sequence[Folded],
    applied: Sequence[Folded],
    h: float,
) -> tuple[Coordinates, Coordinates]:
    slopes: list[tuple[Coordinates, Coordinates]] = []
    for reach in (0.0, 0.5, 0.5, 1.0):
        at, rate = q, v
        if slopes:
            at = [x + s * (reach * h) for x, s in zip(q, slopes[-1][0], strict=True)]
            rate = [x + s * (reach * h) for x, s in zip(v, slopes[-1][1], strict=True)]
        matrix, right, _ = _equations(model, numbers, links, at, rate, ctrl, applied)
        slopes.append((rate, solve(matrix, right)))
    weights = (h / 6.0, h / 3.0, h / 3.0, h / 6.0)

    def combine(start: Coordinates, part: int) -> Coordinates:
        return [
            x
            + slopes[0][part][j] * weights[0]
            + slopes[1][part][j] * weights[1]
            + slopes[2][part][j] * weights[2]
            + slopes[3][part][j] * weights[3]
            for j, x in enumerate(start)
        ]

    return combine(q, 0), combine(v, 1)
