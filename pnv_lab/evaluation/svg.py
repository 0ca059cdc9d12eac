"""Line charts, scatter plots and histograms as inline SVG. No scripts, no fonts, no network."""

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from math import log10

# Okabe and Ito's colours, then darker ones: told apart with any kind of colour vision.
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#555555", "#8a6d00", "#5b3a8c", "#a01c40")
_DASHES = ("", "6 3", "2 3")
WIDTH, HEIGHT = 520, 320
_LEFT, _RIGHT, _TOP, _BOTTOM = 52, 12, 14, 44


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

    def place(self, value: float, start: float, length: float) -> float:
        """Where a value lies on an axis from `start` over `length` pixels."""
        if self.log:
            share = (log10(max(value, self.low)) - log10(self.low)) / (log10(self.high) - log10(self.low))
        else:
            share = (value - self.low) / (self.high - self.low)
        return start + length * min(max(share, 0.0), 1.0)

    def ticks(self) -> list[float]:
        """Round values to mark."""
        if self.log:
            marks = [m * 10.0**e for e in range(-6, 9) for m in (1, 2, 5)]
            inside = [m for m in marks if self.low <= m <= self.high]
            return inside if len(inside) <= 8 else [m for m in inside if f"{m:e}"[0] == "1"]
        span = self.high - self.low
        step = next(s * 10.0**e for e in range(-6, 9) for s in (1, 2, 5) if span / (s * 10.0**e) <= 6)
        first = -(-self.low // step)
        return [round((first + i) * step, 10) for i in range(7) if (first + i) * step <= self.high + 1e-9]


def line_chart(series: Sequence[Series], x: Axis, y: Axis) -> str:
    """One line per series, with a legend below."""
    body = []
    for number, one in enumerate(series):
        dash = _DASHES[number // len(COLOURS) % len(_DASHES)]
        at = " ".join(f"{_x(x, a):.1f},{_y(y, b):.1f}" for a, b in one.points)
        if len(one.points) == 1:
            body.append(f'<circle cx="{at.split(",")[0]}" cy="{at.split(",")[1]}" r="4" fill="{colour(number)}"/>')
        elif at:
            body.append(
                f'<polyline points="{at}" fill="none" stroke="{colour(number)}" stroke-width="2"'
                f' stroke-dasharray="{dash}"/>'
            )
    return _figure(body, x, y, legend([s.name for s in series]))


def scatter(series: Sequence[Series], x: Axis, y: Axis, colours: Sequence[str] | None = None, radius: float = 6) -> str:
    """One mark per series point, with a legend below."""
    body = []
    fills = colours or [colour(i) for i in range(len(series))]
    for number, one in enumerate(series):
        for a, b in one.points:
            body.append(
                f'<circle cx="{_x(x, a):.1f}" cy="{_y(y, b):.1f}" r="{radius}" fill="{fills[number]}"'
                ' fill-opacity=".85">'
                f"<title>{escape(one.name)}: {a:.4g}, {b:.4g}</title></circle>"
            )
    return _figure(body, x, y, legend([s.name for s in series], fills))


def histogram(groups: Sequence[tuple[str, Sequence[int]]], x: Axis, colours: Sequence[str]) -> str:
    """Stacked bars: per group a count for each of the equal bins over the x axis."""
    bins = len(groups[0][1]) if groups else 0
    tallest = max((sum(counts[i] for _, counts in groups) for i in range(bins)), default=0) or 1
    y = Axis("queries", 0, tallest)
    width = (WIDTH - _LEFT - _RIGHT) / max(bins, 1)
    body = []
    for i in range(bins):
        below = 0
        for (_, counts), fill in zip(groups, colours, strict=True):
            top, bottom = _y(y, below + counts[i]), _y(y, below)
            if counts[i]:
                body.append(
                    f'<rect x="{_LEFT + i * width + 0.5:.1f}" y="{top:.1f}" width="{width - 1:.1f}"'
                    f' height="{bottom - top:.1f}" fill="{fill}"/>'
                )
            below += counts[i]
    return _figure(body, x, y, legend([name for name, _ in groups], colours))


def path_map(
    points: Sequence[tuple[float, float]],
    links: Sequence[tuple[int, int, str]],
    axes: tuple[str, str] = ("x", "y"),
    caption: str = "",
) -> str:
    """A path in the plane, metres to one scale on both axes, with links (from, to, colour) between its points."""
    width, height = WIDTH - _LEFT - _RIGHT, HEIGHT - _TOP - _BOTTOM
    low = [min(p[i] for p in points) for i in (0, 1)]
    high = [max(p[i] for p in points) for i in (0, 1)]
    scale = 1.1 * max((high[0] - low[0]) / width, (high[1] - low[1]) / height, 1e-6)  # metres per pixel
    spans = zip(low, high, (width, height), axes, strict=True)
    x, y = (Axis(f"{n}, m", (a + b - scale * w) / 2, (a + b + scale * w) / 2) for a, b, w, n in spans)
    at = [(_x(x, p[0]), _y(y, p[1])) for p in points]
    track = " ".join(f"{a:.1f},{b:.1f}" for a, b in at)
    body = [f'<polyline points="{track}" fill="none" stroke="#8a94a0" stroke-width="2"/>']
    for a, b, stroke in links:
        (x1, y1), (x2, y2) = at[a], at[b]
        body.append(
            f'<line x1="{x1:.1f}" y1="{y1:.1f}" x2="{x2:.1f}" y2="{y2:.1f}" stroke="{stroke}" stroke-width="1.5"/>'
            f'<circle cx="{x1:.1f}" cy="{y1:.1f}" r="3.5" fill="{stroke}"/>'
        )
    return _figure(body, x, y, caption)


def score_colour(score: float) -> str:
    """From orange (a score of 0.5 and less) over grey to blue (1)."""
    stops = ((213, 94, 0), (150, 150, 150), (0, 114, 178))
    share = min(max(2 * score - 1, 0.0), 1.0) * 2
    low, high = stops[min(int(share), 1)], stops[min(int(share), 1) + 1]
    part = share - min(int(share), 1)
    return "#" + "".join(f"{round(a + (b - a) * part):02x}" for a, b in zip(low, high, strict=True))


def legend(names: Sequence[str], colours: Sequence[str] | None = None) -> str:
    """Colour patches with names."""
    fills = colours or [colour(i) for i in range(len(names))]
    items = (f'<span><i style="background:{fill}"></i>{escape(n)}</span>' for n, fill in zip(names, fills, strict=True))
    return f'<figcaption class="legend">{"".join(items)}</figcaption>'


def colour(number: int) -> str:
    """The colour of a series by its number."""
    return COLOURS[number % len(COLOURS)]


def _x(axis: Axis, value: float) -> float:
    return axis.place(value, _LEFT, WIDTH - _LEFT - _RIGHT)


def _y(axis: Axis, value: float) -> float:
    return axis.place(value, HEIGHT - _BOTTOM, -(HEIGHT - _TOP - _BOTTOM))


def _figure(body: Sequence[str], x: Axis, y: Axis, caption: str) -> str:
    frame = []
    for tick in x.ticks():
        at = _x(x, tick)
        frame.append(f'<line class="grid" x1="{at:.1f}" y1="{_TOP}" x2="{at:.1f}" y2="{HEIGHT - _BOTTOM}"/>')
        frame.append(f'<text x="{at:.1f}" y="{HEIGHT - _BOTTOM + 16}" text-anchor="middle">{tick:g}</text>')
    for tick in y.ticks():
        at = _y(y, tick)
        frame.append(f'<line class="grid" x1="{_LEFT}" y1="{at:.1f}" x2="{WIDTH - _RIGHT}" y2="{at:.1f}"/>')
        frame.append(f'<text x="{_LEFT - 6}" y="{at + 4:.1f}" text-anchor="end">{tick:g}</text>')
    middle = (_LEFT + WIDTH - _RIGHT) / 2
    frame.append(f'<text x="{middle}" y="{HEIGHT - 8}" text-anchor="middle">{escape(x.title)}</text>')
    centre = (_TOP + HEIGHT - _BOTTOM) / 2
    frame.append(
        f'<text x="14" y="{centre}" text-anchor="middle" transform="rotate(-90 14 {centre})">{escape(y.title)}</text>'
    )
    drawing = "".join([*frame, *body])
    return f'<figure><svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img">{drawing}</svg>{caption}</figure>'
