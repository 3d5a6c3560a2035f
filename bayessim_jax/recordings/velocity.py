"""Velocities out of measured positions: local quadratic fits (Savitzky and Golay) at the times as they are."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float

if TYPE_CHECKING:
    from collections.abc import Sequence

__all__ = ["choose_half_width", "estimate_slopes", "local_quadratic"]

HALF_WIDTHS = (2, 3, 4, 6, 8, 12, 16)
CHUNK = 1 << 18
GROWTH = 1.1
"""How much more variance a wider fit may leave than the narrowest, before it is taken to smooth motion away."""
LONGEST = 0.1
"""Longest half width of a fit that is more than the least, s."""
BENT, CLEAN = 20.0, 0.25
"""Times the usual variance around a fit, from which the motion bends within it, and share of that which a fit to one
side leaves where it does not bend there."""


def estimate_slopes(
    time: Float[np.ndarray, " rows"], values: Float[np.ndarray, " rows"], breaks: Bool[np.ndarray, " steps"]
) -> tuple[Float[np.ndarray, " rows"], int]:
    """dy/dt at every row from its neighbours, and how many rows to each side were used.

    A parabola is fitted to the rows around each one, at their own times and never across a break (`breaks[t]` lies
    between rows t and t + 1); its slope there is the velocity. A row alone between breaks has none: NaN. Against a
    bare difference the noise falls with the 1.5th power of the width. Where the motion bends among these rows,
    because a command jumps or something hits, those before or after the bend tell the velocity.

    Source: Savitzky and Golay 1964; Nagao and Matsuyama 1979 (the choice of a side, by what it leaves)
    """
    run = np.concatenate([[0], np.cumsum(breaks)])
    half = choose_half_width(time, values, run)
    slopes, left = _fit_all(time, values, run, half, 0)
    some = left[(left > 0.0) & np.isfinite(left)]
    bent = left > BENT * (np.median(some) if some.size else np.inf)
    if bent.any():
        least = np.where(bent, CLEAN * left, 0.0)
        for side in (-half, half):
            other, its = _fit_all(time, values, run, half, side)
            slopes, least = np.where(its < least, other, slopes), np.minimum(its, least)
    return slopes, half


def _fit_all(
    time: Float[np.ndarray, " rows"], values: Float[np.ndarray, " rows"], run: np.ndarray, half: int, shift: int
) -> tuple[Float[np.ndarray, " rows"], Float[np.ndarray, " rows"]]:
    """Slope at every row, and the variance around the fit; infinite where it passes through all of its rows."""
    slopes, left = np.empty(len(time)), np.empty(len(time))
    for start in range(0, len(time), CHUNK):
        part = slice(start, min(start + CHUNK, len(time)))
        slopes[part], squares, count = local_quadratic(time, values, run, part.start, part.stop, half, shift)
        left[part] = np.where(count > 3, squares / np.maximum(count - 3, 1), np.inf)
    return slopes, left


def choose_half_width(time: Float[np.ndarray, " rows"], values: Float[np.ndarray, " rows"], run: np.ndarray) -> int:
    """The widest fit whose residual is still that of the sensor's noise and not of the motion that it smooths away."""
    rows = len(time)
    starts: Sequence[int] = [0] if rows <= CHUNK else np.linspace(0, rows - CHUNK // 8, 8).astype(int).tolist()
    spans = [(start, min(start + (CHUNK if rows <= CHUNK else CHUNK // 8), rows)) for start in starts]
    step = float(np.median(np.diff(time[: CHUNK + 1]))) if rows > 1 else 0.0
    best, least = HALF_WIDTHS[0], None
    for half in HALF_WIDTHS:
        if half > HALF_WIDTHS[0] and half * step > LONGEST:
            break
        squares = freedom = 0.0
        for start, stop in spans:
            _, residual, count = local_quadratic(time, values, run, start, stop, half)
            full = count == 2 * half + 1
            squares += float(residual[full].sum())
            freedom += float((count[full] - 3).sum())
        if not freedom:
            break
        variance = squares / freedom
        least = variance if least is None else least
        if variance > GROWTH * least:
            break
        best = half
    return best


def local_quadratic(
    time: Float[np.ndarray, " rows"],
    values: Float[np.ndarray, " rows"],
    run: np.ndarray,
    start: int,
    stop: int,
    half: int,
    shift: int = 0,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Slope, sum of squared residuals and number of rows of the fits around rows `start` to `stop`, or beside these.

    A fit is around the row that comes so many after, `shift`, and its slope is that at the row itself. At the ends of a
    run the fit is that of the nearest row that has `half` rows to each side. Times are taken from the row itself
    and in units of the mean step, values from the row's own, so that epoch times lose no digits.
    """
    here = np.arange(start, stop)
    first, last = np.searchsorted(run, run[here], "left"), np.searchsorted(run, run[here], "right") - 1
    centre = np.where(last - first > 2 * half, np.clip(here + shift, first + half, last - half), (first + last) // 2)
    unit = max((time[stop - 1] - time[start]) / max(stop - start - 1, 1), 1e-12)
    s = np.zeros((5, stop - start))
    b = np.zeros((3, stop - start))
    squares = np.zeros(stop - start)
    for offset in range(-half, half + 1):
        other = np.clip(centre + offset, first, last)
        weight = (other == centre + offset).astype(float)
        dt = (time[other] - time[here]) / unit * weight
        dy = (values[other] - values[here]) * weight
        power = weight
        for k in range(5):
            s[k] += power
            if k < 3:
                b[k] += power * dy
            power = power * dt
        squares += dy * dy
    # Cramer's rule for [[s0 s1 s2] [s1 s2 s3] [s2 s3 s4]] (c0, c1, c2) = b
    m00, m01, m02 = s[2] * s[4] - s[3] ** 2, s[1] * s[4] - s[2] * s[3], s[1] * s[3] - s[2] ** 2
    m11, m12, m22 = s[0] * s[4] - s[2] ** 2, s[0] * s[3] - s[1] * s[2], s[0] * s[2] - s[1] ** 2
    det = s[0] * m00 - s[1] * m01 + s[2] * m02
    curved = (s[0] >= 3) & (det > 1e-9 * s[0] * s[2] * s[4])
    straight = (s[0] >= 2) & (m22 > 0)
    det = np.where(curved, det, 1.0)
    c0 = (m00 * b[0] - m01 * b[1] + m02 * b[2]) / det
    c1 = (-m01 * b[0] + m11 * b[1] - m12 * b[2]) / det
    c2 = (m02 * b[0] - m12 * b[1] + m22 * b[2]) / det
    line = (s[0] * b[1] - s[1] * b[0]) / np.where(straight, m22, 1.0)
    slope = np.where(curved, c1, np.where(straight, line, np.nan)) / unit
    residual = np.maximum(squares - c0 * b[0] - c1 * b[1] - c2 * b[2], 0.0)
    return slope, np.where(curved, residual, 0.0), s[0]
