"""Scalars whose zeros and ones are folded while tracing, and 3-vectors and matrices of them.

A model is mostly zeros and ones: a planar arm written with these scalars traces to planar equations. Compilers keep
0 · x, because x may be infinite; here it is zero.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp

__all__ = [
    "Folded",
    "Matrix",
    "Vector",
    "add",
    "cross",
    "dot",
    "fold",
    "multiply",
    "rotate",
    "rotate_back",
    "scale",
    "settle",
    "settle_vectors",
    "unknown_one",
    "vector",
]

ROUNDING = 1e-15
"""Constants this near to −1, 0 and 1 are exactly that: what rounding made of a rotation by a right angle."""


class Folded:
    """A Python float, known while tracing, or a traced scalar."""

    __slots__ = ("value",)

    def __init__(self, value: Any) -> None:
        self.value = value

    @property
    def known(self) -> bool:
        """Whether the value is a constant of the trace."""
        return isinstance(self.value, float)

    def equals(self, constant: float) -> bool:
        """Whether the value is this constant."""
        return isinstance(self.value, float) and self.value == constant

    def __add__(self, other: Folded | float) -> Folded:
        other = fold(other)
        if self.equals(0.0):
            return other
        return self if other.equals(0.0) else Folded(self.value + other.value)

    def __sub__(self, other: Folded | float) -> Folded:
        other = fold(other)
        if self.equals(0.0):
            return -other
        return self if other.equals(0.0) else Folded(self.value - other.value)

    def __mul__(self, other: Folded | float) -> Folded:
        other = fold(other)
        for one, two in ((self, other), (other, self)):
            if one.equals(0.0):
                return Folded(0.0)
            if one.equals(1.0):
                return two
            if one.equals(-1.0):
                return -two
        return Folded(self.value * other.value)

    def __truediv__(self, other: Folded | float) -> Folded:
        other = fold(other)
        return self if other.equals(1.0) or self.equals(0.0) else Folded(self.value / other.value)

    def __neg__(self) -> Folded:
        return self if self.equals(0.0) else Folded(-self.value)

    def __radd__(self, other: float) -> Folded:
        return self + other

    def __rsub__(self, other: float) -> Folded:
        return fold(other) - self

    def __rmul__(self, other: float) -> Folded:
        return self * other

    def __rtruediv__(self, other: float) -> Folded:
        return fold(other) / self

    def clip(self, low: Folded | float, high: Folded | float) -> Folded:
        """The nearest value in [low, high]; whatever is not a number stays so."""
        low, high = fold(low), fold(high)
        if self.known and low.known and high.known:
            return Folded(min(max(self.value, low.value), high.value))
        return Folded(jnp.clip(self.value, low.value, high.value))


Vector = tuple[Folded, Folded, Folded]
Matrix = tuple[Vector, Vector, Vector]


def fold(value: Any) -> Folded:
    """A number as a `Folded`; NumPy's are made Python's, whose precision does not spread."""
    if isinstance(value, Folded):
        return value
    if isinstance(value, (int, float)):
        number = float(value)
        nearest = float(round(number)) if abs(number) < 2.0 else number
        return Folded(nearest if abs(number - nearest) < ROUNDING else number)
    return Folded(value)


def vector(values: Sequence[Any]) -> Vector:
    """Three numbers."""
    x, y, z = (fold(v) for v in values)
    return x, y, z


def add(a: Vector, b: Vector) -> Vector:
    """Sum a + b."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


def scale(s: Folded | float, a: Vector) -> Vector:
    """Multiple s a."""
    return a[0] * s, a[1] * s, a[2] * s


def dot(a: Vector, b: Vector) -> Folded:
    """Inner product a · b."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a: Vector, b: Vector) -> Vector:
    """Vector product a × b."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def rotate(r: Matrix, a: Vector) -> Vector:
    """R a."""
    return dot(r[0], a), dot(r[1], a), dot(r[2], a)


def rotate_back(r: Matrix, a: Vector) -> Vector:
    """Rᵀ a."""
    return rotate(transpose(r), a)


def transpose(r: Matrix) -> Matrix:
    """Rᵀ."""
    x, y, z = zip(*r, strict=True)
    return x, y, z


def multiply(a: Matrix, b: Matrix) -> Matrix:
    """A B."""
    columns = transpose(b)
    x, y, z = ((dot(row, columns[0]), dot(row, columns[1]), dot(row, columns[2])) for row in a)
    return x, y, z


def unknown_one(value: Folded) -> Folded:
    """1 as the compiler cannot tell: 1 + 0 x, which is none where x is not finite."""
    return Folded(1.0 + 0.0 * value.value)


def settle(*values: Folded, by: Folded | None = None) -> tuple[Folded, ...]:
    """The same numbers, computed here once: a compiler may otherwise repeat them in whatever uses them.

    Barriers of the compiler's own are gone before it decides on that, where loops are made one piece of code. There a
    division holds, which it never repeats: `by` an `unknown_one`.
    """
    traced = [v.value for v in values if not v.known]
    if not traced:
        return values
    settled = iter(jax.lax.optimization_barrier(traced) if by is None else [x / by.value for x in traced])
    return tuple(v if v.known else Folded(next(settled)) for v in values)


def settle_vectors(*vectors: Vector, by: Folded | None = None) -> list[Vector]:
    """Vectors, each component settled."""
    flat = settle(*(x for v in vectors for x in v), by=by)
    return [(flat[k], flat[k + 1], flat[k + 2]) for k in range(0, len(flat), 3)]
