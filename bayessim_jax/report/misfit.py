"""Where a mismatch is over windows and channels, and what each candidate gains."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from bayessim_jax.report.style import BLUE, GREY, ORANGE, draw_svg

if TYPE_CHECKING:
    from collections.abc import Collection, Sequence

    from matplotlib.figure import Figure

__all__ = ["candidates_plot", "misfit_map"]

MOST = 16


def misfit_map(
    before: Float[np.ndarray, "windows obs"],
    after: Float[np.ndarray, "windows obs"],
    recording: Sequence[str],
    channels: Sequence[str],
) -> str:
    """Excess power of every window and channel on a logarithmic scale, with recordings apart."""
    edges = [k for k in range(1, len(recording)) if recording[k] != recording[k - 1]]
    middles = _middles(recording)

    def draw(figure: Figure) -> None:
        axes = figure.subplots(2, 1, sharex=True, squeeze=False)[:, 0]
        top = np.log10(max(float(before.max()), 10.0))
        image = None
        for ax, values, title in zip(
            axes, (before, after), ("the simulator as it is", "with the best candidate"), strict=True
        ):
            shown = np.log10(np.maximum(values.T, 1.0))
            image = ax.imshow(shown, aspect="auto", cmap="magma_r", vmin=0, vmax=top, interpolation="nearest")
            ax.set_yticks(range(len(channels)), channels)
            ax.set_title(title)
            for edge in edges:
                ax.axvline(edge - 0.5, color=GREY, linewidth=0.8)
        axes[-1].set_xticks([m for m, _ in middles], [name for _, name in middles], rotation=30, ha="right")
        axes[-1].set_xlabel("windows, recording by recording")
        if image is not None:
            figure.colorbar(image, ax=list(axes), label="excess power, log₁₀")

    return draw_svg(8.6, 1.6 + 0.5 * len(channels) + 1.2, draw, "misfit")


def _middles(recording: Sequence[str]) -> list[tuple[float, str]]:
    names = list(dict.fromkeys(recording))
    return [(float(np.mean([k for k, r in enumerate(recording) if r == name])), name) for name in names]


def candidates_plot(screened: Sequence[tuple[str, float]], named: Collection[str]) -> str:
    """The gains of the best candidates, as bars; those that are named stand out."""
    shown = list(screened)[:MOST][::-1]

    def draw(figure: Figure) -> None:
        ax = figure.subplots()
        gains = [max(gain, 0.0) for _, gain in shown]
        colours = [BLUE if name in named else ORANGE for name, _ in shown]
        ax.barh(range(len(shown)), gains, color=colours, height=0.65)
        ax.set_yticks(range(len(shown)), [name for name, _ in shown])
        ax.set_xlabel("gain in log likelihood [nats]")

    return draw_svg(8.6, 0.8 + 0.24 * len(shown), draw, "candidates")
