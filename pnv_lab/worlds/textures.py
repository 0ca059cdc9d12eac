"""Procedural textures: materials that fill a surface and decals painted on it. Colours are RGB, sizes metres unless px.

A canvas is (H, W, 3) uint8 of `density` pixels per metre; row 0 is the top edge. Every function draws from the
generator it is given and from nothing else, so a texture depends on its seed alone.
"""

from collections.abc import Callable

import cv2
import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

Canvas = NDArray[np.uint8]
Colour = tuple[int, int, int]

_FONTS = (cv2.FONT_HERSHEY_SIMPLEX, cv2.FONT_HERSHEY_DUPLEX, cv2.FONT_HERSHEY_COMPLEX, cv2.FONT_HERSHEY_TRIPLEX)
_EARTH, _PAINT = (5.0, 42.0), (20.0, 230.0)  # hues of bricks and wood, and of wall paint, in degrees
_LETTERS = list("ABCDEFGHKLMNPRSTUVXYZ0123456789")


def colour(
    rng: Generator,
    saturation: float = 0.5,
    value: tuple[float, float] = (0.3, 0.95),
    hue_deg: tuple[float, float] = (0, 360),
) -> Colour:
    """A random colour; saturation is drawn up to the given one, value and hue from their ranges."""
    hsv = np.array([[[rng.uniform(*hue_deg) / 2, 255 * saturation * rng.uniform(0.3, 1), 255 * rng.uniform(*value)]]])
    r, g, b = cv2.cvtColor(hsv.astype(np.uint8), cv2.COLOR_HSV2RGB)[0, 0]
    return int(r), int(g), int(b)


def shade(base: Colour, factor: float) -> Colour:
    r, g, b = (int(min(255, max(0, channel * factor))) for channel in base)
    return r, g, b


def fractal(rng: Generator, height: int, width: int, cell: float, octaves: int = 4) -> NDArray[np.float32]:
    """(height, width) multi-octave noise of about unit deviation; the coarsest cells are `cell` pixels wide."""
    total = np.zeros((height, width), np.float32)
    for octave in range(octaves):
        step = max(1.0, cell / 2**octave)
        grid = rng.standard_normal((int(height / step) + 2, int(width / step) + 2), dtype=np.float32)
        total += cv2.resize(grid, (width, height), interpolation=cv2.INTER_CUBIC) * 0.6**octave
    return total


def _tinted(base: Colour, relief: NDArray[np.float32]) -> Canvas:
    tinted: Canvas = np.clip(np.array(base, np.float32) * (1 + relief[..., None]), 0, 255).astype(np.uint8)
    return tinted


# Materials: (generator, height px, width px, density px/m) -> canvas


def plaster(rng: Generator, height: int, width: int, density: float) -> Canvas:
    """Painted wall with stains, often a darker dado below."""
    canvas = _tinted(colour(rng, 0.22, (0.6, 0.92), _PAINT), 0.035 * fractal(rng, height, width, density * 1.2, 6))
    if rng.random() < 0.6:
        top = height - int(density * rng.uniform(0.8, 1.2))
        if top > 0:
            dado = colour(rng, 0.45, (0.3, 0.7), _PAINT)
            canvas[top:] = _tinted(dado, 0.05 * fractal(rng, height - top, width, density, 5))
            cv2.line(canvas, (0, top), (width, top), shade(colour(rng, 0.3), 0.6), max(1, int(density * 0.04)))
    return canvas


