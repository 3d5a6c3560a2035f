"""What predictions miss: errors over lead time, and over the measured state."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from bayessim_jax.report.style import BLUE, GREY, ORANGE, draw_svg

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from matplotlib.figure import Figure

__all__ = ["residual_plot"]

BINS = 24
MOST = 6


def residual_plot(
    time: Float[np.ndarray, "windows rows"],
    y: Float[np.ndarray, "windows rows obs"],
    errors: Mapping[str, Float[np.ndarray, "windows rows obs"]],
    labels: Sequence[str],
    sigma: Float[np.ndarray, " obs"],
) -> str:
    """For every channel, by its label, the errors of all predictors over lead time, and of the last over the state."""
    shown = list(range(len(labels)))[:MOST]
    colours = [ORANGE, BLUE]

    def draw(figure: Figure) -> None:
        axes = figure.subplots(len(shown), 2, squeeze=False, sharex="col" if len(shown) == 1 else False)
        for row, k in enumerate(shown):
            left, right = axes[row]
            for (name, error), colour in zip(errors.items(), colours, strict=False):
                rms = np.sqrt(_mean_by_row(error[..., k] ** 2))
                lead = np.nanmax(time, axis=0)
                left.plot(lead[: len(rms)], rms, color=colour, linewidth=1.4, label=name)
            left.axhline(sigma[k], color=GREY, linestyle=":", linewidth=1.0)
            left.set_ylabel(labels[k])
            left.set_ylim(bottom=0)
            error = list(errors.values())[-1][..., k].ravel()
            state = y[..., k].ravel()
            seen = np.isfinite(error) & np.isfinite(state)
            error, state = error[seen], state[seen]
            thin = max(len(state) // 1500, 1)
            right.plot(state[::thin], error[::thin], ".", color=BLUE, markersize=1.5, alpha=0.35, rasterized=False)
            if len(state) > BINS:
                groups = np.array_split(np.argsort(state), BINS)
                middle = [np.median(state[g]) for g in groups]
                right.plot(middle, [np.median(error[g]) for g in groups], color=ORANGE, linewidth=1.5)
            right.axhline(0, color=GREY, linewidth=0.7)
        axes[0, 0].legend(loc="best")
        axes[-1, 0].set_xlabel("time since the prediction started [s]")
        axes[-1, 1].set_xlabel("measured value")
        axes[0, 0].set_title("root mean square error")
        axes[0, 1].set_title("error after the fit, over the state")

    return draw_svg(8.6, 0.8 + 1.7 * len(shown), draw, "residuals")


def _mean_by_row(values: np.ndarray) -> np.ndarray:
    known = np.isfinite(values)
    counts = known.sum(0)
    mean = np.where(known, values, 0.0).sum(0) / np.maximum(counts, 1)
    return np.where(counts > 0, mean, np.nan)
