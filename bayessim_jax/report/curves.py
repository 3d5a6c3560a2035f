"""Curves over rounds: return, log density of the truth, estimates."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float
from matplotlib.ticker import MaxNLocator

from bayessim_jax.report.style import BLUE, GREY, ORANGE, PURPLE, draw_svg, quantity

if TYPE_CHECKING:
    from collections.abc import Sequence

    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["cost_over_rounds", "estimates_plot", "log_density_plot", "plot_seeds", "return_plot", "set_rounds"]


def plot_seeds(
    ax: Axes, values: Float[np.ndarray, "seed round"], colour: str, label: str, linestyle: str = "-"
) -> None:
    """One line for one seed; for several their median, the band from the 10 % to the 90 % quantile, and each, thin."""
    rounds = np.arange(1, values.shape[1] + 1)
    if len(values) == 1:
        ax.plot(rounds, values[0], color=colour, label=label, linestyle=linestyle, linewidth=1.4, marker=".")
        return
    ax.plot(rounds, values.T, color=colour, linewidth=0.5, alpha=0.35, linestyle=linestyle)
    shown = np.where(np.isfinite(values), values, np.nan)
    there = np.isfinite(shown).any(0)
    low, middle, high = np.nanquantile(shown[:, there], [0.1, 0.5, 0.9], axis=0)
    ax.fill_between(rounds[there], low, high, color=colour, alpha=0.18, linewidth=0)
    ax.plot(rounds[there], middle, color=colour, linewidth=1.6, linestyle=linestyle, label=f"{label}, median of seeds")


def set_rounds(ax: Axes, rounds: int) -> None:
    """A horizontal axis that counts rounds."""
    ax.set_xlabel("round")
    ax.set_xlim(0.5, rounds + 0.5)
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))


def return_plot(target: Float[np.ndarray, "seed round"], simulated: Float[np.ndarray, "seed round"]) -> str:
    """Return on the target, and in simulation while learning."""

    def draw(figure: Figure) -> None:
        ax = figure.subplots()
        if np.isfinite(simulated).any():
            plot_seeds(ax, simulated, PURPLE, "in simulation, while learning", "--")
        if np.isfinite(target).any():
            plot_seeds(ax, target, BLUE, "on the target")
        set_rounds(ax, target.shape[1])
        ax.set_ylabel("return of an episode")
        ax.legend(loc="best")

    return draw_svg(4.8, 3.0, draw, "return")


def cost_over_rounds(cost: Float[np.ndarray, "seed round"], change: int | None) -> str:
    """Mean cost of a step on the target after each round, and when the target changed."""

    def draw(figure: Figure) -> None:
        ax = figure.subplots()
        plot_seeds(ax, cost, BLUE, "on the target")
        _mark_change(ax, change)
        set_rounds(ax, cost.shape[1])
        ax.set_ylim(bottom=0)
        ax.set_ylabel("mean cost of a step")
        ax.legend(loc="best")

    return draw_svg(4.8, 3.0, draw, "cost")


def _draw_apparent(ax: Axes, values: Float[np.ndarray, " round"] | None) -> None:
    if values is not None:
        x, style = np.arange(1, len(values) + 1), {"color": PURPLE, "linestyle": ":", "linewidth": 1.4}
        ax.step(x, values, where="mid", label="apparent, with slip", **style)


def _mark_change(ax: Axes, change: int | None) -> None:
    if change is not None:
        ax.axvline(change - 0.5, color=GREY, linestyle=":", linewidth=1.2, label="the target changes")


def log_density_plot(log_prob: Float[np.ndarray, "seed round"], log_prior: float) -> str:
    """The density log q(θ*) over rounds, in raw units of θ, beside that of the prior."""

    def draw(figure: Figure) -> None:
        ax = figure.subplots()
        plot_seeds(ax, log_prob, BLUE, "posterior")
        ax.axhline(log_prior, color=GREY, linestyle="--", linewidth=1.0, label="prior")
        set_rounds(ax, log_prob.shape[1])
        ax.set_ylabel("log q(θ*), raw units of θ")
        ax.legend(loc="best")

    return draw_svg(4.8, 3.0, draw, "log-density")


def estimates_plot(
    mean: Float[np.ndarray, "seed round d"],
    sd: Float[np.ndarray, "seed round d"],
    names: Sequence[str],
    units: Sequence[str],
    low: Float[np.ndarray, " d"],
    high: Float[np.ndarray, " d"],
    truth: Float[np.ndarray, "seed round d"] | None,
    apparent: Float[np.ndarray, "seed round d"] | None = None,
    change: int | None = None,
) -> str:
    """Posterior mean with one and two standard deviations for one seed; for several, the mean minus the truth.

    `apparent` is what the parameters of a target seem to be that the model does not know in full.
    """
    seeds, rounds, d = mean.shape
    columns = min(d, 2)
    rows = -(-d // columns)

    def one(ax: Axes, i: int) -> None:
        x = np.arange(1, rounds + 1)
        if seeds > 1 and truth is not None:
            plot_seeds(ax, mean[:, :, i] - truth[:, :, i], BLUE, "posterior mean − truth")
            ax.axhline(0.0, color=ORANGE, linewidth=1.2, label="truth")
            _draw_apparent(ax, None if apparent is None else np.median(apparent - truth, axis=0)[:, i])
            ax.set_ylabel(quantity(f"error of {names[i]}", units[i]))
        else:
            if seeds == 1:
                for k, alpha in ((2, 0.15), (1, 0.3)):
                    lower, upper = (np.clip(mean[0, :, i] + s * k * sd[0, :, i], low[i], high[i]) for s in (-1, 1))
                    label = f"± {k} standard deviation{'s' * (k > 1)}"
                    ax.fill_between(x, lower, upper, color=BLUE, alpha=alpha, linewidth=0, label=label)
            plot_seeds(ax, mean[:, :, i], BLUE, "posterior mean")
            if truth is not None:
                if np.ptp(truth[0, :, i]):
                    ax.step(x, truth[0, :, i], where="mid", color=ORANGE, linewidth=1.2, label="truth")
                else:
                    ax.axhline(truth[0, 0, i], color=ORANGE, linewidth=1.2, label="truth")
            _draw_apparent(ax, None if apparent is None else np.median(apparent, axis=0)[:, i])
            for bound, label in ((low[i], "prior's bounds"), (high[i], None)):
                ax.axhline(bound, color=GREY, linestyle="--", linewidth=0.9, label=label)
            ax.set_ylabel(quantity(names[i], units[i]))
        _mark_change(ax, change)
        set_rounds(ax, rounds)

    def draw(figure: Figure) -> None:
        axes = figure.subplots(rows, columns, squeeze=False)
        for i, ax in enumerate(axes.ravel()):
            one(ax, i) if i < d else ax.set_visible(False)
        handles, labels = axes[0, 0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper center", ncols=3)

    return draw_svg(4.2 * columns if columns > 1 else 5.6, 2.6 * rows + 0.6, draw, "estimates")
