"""Smooth densities from draws, for drawing."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

__all__ = ["credible_levels", "density1d", "density2d"]


def density1d(
    x: Float[np.ndarray, " n"], low: float, high: float, bins: int = 96
) -> tuple[Float[np.ndarray, " bins"], Float[np.ndarray, " bins"]]:
    """Grid and density of draws inside [low, high]; no mass leaks over a bound."""
    edges = _edges(x, low, high, bins)
    counts, _ = np.histogram(x, edges)
    smooth = _smooth(counts.astype(float), _bandwidth(x, edges, 1))
    return _centres(edges), smooth / max(smooth.sum() * (edges[1] - edges[0]), 1e-300)


def density2d(
    xy: Float[np.ndarray, "n 2"], low: Float[np.ndarray, " 2"], high: Float[np.ndarray, " 2"], bins: int = 64
) -> tuple[np.ndarray, np.ndarray, Float[np.ndarray, "y x"]]:
    """Grids along both axes and the density of draws on them, rows along the second axis."""
    edges = [_edges(xy[:, i], low[i], high[i], bins) for i in (0, 1)]
    counts, _, _ = np.histogram2d(xy[:, 0], xy[:, 1], edges)
    for i in (0, 1):
        width = _bandwidth(xy[:, i], edges[i], 2)
        counts = np.apply_along_axis(_smooth, i, counts, width)
    area = (edges[0][1] - edges[0][0]) * (edges[1][1] - edges[1][0])
    return _centres(edges[0]), _centres(edges[1]), counts.T / max(counts.sum() * area, 1e-300)


def credible_levels(density: np.ndarray, levels: tuple[float, ...]) -> list[float]:
    """The heights above which a gridded density holds the given shares of its mass."""
    flat = np.sort(density.ravel())[::-1]
    mass = np.cumsum(flat) / max(flat.sum(), 1e-300)
    return [float(flat[min(np.searchsorted(mass, level), flat.size - 1)]) for level in levels]


def _edges(x: np.ndarray, low: float, high: float, bins: int) -> np.ndarray:
    """A grid around the draws: a narrow posterior is resolved as well as a wide one."""
    left, right = np.quantile(x, [0.001, 0.999])
    pad = 0.25 * (right - left) + 1e-9 * (high - low)
    return np.linspace(max(low, left - pad), min(high, right + pad), bins + 1)


def _centres(edges: np.ndarray) -> np.ndarray:
    return 0.5 * (edges[1:] + edges[:-1])


def _bandwidth(x: np.ndarray, edges: np.ndarray, dimensions: int) -> float:
    """Silverman's width in bins, from the narrower of standard deviation and quartiles."""
    quartiles = np.quantile(x, [0.25, 0.75])
    spread = min(x.std(), (quartiles[1] - quartiles[0]) / 1.35) or x.std()
    return max(spread * x.size ** (-1 / (4 + dimensions)) / (edges[1] - edges[0]), 0.6)


def _smooth(counts: np.ndarray, width: float) -> np.ndarray:
    reach = min(int(4 * width) + 1, counts.size)
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / width) ** 2)
    return np.convolve(np.pad(counts, reach, mode="symmetric"), kernel / kernel.sum(), mode="valid")
