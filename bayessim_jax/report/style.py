"""How figures look, and how they get into a page: vector graphics whose lines and words take the page's own colour."""

from __future__ import annotations

import io
import re
from typing import TYPE_CHECKING, Any

from matplotlib import rc_context
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure

if TYPE_CHECKING:
    from collections.abc import Callable

__all__ = ["BLUE", "GREY", "ORANGE", "PURPLE", "draw_svg", "quantity"]

BLUE, ORANGE, PURPLE, GREY = "#3b78c3", "#e2711d", "#8a5bb5", "#8b929c"
"""Posterior and policy; truth; a second curve; prior and limits. They read on white and on black."""

INK = "#0a0b0c"
STYLE = {
    "font.size": 9,
    "axes.titlesize": 9,
    "axes.labelsize": 9,
    "xtick.labelsize": 8,
    "ytick.labelsize": 8,
    "legend.fontsize": 8,
    "legend.frameon": False,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.linewidth": 0.7,
    "axes.edgecolor": INK,
    "axes.labelcolor": INK,
    "text.color": INK,
    "xtick.color": INK,
    "ytick.color": INK,
    "axes.facecolor": "none",
    "figure.facecolor": "none",
    "savefig.facecolor": "none",
    "svg.fonttype": "none",
    "font.family": "DejaVu Sans",
}

PIXELS_PER_INCH = 105
"""Of the page, at most: words in figures are then a little smaller than those around them."""


def draw_svg(width: float, height: float, draw: Callable[[Figure], None], name: str) -> str:
    """An `<svg>` element of the given size in inches; `name` keeps its ids apart from those of other figures."""
    style: Any = STYLE | {"svg.hashsalt": name}
    with rc_context(style):
        figure = Figure((width, height), layout="constrained")
        draw(figure)
        buffer = io.StringIO()
        blank = {"Date": None, "Creator": None, "Format": None, "Type": None}
        FigureCanvasSVG(figure).print_svg(buffer, metadata=blank)
    svg = buffer.getvalue()
    svg = svg[svg.index("<svg") :].replace(INK, "currentColor").replace("'DejaVu Sans'", "var(--sans)")
    svg = re.sub(r'id="(?=(figure|axes|patch|line2d|text|xtick|ytick|matplotlib|legend)\.?_)', f'id="{name}-', svg)
    svg = re.sub(r' d="[^"]*"', lambda path: re.sub(r"(\.\d\d)\d+", r"\1", path[0]), svg)
    svg = re.sub(r' (width|height)="[\d.]+pt"', "", svg, count=2)
    return svg.replace("<svg", f'<svg style="max-width: {width * PIXELS_PER_INCH:.0f}px"', 1)


def quantity(name: str, unit: str) -> str:
    """The label of an axis: the quantity, and its unit in brackets where it has one.

    The parameter of an effect takes a line each for effect, place and parameter.
    """
    effect, of_an_effect, rest = name.partition("@")
    if of_an_effect:
        place, _, parameter = rest.rpartition("/")
        name = f"{effect}\n{place}\n{parameter}"
    return f"{name} [{unit}]" if unit else name
