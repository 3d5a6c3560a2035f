"""MuJoCo's constraints on single joints: dry friction and limits, soft and solved for exactly.

With x the acceleration of a joint against a reference a_ref, each is a force that is piecewise linear in x: friction
−clip(x/R, ±η), and a limit max(0, −x/R). The accelerations solve M a = τ + Σ forces, a convex problem.

Source: Todorov 2014
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from bayessim_jax.contracts import Scalar
from bayessim_jax.engines.tree.folding import Folded, fold, settle
from bayessim_jax.engines.tree.links import Numbers
from bayessim_jax.engines.tree.solve import add_to_diagonal, solve

__all__ = ["SOLVER", "Constraint", "constraint_forces", "find_constraints", "inverse_weights"]

SOLVER = "constraint_solver"
"""Name of the solver's loop among a program's operations (`jax.named_scope`)."""

SEARCHES = 3
"""Points that are tried on the way of a Newton step."""

SMALLEST = 1e-15
"""Below this MuJoCo takes nothing for a divisor."""


class Constraint(NamedTuple):
    """Friction of a joint (side 0), or its lower (+1) or upper (−1) limit, in MuJoCo's terms."""

    joint: int
    side: int
    bound: float
    margin: float
    impedance: tuple[float, float, float, float, float]
    stiffness: float
    damping: float


def find_constraints(model: mujoco.MjModel, friction: Sequence[int] = ()) -> list[Constraint]:
    """All constraints of a model of hinges and slides; `friction` names joints whose friction is a parameter."""
    flags, bit = model.opt.disableflags, mujoco.mjtDisableBit
    if flags & bit.mjDSBL_CONSTRAINT:
        return []
    found = []
    for joint in range(model.njnt if not flags & bit.mjDSBL_FRICTIONLOSS else 0):
        if model.dof_frictionloss[joint] > 0.0 or joint in friction:
            found.append(_constraint(model, joint, 0, 0.0, 0.0, model.dof_solref[joint], model.dof_solimp[joint]))
    for joint in range(model.njnt if not flags & bit.mjDSBL_LIMIT else 0):
        if model.jnt_limited[joint]:
            soft = model.jnt_solref[joint], model.jnt_solimp[joint]
            margin = float(model.jnt_margin[joint])
            found += [
                _constraint(model, joint, side, float(bound), margin, *soft)
                for side, bound in zip((1, -1), model.jnt_range[joint], strict=True)
            ]
    return found


def _constraint(
    model: mujoco.MjModel, joint: int, side: int, bound: float, margin: float, solref: np.ndarray, solimp: np.ndarray
) -> Constraint:
    low, high = (float(np.clip(x, 1e-4, 0.9999)) for x in solimp[:2])
    width, middle, power = max(0.0, solimp[2]), float(np.clip(solimp[3], 1e-4, 0.9999)), max(1.0, solimp[4])
    time, ratio = float(solref[0]), float(solref[1])
    if time > 0.0:
        if not model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_REFSAFE:
            time = max(time, 2.0 * model.opt.timestep)
        stiffness = 1.0 / max(SMALLEST, (high * time * ratio) ** 2)
        damping = 2.0 / max(SMALLEST, high * time)
    else:
        stiffness, damping = -time / max(SMALLEST, high**2), -ratio / max(SMALLEST, high)
    impedance = low, high, float(width), middle, float(power)
    return Constraint(joint, side, bound, margin, impedance, float(stiffness), float(damping))


def inverse_weights(matrix: Sequence[Sequence[Folded]]) -> list[Folded]:
    """The diagonal of M⁻¹ at the reference position, by which MuJoCo scales R."""
    size = len(matrix)
    return [solve(matrix, [fold(float(i == k)) for i in range(size)])[k] for k in range(size)]


def constraint_forces(
    constraints: Sequence[Constraint],
    numbers: Numbers,
    weights: Sequence[Folded],
    matrix: Sequence[Sequence[Folded]],
    right: Sequence[Folded],
    q: Sequence[Folded],
    v: Sequence[Folded],
) -> list[Folded]:
    """Forces of all constraints on the joints, with M a = right where there are none.

    Newton's method with a search along each step finds which piece of its force each constraint is on; then one linear
    system gives the solution, and its derivatives are those of the solution.
    """
    rows = [_settle(_row(c, numbers, weights[c.joint], q[c.joint], v[c.joint])) for c in constraints]
    problem = _Problem(constraints, rows, matrix, right)
    pieces = problem.pieces(problem.freeze().find())
    accelerations = problem.solve_pieces(pieces)
    forces = [fold(0.0)] * len(right)
    for c, (slope, offset) in zip(constraints, pieces, strict=True):
        forces[c.joint] = forces[c.joint] + offset - slope * accelerations[c.joint]
    return forces


