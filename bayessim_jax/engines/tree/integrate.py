"""One step of a tree in time, by MuJoCo's integrators."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco

from bayessim_jax.engines.tree.constraints import constraint_forces
from bayessim_jax.engines.tree.dynamics import LONG, bias_forces, mass_matrix, place_links
from bayessim_jax.engines.tree.folding import Folded, fold, settle, unknown_one
from bayessim_jax.engines.tree.forces import Forces, joint_forces
from bayessim_jax.engines.tree.prepare import Tree
from bayessim_jax.engines.tree.solve import add_to_diagonal, solve

__all__ = ["advance"]

Coordinates = list[Folded]
Rows = list[list[Folded]]

SHORT = 2
"""Trees of more links than this have their equations computed once, and not anew for every joint's acceleration."""


def advance(
    tree: Tree, q: Coordinates, v: Coordinates, ctrl: Sequence[Folded], applied: Sequence[Folded]
) -> tuple[Coordinates, Coordinates]:
    """(q, q̇) after one time step h: semi-implicit Euler with (M + h D) q̈ = τ − b, or Runge-Kutta of order 4.

    D are the dampers (Euler), and the servos' damping too (implicitfast).
    """
    h = float(tree.model.opt.timestep)
    if tree.model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4:
        return _runge_kutta(tree, q, v, ctrl, applied, h)
    matrix, right, forces = _equations(tree, q, v, ctrl, applied)
    acceleration = solve(add_to_diagonal(matrix, [d * h for d in _implicit_damping(tree.model, forces)]), right)
    v = [rate + a * h for rate, a in zip(v, acceleration, strict=True)]
    return [x + rate * h for x, rate in zip(q, v, strict=True)], v


def _equations(
    tree: Tree, q: Coordinates, v: Coordinates, ctrl: Sequence[Folded], applied: Sequence[Folded]
) -> tuple[Rows, Coordinates, Forces]:
    """M with the armatures, τ − b with the constraints' forces in τ, and the joints' forces."""
    one = unknown_one(q[0]) if len(tree.links) > LONG else None
    poses = place_links(tree.links, q, one)
    bias = bias_forces(tree.links, poses, tree.gravity, v, one)
    matrix = add_to_diagonal(mass_matrix(tree.links, poses, one), tree.armature)
    forces = joint_forces(tree.model, tree.numbers, q, v, ctrl)
    right = [f + a - b for f, a, b in zip(forces.force, applied, bias, strict=True)]
    if len(tree.links) > SHORT:
        matrix, right = _settle(matrix, right, one)
    if tree.constraints:
        held = constraint_forces(tree.constraints, tree.numbers, tree.weights, matrix, right, q, v)
        right = [f + c for f, c in zip(right, held, strict=True)]
    return matrix, right, forces


def _settle(matrix: Rows, right: Coordinates, one: Folded | None) -> tuple[Rows, Coordinates]:
    size = len(right)
    settled = iter(settle(*(matrix[i][j] for i in range(size) for j in range(i + 1)), *right, by=one))
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
    tree: Tree, q: Coordinates, v: Coordinates, ctrl: Sequence[Folded], applied: Sequence[Folded], h: float
) -> tuple[Coordinates, Coordinates]:
    slopes: list[tuple[Coordinates, Coordinates]] = []
    for reach in (0.0, 0.5 * h, 0.5 * h, h):
        at, rate = q, v
        if slopes:
            at, rate = _along(q, slopes[-1][0], reach), _along(v, slopes[-1][1], reach)
        matrix, right, _ = _equations(tree, at, rate, ctrl, applied)
        slopes.append((rate, solve(matrix, right)))
    for (rate, acceleration), weight in zip(slopes, (h / 6, h / 3, h / 3, h / 6), strict=True):
        q, v = _along(q, rate, weight), _along(v, acceleration, weight)
    return q, v


def _along(start: Coordinates, slope: Coordinates, reach: float) -> Coordinates:
    return [x + s * reach for x, s in zip(start, slope, strict=True)]
