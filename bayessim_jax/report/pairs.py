"""The pair plot: what a posterior says of each parameter and of each two together."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from bayessim_jax.report.density import credible_levels, density1d, density2d
from bayessim_jax.report.style import BLUE, GREY, ORANGE, draw_svg, quantity

if TYPE_CHECKING:
    from collections.abc import Sequence

    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["pair_plot"]


def pair_plot(
    draws: Float[np.ndarray, "n d"],
    names: Sequence[str],
    units: Sequence[str],
    low: Float[np.ndarray, " d"],
    high: Float[np.ndarray, " d"],
    truth: Float[np.ndarray, " d"] | None,
    name: str,
    *,
    magnify: bool = False,
) -> str:
    """Marginal densities on the diagonal, 50 %, 90 % and 99 % credible sets below it, as an `<svg>`.

    Axes span the prior, whose density is the dashed line; magnified, they span the posterior (and the truth beside
    it). The truth, where it is known, is a dashed orange line and a cross.
    """
    d = draws.shape[1]
    limits = [_around(draws[:, i], low[i], high[i], truth, i) if magnify else (low[i], high[i]) for i in range(d)]

    def diagonal(ax: Axes, i: int) -> None:
        grid, density = density1d(draws[:, i], low[i], high[i])
        ax.fill_between(grid, density, color=BLUE, alpha=0.25, linewidth=0)
        ax.plot(grid, density, color=BLUE, linewidth=1.3)
        height = 1 / (high[i] - low[i])
        ax.plot([low[i], low[i], high[i], high[i]], [0, height, height, 0], color=GREY, linewidth=1.0, linestyle="--")
        if truth is not None:
            ax.axvline(truth[i], color=ORANGE, linewidth=1.3, linestyle=(0, (5, 2)))
        ax.set_ylim(0, 1.1 * max(density.max(), height))
        ax.set_yticks([])
        ax.spines["left"].set_visible(False)

    def below(ax: Axes, i: int, j: int) -> None:
        pair = [j, i]
        x, y, density = density2d(draws[:, pair], low[pair], high[pair])
        levels = np.unique(credible_levels(density, (0.99, 0.9, 0.5)))
        if levels.size and density.max() > levels[-1]:
            top = [*levels, density.max()]
            shades = [(*_rgb(BLUE), a) for a in np.linspace(0.15, 0.6, levels.size)]
            ax.contourf(x, y, density, levels=top, colors=shades)
            ax.contour(x, y, density, levels=levels, colors=BLUE, linewidths=0.7)
        if truth is not None:
            ax.axvline(truth[j], color=ORANGE, linewidth=0.9, alpha=0.8, linestyle=(0, (5, 2)))
            ax.axhline(truth[i], color=ORANGE, linewidth=0.9, alpha=0.8, linestyle=(0, (5, 2)))
            ax.plot(truth[j], truth[i], "+", color=ORANGE, markersize=8, markeredgewidth=1.8)
        ax.set_ylim(*limits[i])

    def draw(figure: Figure) -> None:
        axes = figure.subplots(d, d, squeeze=False, sharex="col")
        for i in range(d):
            for j in range(d):
                ax = axes[i, j]
                if j > i:
                    ax.set_visible(False)
                    continue
                diagonal(ax, i) if i == j else below(ax, i, j)
                ax.set_xlim(*limits[j])
                ax.locator_params(axis="x", nbins=4)
                ax.ticklabel_format(axis="x", useOffset=False)
                ax.tick_params(axis="x", labelbottom=i == d - 1, labelrotation=30 if magnify else 0)
                if i == d - 1:
                    ax.set_xlabel(quantity(names[j], units[j]))
                if i != j:
                    ax.locator_params(axis="y", nbins=4)
                    ax.ticklabel_format(axis="y", useOffset=False)
                    ax.tick_params(axis="y", labelleft=j == 0)
                    if j == 0:
                        ax.set_ylabel(quantity(names[i], units[i]))
        figure.align_labels()

    side = 1.0 + {1: 2.6, 2: 1.6, 3: 1.45}.get(d, 1.3) * d
    return draw_svg(side, side, draw, name)


def _around(x: np.ndarray, low: float, high: float, truth: np.ndarray | None, i: int) -> tuple[float, float]:
    """The range of the draws, widened to the truth, inside the prior."""
    left, right = np.quantile(x, [0.002, 0.998])
    if truth is not None:
        left, right = min(left, truth[i]), max(right, truth[i])
    pad = 0.15 * (right - left)
    return max(low, left - pad), min(high, right + pad)


def _rgb(colour: str) -> tuple[float, float, float]:
    r, g, b = (int(colour[k : k + 2], 16) / 255 for k in (1, 3, 5))
    return r, g, b