def bricks(rng: Generator, height: int, width: int, density: float) -> Canvas:
    """Running bond with mortar; every brick has its own shade."""
    course, length = max(3, int(density * rng.uniform(0.07, 0.12))), max(6, int(density * rng.uniform(0.2, 0.32)))
    rows, cols = height // course + 1, width // length + 2
    tone = rng.normal(1, 0.13, (rows, cols)).astype(np.float32)
    y, x = np.mgrid[0:height, 0:width]
    row = y // course
    shifted = x + (row % 2) * (length // 2)
    tones = tone[row, shifted // length]
    canvas = _tinted(colour(rng, 0.6, (0.45, 0.75), _EARTH), tones - 1 + 0.05 * fractal(rng, height, width, density, 5))
    joint = max(1, int(density * 0.012))
    canvas[(y % course < joint) | (shifted % length < joint)] = shade(colour(rng, 0.1, (0.5, 0.8)), 1.0)
    return canvas


def concrete(rng: Generator, height: int, width: int, density: float) -> Canvas:
    """Grey slabs with joints, runs of dirt and a few cracks."""
    base = colour(rng, 0.08, (0.45, 0.75))
    canvas = _tinted(base, 0.08 * fractal(rng, height, width, density * 1.5, 7))
    streaks = cv2.resize(fractal(rng, max(2, height // 16), width, density * 0.5, 4), (width, height))
    canvas = np.clip(canvas * (1 - 0.05 * np.maximum(streaks, 0)[..., None]), 0, 255).astype(np.uint8)
    for x in np.arange(0, width, max(8, int(density * rng.uniform(1.2, 2.4)))):
        cv2.line(canvas, (int(x), 0), (int(x), height), shade(base, 0.6), max(1, int(density * 0.015)))
    for _ in range(int(rng.poisson(width / density / 3))):
        steps = rng.normal((0, density * 0.05), density * 0.09, (14, 2))
        path = np.cumsum(steps, axis=0) + rng.uniform((0, 0), (width, height))
        cv2.polylines(canvas, [path.astype(np.int32)], False, shade(base, 0.5), 1, cv2.LINE_AA)
    return canvas


def wood(rng: Generator, height: int, width: int, density: float) -> Canvas:
    """Vertical planks with grain."""
    plank = max(4, int(density * rng.uniform(0.12, 0.3)))
    grain = cv2.resize(fractal(rng, max(2, height // 12), width, density * 0.08, 4), (width, height))
    tone = rng.normal(0, 0.14, width // plank + 1).astype(np.float32)[np.arange(width) // plank]
    canvas = _tinted(colour(rng, 0.65, (0.35, 0.7), _EARTH), 0.08 * grain + tone[None])
    canvas[:, np.arange(width) % plank == 0] //= 2
    return canvas


def tiles(rng: Generator, height: int, width: int, density: float) -> Canvas:
    """Square tiles; some are of a second colour."""
    side = max(5, int(density * rng.choice([0.3, 0.45, 0.6])))
    rows, cols = height // side + 1, width // side + 1
    base = np.array(colour(rng, 0.2, (0.5, 0.85)), np.float32)
    other = np.array(colour(rng, 0.4, (0.3, 0.8), _PAINT), np.float32)
    diagonal = np.add.outer(np.arange(rows), np.arange(cols)) % rng.integers(2, 5) == 0
    pattern = diagonal & (rng.random((rows, cols)) < 0.8)
    palette = np.where(pattern[..., None], other, base) * rng.normal(1, 0.06, (rows, cols, 1))
    y, x = np.mgrid[0:height, 0:width]
    relief = 1 + 0.05 * fractal(rng, height, width, density * 0.8, 6)[..., None]
    canvas: Canvas = np.clip(palette[y // side, x // side] * relief, 0, 255).astype(np.uint8)
    canvas[(y % side == 0) | (x % side == 0)] //= 2
    return canvas


def carpet(rng: Generator, height: int, width: int, density: float) -> Canvas:
    """Felt with wear; sometimes broad stripes."""
    relief = 0.05 * fractal(rng, height, width, density * 2, 5)
    relief += 0.10 * rng.standard_normal((height, width), dtype=np.float32)
    if rng.random() < 0.5:
        relief += 0.18 * np.sign(np.sin(np.arange(width) * 2 * np.pi / (density * rng.uniform(0.5, 1.5))))[None]
    return _tinted(colour(rng, 0.5, (0.25, 0.6)), relief)


def asphalt(rng: Generator, height: int, width: int, density: float) -> Canvas:
    """Road surface with patches and tar seams."""
    relief = 0.10 * fractal(rng, height, width, density * 3, 6)
    canvas = _tinted(colour(rng, 0.05, (0.3, 0.45)), relief)
    for _ in range(int(width * height / density**2 / 18)):
        x, y = rng.uniform(0, width), rng.uniform(0, height)
        w, h = rng.uniform(0.3, 1.6, 2) * density
        tone = rng.uniform(0.65, 1.3)
        box = canvas[int(y) : int(y + h), int(x) : int(x + w)]
        box[:] = np.clip(box * tone, 0, 255)
    return canvas


def ceiling_panels(rng: Generator, height: int, width: int, density: float) -> Canvas:
    """Suspended ceiling of pale panels, a few of them lit."""
    side = max(6, int(density * 0.6))
    canvas = _tinted(colour(rng, 0.08, (0.75, 0.9)), 0.03 * fractal(rng, height, width, density * 0.2, 3))
    canvas[np.arange(height) % side == 0] = 130
    canvas[:, np.arange(width) % side == 0] = 130
    for row in range(0, height - side, side):
        for col in range(0, width - side, side):
            if rng.random() < 0.07:
                canvas[row + 2 : row + side - 1, col + 2 : col + side - 1] = 255
            elif rng.random() < 0.05:
                canvas[row + 2 : row + side - 1, col + 2 : col + side - 1] = rng.integers(90, 190)
    return canvas


Material = Callable[[Generator, int, int, float], Canvas]
WALLS: tuple[Material, ...] = (plaster, bricks, concrete, wood, tiles)
FLOORS: tuple[Material, ...] = (tiles, carpet, concrete)


# Decals: (generator, canvas region (h, w, 3) to paint in place)


def _text(rng: Generator, region: Canvas, ink: Colour, lines: int) -> None:
    """Text-like marks: `lines` rows of random words."""
    h, w = region.shape[:2]
    for line in range(lines):
        word = "".join(rng.choice(_LETTERS, rng.integers(3, 9)))
        font = int(rng.choice(_FONTS))
        (tw, th), _ = cv2.getTextSize(word, font, 1.0, 2)
        scale = min(0.9 * w / tw, 0.75 * h / lines / th)
        origin = (int(0.05 * w), int(h * (line + 0.85) / lines))
        cv2.putText(region, word, origin, font, scale, ink, max(1, int(scale * 1.6)), cv2.LINE_AA)


def poster(rng: Generator, region: Canvas) -> None:
    """A sheet with shapes and words."""
    h, w = region.shape[:2]
    paper = colour(rng, 0.8, (0.4, 1.0))
    region[:] = paper
    for _ in range(rng.integers(3, 9)):
        ink = colour(rng, 0.95, (0.15, 1.0))
        centre = (int(rng.uniform(0, w)), int(rng.uniform(0, 0.75 * h)))
        size = int(rng.uniform(0.1, 0.4) * min(h, w)) + 1
        shape = rng.integers(4)
        if shape == 0:
            cv2.circle(region, centre, size, ink, -1 if rng.random() < 0.7 else max(1, size // 5), cv2.LINE_AA)
        elif shape == 1:
            corner = (centre[0] + size, centre[1] + int(size * rng.uniform(0.3, 1.6)))
            cv2.rectangle(region, centre, corner, ink, -1)
        elif shape == 2:
            corners = np.array(centre) + rng.normal(0, size, (rng.integers(3, 6), 2))
            cv2.fillPoly(region, [corners.astype(np.int32)], ink, cv2.LINE_AA)
        else:
            end = (int(rng.uniform(0, w)), int(rng.uniform(0, h)))
            cv2.line(region, centre, end, ink, max(1, size // 4), cv2.LINE_AA)
    dark = shade(paper, 0.25) if sum(paper) > 330 else (245, 245, 240)
    _text(rng, region[int(0.75 * h) :], dark, int(rng.integers(1, 3)))
    cv2.rectangle(region, (0, 0), (w - 1, h - 1), colour(rng, 0.4, (0.1, 0.9)), max(1, w // 40))


def notice_board(rng: Generator, region: Canvas) -> None:
    """Cork with overlapping sheets."""
    h, w = region.shape[:2]
    region[:] = _tinted((176, 132, 84), 0.12 * fractal(rng, h, w, 4, 2))
    for _ in range(int(6 + 5 * w / h)):
        sw, sh = int(rng.uniform(0.12, 0.3) * h) + 3, int(rng.uniform(0.15, 0.4) * h) + 3
        x, y = int(rng.uniform(0.02, 0.95) * (w - sw)), int(rng.uniform(0.02, 0.95) * (h - sh))
        sheet = region[max(0, y) : y + sh, max(0, x) : x + sw]
        if sheet.size:
            sheet[:] = colour(rng, 0.6, (0.7, 1.0)) if rng.random() < 0.5 else (240, 240, 235)
            _text(rng, sheet, (40, 40, 60), int(rng.integers(2, 6)))
    cv2.rectangle(region, (0, 0), (w - 1, h - 1), (90, 60, 30), max(1, h // 25))


def door(rng: Generator, region: Canvas) -> None:
    """Frame, leaf, sometimes a pane, handle and a number plate."""
    h, w = region.shape[:2]
    frame, leaf = colour(rng, 0.3, (0.3, 0.9)), colour(rng, 0.7, (0.25, 0.85))
    region[:] = frame
    edge = max(2, w // 12)
    region[edge:, edge : w - edge] = _tinted(leaf, 0.03 * fractal(rng, h - edge, w - 2 * edge, w / 4, 4))
    if rng.random() < 0.5:
        top, bottom, left, right = int(0.12 * h), int(rng.uniform(0.3, 0.55) * h), int(0.35 * w), int(0.65 * w)
        glass = _tinted((120, 150, 165), 0.12 * fractal(rng, bottom - top, right - left, w / 2, 2))
        region[top:bottom, left:right] = glass
        corners = (left, top), (right, bottom)
        cv2.rectangle(region, *corners, shade(leaf, 0.5), edge // 3 + 1)
    else:
        for upper, lower in ((0.08, 0.45), (0.55, 0.92)):
            corners = (int(0.22 * w), int(upper * h)), (int(0.78 * w), int(lower * h))
            cv2.rectangle(region, *corners, shade(leaf, 0.7), max(1, w // 50))
    side = 0.82 if rng.random() < 0.5 else 0.18
    handle = (int(side * w), int(0.52 * h))
    cv2.circle(region, handle, max(2, w // 28), (205, 200, 185), -1, cv2.LINE_AA)
    plate = region[int(0.2 * h) : int(0.2 * h) + max(4, w // 6), int(0.14 * w) : int(0.32 * w)]
    if plate.size:
        plate[:] = 235
        _text(rng, plate, (20, 20, 20), 1)


def window(rng: Generator, region: Canvas) -> None:
    """Frame with panes onto sky and roofs, blinds on some."""
    h, w = region.shape[:2]
    sky = np.linspace(1.0, 0.75, h, dtype=np.float32)[:, None, None] * np.array([200, 220, 240], np.float32)
    region[:] = np.clip(sky * (1 + 0.06 * fractal(rng, h, w, w / 2, 4)[..., None]), 0, 255)
    left = 0
    while left < w:
        width, top = int(rng.uniform(0.1, 0.35) * w) + 1, int(rng.uniform(0.35, 0.8) * h)
        region[top:, left : left + width] = colour(rng, 0.3, (0.25, 0.6))
        left += width
    if rng.random() < 0.35:
        drop = int(rng.uniform(0.2, 0.8) * h)
        slat = max(2, h // 24)
        region[:drop][(np.arange(drop) % slat) > 0] = colour(rng, 0.2, (0.7, 0.9))
    frame = colour(rng, 0.2, (0.3, 0.95))
    bar = max(2, w // 30)
    for k in range(int(rng.integers(2, 5)) + 1):
        x = int(k * (w - 1) / max(1, k)) if k else 0
        cv2.line(region, (x, 0), (x, h), frame, bar)
    cv2.line(region, (w // 2, 0), (w // 2, h), frame, bar)
    cv2.line(region, (0, int(0.4 * h)), (w, int(0.4 * h)), frame, bar)
    cv2.rectangle(region, (0, 0), (w - 1, h - 1), frame, bar * 2)


def book_shelf(rng: Generator, region: Canvas) -> None:
    """Boards with rows of coloured spines."""
    h, w = region.shape[:2]
    region[:] = (45, 35, 28)
    rows = max(1, int(rng.integers(3, 6)))
    for row in range(rows):
        top, bottom = int(h * row / rows) + 2, int(h * (row + 1) / rows) - max(2, h // 60)
        x = 2
        while x < w - 3:
            thick = int(rng.uniform(0.015, 0.05) * w) + 1
            if rng.random() < 0.9:
                y = top + int(rng.uniform(0.05, 0.4) * (bottom - top))
                spine = colour(rng, 0.8, (0.25, 0.9))
                region[y:bottom, x : x + thick] = spine
                label = y + (bottom - y) // 4
                region[label : label + max(1, (bottom - y) // 6), x : x + thick] = shade(spine, 1.5)
            x += thick + 1
        region[bottom : bottom + max(2, h // 60)] = (150, 110, 70)
    cv2.rectangle(region, (0, 0), (w - 1, h - 1), (140, 100, 60), max(2, w // 50))


def radiator(rng: Generator, region: Canvas) -> None:
    h, w = region.shape[:2]
    fin = max(3, w // int(rng.integers(10, 24)))
    wave = 0.75 + 0.25 * np.sin(np.arange(w) * 2 * np.pi / fin)
    region[:] = np.clip(np.array(colour(rng, 0.1, (0.8, 0.95))) * wave[None, :, None], 0, 255)
    cv2.rectangle(region, (0, 0), (w - 1, h - 1), (120, 120, 120), max(1, h // 30))


def hydrant(rng: Generator, region: Canvas) -> None:
    """A red cabinet with a pale mark."""
    h, w = region.shape[:2]
    region[:] = (190, 30, 25)
    cv2.rectangle(region, (w // 8, h // 8), (w - w // 8, h - h // 8), (235, 225, 215), max(1, w // 16))
    _text(rng, region[h // 3 : 2 * h // 3, w // 6 : -w // 6], (250, 250, 250), 1)


def sign(rng: Generator, region: Canvas) -> None:
    """A plate of one colour with one word or an arrow."""
    h, w = region.shape[:2]
    plate = colour(rng, 0.95, (0.2, 0.9))
    region[:] = plate
    ink = (250, 250, 245) if sum(plate) < 380 else (15, 15, 20)
    if rng.random() < 0.4:
        ends = [(w // 8, h // 2), (w - w // 8, h // 2)]
        start, end = ends if rng.random() < 0.5 else ends[::-1]
        cv2.arrowedLine(region, start, end, ink, max(2, h // 7), cv2.LINE_AA, 0, 0.35)
    else:
        _text(rng, region[h // 6 : -h // 6 or None], ink, 1)
    cv2.rectangle(region, (0, 0), (w - 1, h - 1), ink, max(1, h // 20))


def screen(rng: Generator, region: Canvas) -> None:
    """A monitor with windows of text and pictures."""
    h, w = region.shape[:2]
    region[:] = (25, 25, 28)
    glass = region[h // 12 : -(h // 12) or None, w // 16 : -(w // 16) or None]
    glass[:] = colour(rng, 0.7, (0.2, 0.8))
    gh, gw = glass.shape[:2]
    for _ in range(3):
        x, y = int(rng.uniform(0, 0.6) * gw), int(rng.uniform(0, 0.6) * gh)
        pane = glass[y : y + gh // 2, x : x + gw // 2]
        pane[:] = colour(rng, 0.3, (0.6, 1.0))
        _text(rng, pane, (40, 45, 60), int(rng.integers(2, 5)))


def shop_front(rng: Generator, region: Canvas) -> None:
    """Awning or fascia with a name, panes with goods, a door."""
    h, w = region.shape[:2]
    paint = colour(rng, 0.9, (0.25, 0.8))
    region[:] = paint
    sill = int(0.24 * h)
    fascia = region[: int(0.18 * h)]
    fascia[:] = colour(rng, 0.9, (0.2, 0.9))
    inset = max(1, w // 10)
    _text(rng, fascia[:, inset:-inset], (250, 245, 230) if fascia[0, 0].sum() < 380 else (25, 20, 20), 1)
    if rng.random() < 0.5:
        stripe = max(4, w // int(rng.integers(8, 18)))
        awning = region[int(0.18 * h) : int(0.3 * h)]
        awning[:] = colour(rng, 0.9, (0.4, 0.9))
        awning[:, (np.arange(w) // stripe) % 2 == 0] = (240, 238, 230)
        sill = int(0.31 * h)
    entry = int(rng.uniform(0.1, 0.75) * w)
    for left, right in ((int(0.03 * w), entry), (entry + int(0.2 * w), int(0.97 * w))):
        pane = region[sill : int(0.85 * h), left:right]
        if pane.shape[1] < 6:
            continue
        pane[:] = _tinted((70, 80, 88), 0.15 * fractal(rng, pane.shape[0], pane.shape[1], w / 6, 4))
        for _ in range(max(2, pane.shape[1] * 8 // w)):
            poster_w, poster_h = int(rng.uniform(0.1, 0.4) * pane.shape[1]), int(rng.uniform(0.15, 0.5) * pane.shape[0])
            x, y = int(rng.uniform(0, 0.7) * pane.shape[1]), int(rng.uniform(0.1, 0.6) * pane.shape[0])
            if poster_w > 6 and poster_h > 6:
                poster(rng, pane[y : y + poster_h, x : x + poster_w])
    leaf = region[sill:, entry + 2 : entry + int(0.18 * w)]
    if leaf.shape[1] > 8:
        door(rng, leaf)


def graffiti(rng: Generator, region: Canvas) -> None:
    """Sprayed curves on whatever is there."""
    h, w = region.shape[:2]
    for _ in range(rng.integers(2, 6)):
        start = rng.uniform(0.2, 0.8) * w, rng.uniform(0.3, 0.7) * h
        path = (np.cumsum(rng.normal(0, 0.2 * h, (12, 2)), axis=0) + start).astype(np.int32)
        cv2.polylines(region, [path], False, colour(rng, 1.0, (0.3, 1.0)), max(2, h // 14), cv2.LINE_AA)


def car_side(rng: Generator, region: Canvas) -> None:
    h, w = region.shape[:2]
    paint = colour(rng, 0.9, (0.15, 0.9))
    region[:] = _tinted(paint, 0.04 * fractal(rng, h, w, w / 4, 3))
    for x in (0.2, 0.8):
        cv2.circle(region, (int(x * w), int(0.86 * h)), int(0.3 * h), (22, 22, 24), -1, cv2.LINE_AA)
        cv2.circle(region, (int(x * w), int(0.86 * h)), int(0.16 * h), (150, 150, 155), -1, cv2.LINE_AA)
    for x in (0.35, 0.62):
        cv2.line(region, (int(x * w), 0), (int(x * w), int(0.85 * h)), shade(paint, 0.6), max(1, w // 120))
    cv2.line(region, (0, int(0.45 * h)), (w, int(0.45 * h)), shade(paint, 0.7), max(1, h // 20))


def car_end(rng: Generator, region: Canvas) -> None:
    h, w = region.shape[:2]
    region[:] = colour(rng, 0.9, (0.15, 0.9))
    lamp = (235, 235, 220) if rng.random() < 0.5 else (190, 20, 20)
    for left in (0.06, 0.74):
        cv2.rectangle(region, (int(left * w), int(0.25 * h)), (int((left + 0.2) * w), int(0.5 * h)), lamp, -1)
    region[int(0.82 * h) :] = (40, 40, 42)
    plate = region[int(0.56 * h) : int(0.8 * h), int(0.33 * w) : int(0.67 * w)]
    plate[:] = (230, 230, 225)
    _text(rng, plate, (20, 20, 25), 1)


def leaves(rng: Generator, height: int, width: int, round_crown: bool) -> Canvas:
    """(height, width, 4) foliage on a stem with alpha: a tree (round crown) or a potted plant."""
    canvas = np.zeros((height, width, 4), np.uint8)
    stem = max(2, width // 14)
    x0 = width // 2 - stem // 2
    canvas[int(0.4 * height) :, x0 : x0 + stem] = (*colour(rng, 0.6, (0.2, 0.4)), 255)
    if not round_crown:
        pot = canvas[int(0.72 * height) :, int(0.25 * width) : int(0.75 * width)]
        pot[:] = (*colour(rng, 0.7, (0.3, 0.8)), 255)
    centre, spread = ((0.5, 0.33), (0.2, 0.13)) if round_crown else ((0.5, 0.4), (0.17, 0.16))
    green = colour(rng, 0.9, (0.3, 0.6))
    green = (min(green[0], green[1] * 7 // 8), max(green), green[2] // 3)
    for _ in range(420):
        x, y = rng.normal(centre, spread) * (width, height)
        tone = rng.uniform(0.5, 1.35)
        size = rng.uniform(0.015, 0.05, 2) * width
        axes = (int(size[0]) + 1, int(size[1]) + 1)
        cv2.ellipse(canvas, (int(x), int(y)), axes, rng.uniform(0, 180), 0, 360, (*shade(green, tone), 255), -1)
    return canvas


def facade(rng: Generator, height: int, width: int, density: float) -> Canvas:
    """A house front: material, storeys of windows, a shop or doors at street level."""
    material: Material = (plaster, bricks, concrete, bricks)[int(rng.integers(4))]
    canvas = material(rng, height, width, density)
    ground = int(3.2 * density)
    storey = int(rng.uniform(2.6, 3.4) * density)
    bay = int(rng.uniform(1.6, 3.0) * density)
    pane_w, pane_h = int(bay * rng.uniform(0.35, 0.7)), int(storey * rng.uniform(0.45, 0.65))
    prototype = np.empty((pane_h, pane_w, 3), np.uint8)
    window(rng, prototype)
    prototype = (prototype * 0.75).astype(np.uint8)
    for top in range(height - ground - storey, int(0.2 * density), -storey):
        for left in range(int(0.3 * bay), width - pane_w - 2, bay):
            y = top + int(0.2 * storey)
            pane = prototype
            if rng.random() < 0.25:
                pane = prototype.copy()
                pane[: int(rng.uniform(0.3, 1.0) * pane_h), 3:-3] = colour(rng, 0.5, (0.4, 0.9))
            canvas[y : y + pane_h, left : left + pane_w] = pane
            canvas[y + pane_h : y + pane_h + 2, max(0, left - 2) : left + pane_w + 2] = 210
        band = top + storey - 1
        if rng.random() < 0.5 and band < height:
            canvas[band : band + max(1, int(0.12 * density))] = colour(rng, 0.2, (0.5, 0.9))
    canvas[: max(2, int(0.35 * density))] = colour(rng, 0.3, (0.3, 0.8))
    left = int(rng.uniform(0.2, 1.0) * density)
    while left + int(1.2 * density) < width:
        if rng.random() < 0.6:
            length = min(int(rng.uniform(2.5, 6.0) * density), width - left - 2)
            if length > 2 * density:
                shop_front(rng, canvas[height - ground : height, left : left + length])
            left += max(length, int(density))
        else:
            door(rng, canvas[height - int(2.3 * density) : height, left : left + int(1.1 * density)])
            left += int(1.1 * density)
            if rng.random() < 0.5 and left + int(2.2 * density) < width:
                wide = int(2 * density)
                graffiti(rng, canvas[height - wide : height - wide // 4, left : left + wide])
                left += wide
        left += int(rng.uniform(0.2, 1.2) * density)
    return canvas