class _Row(NamedTuple):
    """1/R, the reference acceleration of the joint itself, its friction, and whether a limit is near."""

    gain: Folded
    reference: Folded
    friction: Folded
    near: Scalar | bool


def _row(c: Constraint, numbers: Numbers, weight: Folded, q: Folded, v: Folded) -> _Row:
    if c.side == 0:
        impedance = fold(c.impedance[0] if _varies(c) else 0.5 * (c.impedance[0] + c.impedance[1]))
        friction = numbers("dof_frictionloss", c.joint)
        return _Row(impedance / (weight * (1.0 - impedance)), v * -c.damping, friction, True)
    beyond = (q - c.bound) * float(c.side) - c.margin
    impedance = _impedance(c, beyond)
    reference = v * -c.damping - impedance * beyond * (c.stiffness * c.side)
    near = beyond.value < 0.0
    return _Row(impedance / (weight * (1.0 - impedance)), reference, fold(0.0), near)


def _settle(row: _Row) -> _Row:
    gain, reference = settle(row.gain, row.reference)
    return row._replace(gain=gain, reference=reference)


def _linear(c: Constraint, row: _Row, acceleration: Folded) -> tuple[Folded, Folded]:
    """(s, o) of the piece of the force o − s a that holds at an acceleration."""
    push = (row.reference - acceleration) * row.gain
    if c.side == 0:
        sticks = jnp.abs(push.value) <= row.friction.value
        slope = jnp.where(sticks, row.gain.value, 0.0)
        slides = jnp.sign(push.value) * row.friction.value
        return Folded(slope), Folded(jnp.where(sticks, (row.gain * row.reference).value, slides))
    pushes = row.near & (push.value * c.side > 0.0)
    slope = jnp.where(pushes, row.gain.value, 0.0)
    return Folded(slope), Folded(slope) * row.reference


def _sticking(c: Constraint, row: _Row) -> tuple[Folded, Folded]:
    """Where the search begins: all friction sticks, and no limit pushes."""
    return (row.gain, row.gain * row.reference) if c.side == 0 else (fold(0.0), fold(0.0))


class _Search(NamedTuple):
    """Steps taken, where they led, and whether that is the solution."""

    count: Scalar
    here: tuple[Scalar, ...]
    found: Scalar


