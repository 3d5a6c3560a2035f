"""Sine and cosine of one angle by polynomials, which compilers turn into vector instructions."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from bayessim_jax.contracts import Scalar

__all__ = ["sincos"]

SINGLE = (
    (1.5703125, 4.837512969970703125e-4, 7.54978995489188e-8),
    (-1.6666654611e-1, 8.3321608736e-3, -1.9515295891e-4),
    (4.166664568298827e-2, -1.388731625493765e-3, 2.443315711809948e-5),
)
DOUBLE = (
    (1.57079632673412561417e00, 6.07710050630396597660e-11, 2.02226624879595063154e-21),
    (
        -1.66666666666666307295e-1,
        8.33333333332211858878e-3,
        -1.98412698295895385996e-4,
        2.75573136213857245213e-6,
        -2.50507477628578072866e-8,
        1.58962301576546568060e-10,
    ),
    (
        4.16666666666665929218e-2,
        -1.38888888888730564116e-3,
        2.48015872888517045348e-5,
        -2.75573141792967388112e-7,
        2.08757008419747316778e-9,
        -1.13585365213876817300e-11,
    ),
)
"""For each precision: π/2 in three parts, and what follows x in sin x and 1 − x²/2 in cos x, for |x| ≤ π/4."""


@jax.custom_jvp
def sincos(angle: Scalar) -> tuple[Scalar, Scalar]:
    """(sin x, cos x), right to 2 units in the last place for |x| < 10⁴ rad; the derivative is (cos x, −sin x).

    x = n π/2 + r with |r| ≤ π/4; n modulo 4 says which of the two polynomials in r² is which, and their signs.

    Source: Cody and Waite 1980
    """
    parts, sine, cosine = DOUBLE if angle.dtype == jnp.float64 else SINGLE
    turns = jnp.round(angle * (2.0 / jnp.pi))
    r = angle
    for part in parts:
        r = r - turns * part
    square = r * r
    s = r + r * square * _horner(square, sine)
    c = 1.0 - 0.5 * square + square * square * _horner(square, cosine)
    quadrant = turns.astype(jnp.int32)
    swap = (quadrant & 1) == 1
    return (
        jnp.where((quadrant & 2) == 2, -1.0, 1.0) * jnp.where(swap, c, s),
        jnp.where(((quadrant + 1) & 2) == 2, -1.0, 1.0) * jnp.where(swap, s, c),
    )


@sincos.defjvp
def _(primals: tuple[Scalar], tangents: tuple[Scalar]) -> tuple[tuple[Scalar, Scalar], tuple[Scalar, Scalar]]:
    s, c = sincos(*primals)
    return (s, c), (c * tangents[0], -s * tangents[0])


def _horner(x: Scalar, coefficients: tuple[float, ...]) -> Scalar:
    value = jnp.full_like(x, coefficients[-1])
    for coefficient in coefficients[-2::-1]:
        value = value * x + coefficient
    return value
