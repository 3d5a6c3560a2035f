"""Whether the posteriors can be trusted: coverage on held-out simulations, and over seeds against the truth."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float

from bayessim_jax.report.curves import plot_seeds, set_rounds
from bayessim_jax.report.style import BLUE, GREY, ORANGE, PURPLE, draw_svg

if TYPE_CHECKING:
    from collections.abc import Sequence

    from matplotlib.figure import Figure

__all__ = ["coverage_plot", "rank_plot", "truth_coverage_plot"]


def coverage_plot(
    coverage: Float[np.ndarray, "seed round"],
    log_q_train: Float[np.ndarray, "seed round"],
    log_q_validation: Float[np.ndarray, "seed round"],
    overfit: Bool[np.ndarray, "seed round"],
    overconfident: Bool[np.ndarray, "seed round"],
) -> str:
    """Share of held-out simulations inside their 90 % credible set, and the score in training and on held-out ones."""

    def draw(figure: Figure) -> None:
        left, right = figure.subplots(1, 2)
        left.axhline(0.9, color=GREY, linestyle="--", linewidth=1.0, label="as it should be")
        plot_seeds(left, coverage, BLUE, "held-out simulations")
        _flag(left, coverage, overconfident, "over-confident")
        left.set_ylim(0, 1.03)
        left.set_ylabel("share inside the 90 % credible set")
        plot_seeds(right, log_q_train, PURPLE, "trained on", "--")
        plot_seeds(right, log_q_validation, BLUE, "held out")
        _flag(right, log_q_validation, overfit, "over-fitted")
        right.set_ylabel("mean log q(θ | recordings)")
        for ax in (left, right):
            set_rounds(ax, coverage.shape[1])
            ax.legend(loc="best")

    return draw_svg(8.4, 3.2, draw, "coverage")


def _flag(ax: object, values: np.ndarray, flags: np.ndarray, label: str) -> None:
    seeds, rounds = np.nonzero(flags)
    if seeds.size:
        ax.plot(rounds + 1, values[seeds, rounds], "x", color=ORANGE, markersize=7, markeredgewidth=2, label=label)  # pyright: ignore[reportAttributeAccessIssue]


def truth_coverage_plot(levels: Float[np.ndarray, "seed round"]) -> str:
    """Over seeds: how often the 50 % and the 90 % credible set hold the truth; the bands are two standard errors."""
    seeds, rounds = levels.shape
    x = np.arange(1, rounds + 1)

    def draw(figure: Figure) -> None:
        ax = figure.subplots()
        for level, colour in ((0.9, BLUE), (0.5, PURPLE)):
            share = (levels <= level).mean(0)
            error = 2 * np.sqrt(level * (1 - level) / seeds)
            ax.axhspan(max(level - error, 0), min(level + error, 1), color=colour, alpha=0.12, linewidth=0)
            ax.axhline(level, color=colour, linestyle="--", linewidth=0.9)
            ax.plot(x, share, color=colour, marker=".", linewidth=1.4, label=f"{level:.0%} credible set")
        set_rounds(ax, rounds)
        ax.set_ylim(0, 1.03)
        ax.set_ylabel(f"share of {seeds} seeds that hold the truth")
        ax.legend(loc="lower right")

    return draw_svg(4.8, 3.0, draw, "truth-coverage")


def rank_plot(ranks: Float[np.ndarray, "seed d"], names: Sequence[str]) -> str:
    """Simulation-based calibration over seeds: the truth's rank among the draws, uniform if calibrated.

    Source: Talts et al. 2018
    """
    seeds, d = ranks.shape
    bins = int(np.clip(seeds // 5, 4, 20))
    expected, error = seeds / bins, 2 * np.sqrt(seeds / bins * (1 - 1 / bins))

    def draw(figure: Figure) -> None:
        axes = figure.subplots(1, d, squeeze=False, sharey=True)[0]
        for i, ax in enumerate(axes):
            ax.hist(ranks[:, i], np.linspace(0, 1, bins + 1), color=BLUE, alpha=0.6)
            ax.axhspan(max(expected - error, 0), expected + error, color=GREY, alpha=0.25, linewidth=0)
            ax.axhline(expected, color=GREY, linestyle="--", linewidth=1.0)
            ax.set_xlabel(f"rank of the true {names[i]}")
        axes[0].set_ylabel("seeds")

    return draw_svg(max(2.0 * d, 4.8), 3.0, draw, "ranks")
