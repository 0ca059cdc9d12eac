"""The charts of the reports: matplotlib's SVG, inside the page. No scripts, no fonts, no network."""

import io
import re
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

# Okabe and Ito's colours, then darker ones: told apart with any kind of colour vision.
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#555555", "#8a6d00", "#5b3a8c", "#a01c40")
_DASHES = ("-", "--", ":")
_INK = "#5c6673"  # stands for the ink of the page, which is another one in the dark
_GREY = "#8a94a0"
_SCORES = (0.5, 1.0)  # of the colour bar
_STYLE: dict[Any, Any] = {
    "svg.fonttype": "none",  # letters stay letters
    "svg.hashsalt": "pnv",  # the same chart is the same text
    "font.size": 10,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.alpha": 0.25,
    "axes.axisbelow": True,
} | dict.fromkeys(("text.color", "axes.labelcolor", "axes.edgecolor", "xtick.color", "ytick.color", "grid.color"), _INK)


@dataclass(frozen=True)
class Series:
    """Named points (x, y)."""

    name: str
    points: Sequence[tuple[float, float]]


@dataclass(frozen=True)
class Axis:
    """What an axis shows, its range, and whether it is logarithmic."""

    title: str
    low: float
    high: float
    log: bool = False


def line_chart(series: Sequence[Series], x: Axis, y: Axis) -> str:
    """One line per series, with a legend below."""
    with mpl.rc_context(_STYLE):
        figure, axes = _axes(x, y)
        for number, one in enumerate(series):
            dash = _DASHES[number // len(COLOURS) % len(_DASHES)]
            marker = "o" if len(one.points) == 1 else ""
            axes.plot(*_columns(one.points), dash, color=colour(number), marker=marker, clip_on=False)
        return _svg(figure, legend([s.name for s in series]))


def scatter(series: Sequence[Series], x: Axis, y: Axis, colours: Sequence[str] | None = None, radius: float = 6) -> str:
    """One mark per series point, with a legend below."""
    fills = colours or [colour(i) for i in range(len(series))]
    with mpl.rc_context(_STYLE):
        figure, axes = _axes(x, y)
        for one, fill in zip(series, fills, strict=True):
            axes.plot(*_columns(one.points), "o", color=fill, markersize=radius, markeredgewidth=0, clip_on=False)
        return _svg(figure, legend([s.name for s in series], fills))


def histogram(groups: Sequence[tuple[str, Sequence[int]]], x: Axis, colours: Sequence[str]) -> str:
    """Stacked bars: per group a count for each of the equal bins over the x axis."""
    with mpl.rc_context(_STYLE):
        figure, axes = _axes(x)
        edges = np.linspace(x.low, x.high, len(groups[0][1]) + 1)
        axes.hist(
            [edges[:-1]] * len(groups), edges.tolist(), weights=[c for _, c in groups], color=colours, stacked=True
        )
        axes.set_ylabel("queries")
        axes.yaxis.set_major_locator(MaxNLocator(integer=True))
        return _svg(figure, legend([name for name, _ in groups], colours))


def path_map(
    points: Sequence[tuple[float, float]],
    links: Sequence[tuple[int, int]],
    colours: Sequence[str] | Sequence[float],
    axes: tuple[str, str] = ("x", "y"),
    caption: str = "",
) -> str:
    """A path in the plane, metres to one scale on both axes, with links between its points.

    `colours` of the links are names, or scores in [0, 1], which a colour bar explains.
    """
    with mpl.rc_context(_STYLE):
        figure, drawn = _axes(Axis(f"{axes[0]}, m", 0, 1), Axis(f"{axes[1]}, m", 0, 1))
        at = np.array(points, float).reshape(-1, 2)
        drawn.autoscale()
        drawn.plot(*at.T, color=_GREY, linewidth=1.5)
        drawn.set_aspect("equal", adjustable="datalim")
        ends = np.array(links, int).reshape(-1, 2)
        scored = bool(len(ends)) and not isinstance(colours[0], str)
        lines: dict[str, Any] = {"colors": list(colours)}
        marks: dict[str, Any] = {"c": list(colours)}
        if scored:
            lines = {"array": np.array(colours, float), "cmap": "viridis", "clim": _SCORES}
            marks |= {"cmap": "viridis", "vmin": _SCORES[0], "vmax": _SCORES[1]}
        drawn.add_collection(LineCollection(list(at[ends]), linewidths=1.5, **lines), autolim=False)
        ends_drawn = drawn.scatter(at[ends[:, 0], 0], at[ends[:, 0], 1], s=14, linewidths=0, zorder=3, **marks)
        if scored:
            figure.colorbar(ends_drawn, label="score", extend="min")
        return _svg(figure, caption)


def legend(names: Sequence[str], colours: Sequence[str] | None = None) -> str:
    """Colour patches with names. In the page, where it breaks into lines as wide as the screen."""
    fills = colours or [colour(i) for i in range(len(names))]
    items = (f'<span><i style="background:{fill}"></i>{escape(n)}</span>' for n, fill in zip(names, fills, strict=True))
    return f'<figcaption class="legend">{"".join(items)}</figcaption>'


def colour(number: int) -> str:
    """The colour of a series by its number."""
    return COLOURS[number % len(COLOURS)]


def _axes(x: Axis, y: Axis | None = None) -> tuple[Figure, Axes]:
    figure = Figure(figsize=(4.8, 3.1), layout="constrained")
    axes = figure.add_subplot()
    axes.set(xlabel=x.title, xlim=(x.low, x.high), xscale="log" if x.log else "linear")
    if not x.log:
        axes.xaxis.set_major_locator(MaxNLocator(6))
    if y is not None:
        axes.set(ylabel=y.title, ylim=(y.low, y.high))
    return figure, axes


def _columns(points: Sequence[tuple[float, float]]) -> np.ndarray:
    return np.array(points, float).reshape(-1, 2).T


def _svg(figure: Figure, caption: str) -> str:
    text = io.StringIO()
    figure.savefig(text, format="svg", transparent=True, metadata={"Date": None, "Creator": None})
    drawing = text.getvalue()
    drawing = re.sub(r"<metadata>.*?</metadata>", "", drawing[drawing.index("<svg") :], flags=re.S)
    drawing = re.sub(r'^<svg[^>]*viewBox="([^"]*)"[^>]*>', r'<svg viewBox="\1" role="img">', drawing)
    return f"<figure>{drawing.replace(_INK, 'currentColor')}{caption}</figure>"