class _Problem(NamedTuple):
    """M a = right + f(a), whose solution is the least of a convex function with the gradient M a − right − f(a)."""

    constraints: Sequence[Constraint]
    rows: Sequence[_Row]
    matrix: Sequence[Sequence[Folded]]
    right: Sequence[Folded]

    def freeze(self) -> _Problem:
        """The same numbers without derivatives."""
        rows = [_Row(_stop(r.gain), _stop(r.reference), _stop(r.friction), r.near) for r in self.rows]
        matrix = [[_stop(x) for x in line] for line in self.matrix]
        return _Problem(self.constraints, rows, matrix, [_stop(x) for x in self.right])

    def find(self) -> list[Folded]:
        """The solution, up to rounding: found once what solves for some pieces is on these itself."""
        rounds = 2 + 2 * len({c.joint for c in self.constraints})

        def goes_on(carry: _Search) -> Scalar:
            return (carry.count < rounds) & ~carry.found

        def improve(carry: _Search) -> _Search:
            here = [fold(x) for x in carry.here]
            pieces = self.pieces(here)
            there = self.solve_pieces(pieces)
            found = _same(pieces, self.pieces(there))
            nearer = [_pick(found, a, b).value for a, b in zip(there, self.search(here, there), strict=True)]
            return _Search(carry.count + 1, tuple(nearer), found)

        start = self.solve_pieces([_sticking(c, row) for c, row in zip(self.constraints, self.rows, strict=True)])
        begun = _Search(jnp.zeros((), int), tuple(x.value for x in start), jnp.zeros((), bool))
        with jax.named_scope(SOLVER):
            found = jax.lax.while_loop(goes_on, improve, begun)
        return [fold(x) for x in found.here]

    def pieces(self, accelerations: Sequence[Folded]) -> list[tuple[Folded, Folded]]:
        """The piece of every constraint's force that holds at accelerations."""
        return [_linear(c, r, accelerations[c.joint]) for c, r in zip(self.constraints, self.rows, strict=True)]

    def solve_pieces(self, pieces: Sequence[tuple[Folded, Folded]]) -> list[Folded]:
        """The solution if these pieces of the forces held everywhere."""
        diagonal, push = [fold(0.0)] * len(self.right), list(self.right)
        for c, (slope, offset) in zip(self.constraints, pieces, strict=True):
            diagonal[c.joint] = diagonal[c.joint] + slope
            push[c.joint] = push[c.joint] + offset
        return list(settle(*solve(add_to_diagonal(self.matrix, settle(*diagonal)), settle(*push))))

    def forces(self, accelerations: Sequence[Folded]) -> list[Folded]:
        """f(a), on every joint."""
        forces = [fold(0.0)] * len(self.right)
        for c, (slope, offset) in zip(self.constraints, self.pieces(accelerations), strict=True):
            forces[c.joint] = forces[c.joint] + offset - slope * accelerations[c.joint]
        return forces

    def search(self, here: Sequence[Folded], there: Sequence[Folded]) -> list[Folded]:
        """The least on the way from here to there, to a few halvings by regula falsi; `there` if it is downhill yet."""
        ahead = [b - a for a, b in zip(here, there, strict=True)]
        slope = _inner(ahead, self._smooth_gradient(here))
        slope, curvature = settle(slope, _inner(ahead, [_inner(row, ahead) for row in self.matrix]))

        def derivative(t: Folded) -> Folded:
            forces = self.forces([a + d * t for a, d in zip(here, ahead, strict=True)])
            return settle(slope + curvature * t - _inner(ahead, forces))[0]

        low, high = fold(0.0), fold(1.0)
        at_low, at_high = derivative(low), derivative(high)
        downhill = at_high.value <= 0.0
        for _ in range(SEARCHES):
            (t,) = settle(_between(low, high, at_low, at_high))
            at = derivative(t)
            below = at.value < 0.0
            low, high = _pick(below, t, low), _pick(below, high, t)
            at_low, at_high = _pick(below, at, at_low * 0.5), _pick(below, at_high * 0.5, at)
            low, high, at_low, at_high = settle(low, high, at_low, at_high)
        (step,) = settle(_pick(downhill, fold(1.0), _between(low, high, at_low, at_high)))
        return [a + d * step for a, d in zip(here, ahead, strict=True)]

    def _smooth_gradient(self, accelerations: Sequence[Folded]) -> list[Folded]:
        return [_inner(row, accelerations) - b for row, b in zip(self.matrix, self.right, strict=True)]


def _same(a: Sequence[tuple[Folded, Folded]], b: Sequence[tuple[Folded, Folded]]) -> Scalar:
    """Whether the slopes and offsets of pieces are the same."""
    pairs = [(x.value, y.value) for one, two in zip(a, b, strict=True) for x, y in zip(one, two, strict=True)]
    return jnp.all(jnp.stack([jnp.asarray(x == y) for x, y in pairs]))


def _inner(a: Sequence[Folded], b: Sequence[Folded]) -> Folded:
    total = fold(0.0)
    for x, y in zip(a, b, strict=True):
        total = total + x * y
    return total


def _between(low: Folded, high: Folded, at_low: Folded, at_high: Folded) -> Folded:
    """Where a line through two points is zero; the upper end where rounding leaves no line."""
    rise = at_high - at_low
    share = Folded(
        jnp.where(rise.value > 0.0, (-at_low / Folded(jnp.where(rise.value > 0.0, rise.value, 1.0))).value, 1.0)
    )
    return low + (high - low) * share.clip(0.0, 1.0)


def _pick(condition: Scalar, a: Folded, b: Folded) -> Folded:
    return Folded(jnp.where(condition, a.value, b.value))


def _stop(x: Folded) -> Folded:
    return x if x.known else Folded(jax.lax.stop_gradient(x.value))


def _varies(c: Constraint) -> bool:
    low, high, width = c.impedance[:3]
    return low != high and width > SMALLEST


def _impedance(c: Constraint, beyond: Folded) -> Folded:
    """How hard a limit is where it is violated by `beyond`: from the first to the second value over a width."""
    low, high, width, middle, power = c.impedance
    if not _varies(c):
        return fold(0.5 * (low + high))
    x = jnp.clip(jnp.abs(beyond.value) / width, 0.0, 1.0)
    curve: Callable[[Scalar], Scalar] = lambda t: t * t if power == 2.0 else t**power  # noqa: E731
    rising, falling = curve(x) / math.pow(middle, power - 1.0), curve(1.0 - x) / math.pow(1.0 - middle, power - 1.0)
    y = x if power == 1.0 else jnp.where(x <= middle, rising, 1.0 - falling)
    return Folded(low + y * (high - low))
