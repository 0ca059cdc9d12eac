"""The kinds of world: what stands where. A scene is surfaces, lamps, boxes that cast shadows, and a closed route.

Metres; walls are built clockwise as seen from above when one walks inside them, counter-clockwise when around them.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from pnv_lab.worlds import textures as tx
from pnv_lab.worlds.rendering import Surface

Array = NDArray[np.float64]
Rect = tuple[float, float, float, float]  # x0, y0, x1, y1

Paint = Callable[[Generator, tx.Canvas], None]
Range = tuple[float, float]

# What hangs on a wall: painter, width and height ranges, range of the lower edge above the floor, frequency.
_Item = tuple[Paint, Range, Range, Range, float]
_INDOOR: tuple[_Item, ...] = (
    (tx.door, (0.85, 1.05), (2.0, 2.1), (0.0, 0.0), 3.0),
    (tx.poster, (0.4, 1.1), (0.5, 1.2), (0.9, 1.2), 4.0),
    (tx.notice_board, (0.9, 1.8), (0.7, 1.0), (1.0, 1.2), 1.2),
    (tx.radiator, (0.7, 1.4), (0.5, 0.6), (0.1, 0.15), 0.8),
    (tx.hydrant, (0.35, 0.45), (0.5, 0.6), (1.0, 1.2), 0.4),
    (tx.sign, (0.3, 0.7), (0.15, 0.35), (1.5, 2.0), 1.2),
    (tx.book_shelf, (0.8, 1.8), (1.7, 2.1), (0.0, 0.0), 0.7),
)
_WITH_WINDOWS: tuple[_Item, ...] = (*_INDOOR, (tx.window, (1.0, 2.0), (1.1, 1.4), (0.9, 1.0), 4.0))
_HALL: tuple[_Item, ...] = (
    (tx.poster, (1.2, 3.2), (1.2, 3.4), (1.2, 2.2), 3.0),
    (tx.door, (1.6, 2.6), (2.4, 3.2), (0.0, 0.0), 1.5),
    (tx.window, (1.5, 3.0), (1.2, 1.8), (2.6, 3.4), 2.5),
    (tx.sign, (0.6, 1.6), (0.4, 0.8), (2.0, 3.4), 1.5),
    (tx.graffiti, (1.5, 3.0), (0.8, 1.6), (0.4, 1.0), 0.8),
    (tx.notice_board, (1.2, 2.4), (0.9, 1.4), (0.9, 1.2), 0.8),
    (tx.book_shelf, (1.6, 3.2), (2.4, 3.4), (0.0, 0.0), 0.8),
)


@dataclass
class Scene:
    """What a builder collects. `route` (N, 2) are the corners of the closed walk, `height_m` the camera's."""

    route: Array = field(default_factory=lambda: np.zeros((0, 2)))
    height_m: float = 1.1
    surfaces: list[Surface] = field(default_factory=list)
    lamps: list[tuple[float, float, float]] = field(default_factory=list)
    casters: list[tuple[tuple[float, float, float], tuple[float, float, float]]] = field(default_factory=list)

    def wall(self, left: Array, right: Array, low: float, high: float, texture: tx.Canvas, **flags: bool) -> None:
        """A vertical surface between two floor points (x, y), `left` and `right` as its viewer sees them."""
        along = np.array([*(np.asarray(right) - left), 0.0])
        self.surfaces.append(Surface(np.array([*left, high]), along, np.array([0.0, 0, low - high]), texture, **flags))

    def floor(self, rect: Rect, z: float, texture: tx.Canvas, **flags: bool) -> None:
        x0, y0, x1, y1 = rect
        right, down = np.array([x1 - x0, 0.0, 0]), np.array([0.0, y0 - y1, 0])
        self.surfaces.append(Surface(np.array([x0, y1, z]), right, down, texture, **flags))

    def ceiling(self, rect: Rect, z: float, texture: tx.Canvas, **flags: bool) -> None:
        x0, y0, x1, y1 = rect
        right, down = np.array([x1 - x0, 0.0, 0]), np.array([0.0, y1 - y0, 0])
        self.surfaces.append(Surface(np.array([x0, y0, z]), right, down, texture, **flags))

    def box(self, corners: Array, low: float, high: float, sides: list[tx.Canvas], top: tx.Canvas) -> None:
        """A prism over a counter-clockwise polygon (N, 2); its lid is the bounding square, so only for boxes."""
        for k, (left, right) in enumerate(zip(corners, np.roll(corners, -1, axis=0), strict=True)):
            self.wall(left, right, low, high, sides[k % len(sides)])
        if len(corners) == 4:
            back, front = corners[3], corners[0]
            right, down = np.array([*(corners[2] - back), 0.0]), np.array([*(front - back), 0.0])
            self.surfaces.append(Surface(np.array([*back, high]), right, down, top))


def _sides(rect: Rect) -> list[tuple[Array, Array]]:
    """The four walls of a room from inside as (left, right): north, east, south, west."""
    x0, y0, x1, y1 = rect
    corners = np.array([[x0, y1], [x1, y1], [x1, y0], [x0, y0]])
    return [(corners[k], corners[(k + 1) % 4]) for k in range(4)]


def _outsides(rect: Rect) -> list[tuple[Array, Array]]:
    """The four walls of a block from outside as (left, right): south, east, north, west."""
    x0, y0, x1, y1 = rect
    corners = np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])
    return [(corners[k], corners[(k + 1) % 4]) for k in range(4)]


def _turned(centre: Array, size: tuple[float, float], angle: float) -> Array:
    """(4, 2) counter-clockwise corners of a rectangle."""
    half = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * np.array(size) / 2
    c, s = np.cos(angle), np.sin(angle)
    return np.asarray(half @ np.array([[c, s], [-s, c]]) + centre)


def _span(left: Array, right: Array) -> float:
    return float(np.linalg.norm(right - left))


def _any(rng: Generator, materials: tuple[tx.Material, ...]) -> tx.Material:
    return materials[int(rng.integers(len(materials)))]


def _grid(length: float, depth: float, cols: int, rows: int) -> Array:
    """(cols * rows, 2) evenly spread points of a room that begins at the origin."""
    x, y = (np.arange(cols) + 0.5) / cols * length, (np.arange(rows) + 0.5) / rows * depth
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


def _canvas(rng: Generator, material: tx.Material, length: float, height: float, density: float) -> tx.Canvas:
    return material(rng, max(4, int(height * density)), max(4, int(length * density)), density)


def _decorate(rng: Generator, canvas: tx.Canvas, items: tuple[_Item, ...], density: float, gap: Range) -> None:
    """Hang items along a wall from left to right, `gap` metres apart."""
    rows, cols = canvas.shape[:2]
    weights = np.array([item[4] for item in items])
    x = rng.uniform(0.2, 1.0)
    while x < cols / density:
        paint, widths, heights, lifts, _ = items[rng.choice(len(items), p=weights / weights.sum())]
        width, height, lift = rng.uniform(*widths), rng.uniform(*heights), rng.uniform(*lifts)
        left, right = int(x * density), int((x + width) * density)
        bottom = rows - int(lift * density)
        top = max(0, bottom - int(height * density))
        if right < cols - 3 and bottom - top > 8 and right - left > 8:
            paint(rng, canvas[top:bottom, left:right])
        x += width + rng.uniform(*gap)


def _painted(rng: Generator, paint: Callable[[Generator, tx.Canvas], None], width: int, height: int) -> tx.Canvas:
    canvas = np.zeros((height, width, 3), np.uint8)
    paint(rng, canvas)
    return canvas


def _hanging_sign(rng: Generator, scene: Scene, left: Array, right: Array, low: float, high: float) -> None:
    """A plate that reads rightly from either side."""
    width = int(120 * np.linalg.norm(right - left))
    for p, q in ((left, right), (right, left)):
        scene.wall(p, q, low, high, _painted(rng, tx.sign, width, max(20, int(width * (high - low)))))


def _crate(
    rng: Generator, scene: Scene, centre: Array, size: tuple[float, float], low: float, high: float, angle: float
) -> None:
    """A box, chest or cabinet."""
    density = 90
    material = _any(rng, (tx.wood, tx.plaster, tx.concrete))
    sides = []
    for k in range(4):
        side = material(rng, max(8, int((high - low) * density)), max(8, int(size[k % 2] * density)), density)
        if rng.random() < 0.6:
            h, w = side.shape[:2]
            label = side[int(0.2 * h) : int(0.7 * h), int(0.2 * w) : int(0.8 * w)]
            (tx.sign if rng.random() < 0.5 else tx.poster)(rng, label)
        side[[0, -1]], side[:, [0, -1]] = side[[0, -1]] // 2, side[:, [0, -1]] // 2
        sides.append(side)
    scene.box(_turned(centre, size, angle), low, high, sides, material(rng, 32, 32, 60))


def _plant(rng: Generator, scene: Scene, centre: Array, height: float, tree: bool) -> None:
    """Crossed cut-outs: a potted plant, or a tree."""
    texture = tx.leaves(rng, 220, 180, tree)
    width = height * 0.8
    for angle in rng.uniform(0, np.pi) + np.array([0, np.pi / 2]):
        half = np.array([np.cos(angle), np.sin(angle)]) * width / 2
        scene.wall(centre - half, centre + half, 0.0, height, texture, double_sided=True)


def _pillar(rng: Generator, scene: Scene, centre: Array, radius: float, height: float, material: tx.Material) -> None:
    """A column of eight faces, sometimes with a poster on it."""
    angles = rng.uniform(0, 0.7) + np.arange(8) * np.pi / 4
    corners = centre + radius * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    density = 64
    face = radius * 0.765
    sides = [material(rng, int(height * density), max(6, int(face * density)), density) for _ in range(8)]
    if rng.random() < 0.7:
        side = sides[int(rng.integers(8))]
        tx.poster(rng, side[int((height - 1.9) * density) : int((height - 1.1) * density), 2:-2])
    scene.box(corners, 0.0, height, sides, sides[0])


def _bench(rng: Generator, scene: Scene, centre: Array, angle: float) -> None:
    _crate(rng, scene, centre, (1.4, 0.4), 0.0, 0.45, angle)


def _clutter(rng: Generator, scene: Scene, left: Array, right: Array, depth: Range, step: Range) -> None:
    """Things that stand along a wall whose viewer has `left` and `right` there; `depth` is how far they reach out."""
    along = (right - left) / np.linalg.norm(right - left)
    out = np.array([along[1], -along[0]])
    angle = float(np.arctan2(along[1], along[0]))
    x = rng.uniform(0.8, 2.5)
    while x < np.linalg.norm(right - left) - 1.2:
        reach = rng.uniform(*depth)
        spot = left + along * x + out * (reach / 2 + 0.05)
        kind = rng.random()
        if kind < 0.25:
            _plant(rng, scene, spot + out * 0.1, rng.uniform(1.0, 1.7), tree=False)
        elif kind < 0.4:
            _bench(rng, scene, spot, angle)
        elif kind < 0.75:
            width, high = rng.uniform(0.4, 1.2), rng.uniform(0.4, 1.5)
            _crate(rng, scene, spot, (width, reach), 0.0, high, angle)
            if rng.random() < 0.5:
                top, askew = high + rng.uniform(0.2, 0.5), angle + rng.normal(0, 0.2)
                _crate(rng, scene, spot, (width * 0.7, reach * 0.7), high, top, askew)
        else:
            shelf = _painted(rng, tx.book_shelf, 120, 170)
            end = _canvas(rng, tx.wood, reach, 1.8, 60)
            scene.box(_turned(spot, (1.2, reach), angle), 0.0, 1.8, [shelf, end], tx.wood(rng, 32, 32, 60))
        x += rng.uniform(*step)


def _ceiling_lamps(rng: Generator, scene: Scene, spots: Array, z: float) -> None:
    for x, y in spots:
        scene.lamps.append((float(x), float(y), z - 0.15))
        half = 0.5 if rng.random() < 0.7 else 0.25
        scene.ceiling((x - half, y - 0.14, x + half, y + 0.14), z - 0.02, np.full((4, 8, 3), 255, np.uint8), lamp=True)


def _rounded(rect: Rect, corner: float) -> Array:
    """The eight corners of a rectangle with its corners cut, counter-clockwise."""
    x0, y0, x1, y1 = rect
    c = corner
    return np.array(
        [[x0 + c, y0], [x1 - c, y0], [x1, y0 + c], [x1, y1 - c], [x1 - c, y1], [x0 + c, y1], [x0, y1 - c], [x0, y0 + c]]
    )


def corridor(rng: Generator) -> Scene:
    """Four corridors around a block of offices; opposite ones may share their style."""
    length, depth = rng.uniform(16, 22), rng.uniform(11, 15)
    width = rng.uniform(2.2, 3.2, 4)  # south, east, north, west
    outer: Rect = (0, 0, length, depth)
    inner: Rect = (width[3], width[0], length - width[1], depth - width[2])
    height = rng.uniform(2.5, 2.9)
    scene, density = Scene(), 96.0
    styles = [(_any(rng, tx.WALLS), int(rng.integers(1 << 30))) for _ in range(3)]
    for k, (left, right) in enumerate(_sides(outer) + _outsides(inner)):
        material, style_seed = styles[int(rng.integers(len(styles)))]
        canvas = _canvas(np.random.default_rng(style_seed), material, _span(left, right), height, density)
        _decorate(rng, canvas, _WITH_WINDOWS if k < 4 and rng.random() < 0.6 else _INDOOR, density, (0.3, 1.6))
        canvas[-max(2, int(0.1 * density)) :] = tx.colour(rng, 0.4, (0.15, 0.5))
        scene.wall(left, right, 0.0, height, canvas)
    floor, pattern = _any(rng, tx.FLOORS), int(rng.integers(1 << 30))
    strips: list[Rect] = [
        (0, 0, length, inner[1]),
        (0, inner[3], length, depth),
        (0, inner[1], inner[0], inner[3]),
        (inner[2], inner[1], length, inner[3]),
    ]
    for strip in strips:
        sides = strip[2] - strip[0], strip[3] - strip[1]
        scene.floor(strip, 0.0, _canvas(np.random.default_rng(pattern), floor, *sides, 64))
        scene.ceiling(strip, height, _canvas(rng, tx.ceiling_panels, *sides, 48))
    middle: Rect = (inner[0] / 2, inner[1] / 2, (inner[2] + length) / 2, (inner[3] + depth) / 2)
    spots = [p + t * (q - p) for p, q in _sides(middle) for t in np.arange(0.08, 1, 0.2)]
    _ceiling_lamps(rng, scene, np.array(spots), height)
    for left, right in _sides(outer):
        _clutter(rng, scene, left, right, (0.25, 0.45), (1.8, 5.0))
    for left, right in _sides(middle):  # beams that cross the corridor and signs that hang in it
        along = (right - left) / np.linalg.norm(right - left)
        across = np.array([along[1], -along[0]]) * 2.0
        for t in rng.uniform(0.2, 0.8, 2):
            spot = left + t * (right - left)
            _hanging_sign(rng, scene, spot - across / 4, spot + across / 4, height - 0.42, height - 0.1)
    scene.route = _rounded(middle, 1.0)
    return scene


def office(rng: Generator) -> Scene:
    """An open-plan office: desks, screens, partitions and cabinets around which one walks."""
    length, depth, height = rng.uniform(13, 16), rng.uniform(10, 12), rng.uniform(2.7, 3.0)
    room: Rect = (0, 0, length, depth)
    scene, density = Scene(), 96.0
    for left, right in _sides(room):
        canvas = _canvas(rng, _any(rng, tx.WALLS), _span(left, right), height, density)
        _decorate(rng, canvas, _WITH_WINDOWS if rng.random() < 0.6 else _INDOOR, density, (0.2, 1.0))
        scene.wall(left, right, 0.0, height, canvas)
        _clutter(rng, scene, left, right, (0.3, 0.55), (1.4, 3.2))
    scene.floor(room, 0.0, _canvas(rng, _any(rng, tx.FLOORS), length, depth, 64))
    scene.ceiling(room, height, _canvas(rng, tx.ceiling_panels, length, depth, 40))
    _ceiling_lamps(rng, scene, _grid(length, depth, 4, 3), height)
    wood = tx.wood(rng, 90, 150, 96)
    edge = np.full((6, 12, 3), tx.colour(rng, 0.4, (0.3, 0.7)), np.uint8)
    for x in np.arange(3.6, length - 3.2, 1.75):
        for y in (depth / 2 - 0.85, depth / 2 + 0.85):
            centre = np.array([x, y]) + rng.normal(0, 0.05, 2)
            scene.box(_turned(centre, (1.5, 0.75), 0.0), 0.69, 0.73, [edge], wood)
            under = centre + np.array([rng.choice([-0.5, 0.5]), 0.0])
            _crate(rng, scene, under, (0.42, 0.6), 0.0, 0.69, 0.0)
            for _ in range(int(rng.integers(1, 3))):
                spot = centre + rng.uniform((-0.5, -0.15), (0.5, 0.15))
                half = np.array([0.27, 0.0])
                back = np.full((20, 30, 3), 40, np.uint8)
                front = _painted(rng, tx.screen, 96, 60)
                sides = (front, back) if y < depth / 2 else (back, front)
                scene.wall(spot - half, spot + half, 0.8, 1.12, sides[0])
                scene.wall(spot + half, spot - half, 0.8, 1.12, sides[1])
        partition = _canvas(rng, tx.carpet, 1.5, 1.3, 60)
        tx.poster(rng, partition[12:40, 20:48])
        half = np.array([0.75, 0.0])
        middle = np.array([x, depth / 2])
        scene.wall(middle - half, middle + half, 0.0, 1.3, partition, double_sided=True)
        if rng.random() < 0.5:
            _plant(rng, scene, np.array([x + 0.87, depth / 2]), rng.uniform(1.2, 1.9), tree=False)
    scene.route = _rounded((1.7, 1.7, length - 1.7, depth - 1.7), 1.2)
    return scene


def hall(rng: Generator) -> Scene:
    """A tall hall with pillars, stacks of crates, banners and racks."""
    length, depth, height = rng.uniform(22, 28), rng.uniform(16, 20), rng.uniform(5.0, 6.5)
    room: Rect = (0, 0, length, depth)
    scene, density = Scene(height_m=1.3), 56.0
    for left, right in _sides(room):
        canvas = _canvas(rng, _any(rng, tx.WALLS[:4]), _span(left, right), height, density)
        _decorate(rng, canvas, _HALL, density, (0.4, 2.0))
        scene.wall(left, right, 0.0, height, canvas)
        _clutter(rng, scene, left, right, (0.5, 1.1), (2.0, 5.0))
    scene.floor(room, 0.0, _canvas(rng, _any(rng, tx.FLOORS), length, depth, 48))
    scene.ceiling(room, height, _canvas(rng, tx.concrete, length, depth, 24))
    _ceiling_lamps(rng, scene, _grid(length, depth, 5, 4), height)
    material = _any(rng, tx.WALLS)
    for x in np.linspace(6.2, length - 6.2, int(rng.integers(3, 5))):
        for y in (6.0, depth - 6.0):
            _pillar(rng, scene, np.array([x, y]), rng.uniform(0.3, 0.45), height, material)
    for _ in range(int(rng.integers(5, 9))):
        centre = rng.uniform((6.0, 6.8), (length - 6.0, depth - 6.8))
        angle, low = rng.normal(0, 0.3), 0.0
        for _ in range(int(rng.integers(1, 4))):
            high = low + rng.uniform(0.5, 1.1)
            size = rng.uniform(0.9, 1.6), rng.uniform(0.8, 1.2)
            _crate(rng, scene, centre, size, low, high, angle + rng.normal(0, 0.1))
            low = high
    for x in rng.uniform(6, length - 6, 4):
        banner = _painted(rng, tx.poster, 110, 150)
        half = np.array([0.8, 0.0]) if rng.random() < 0.5 else np.array([0.0, 0.8])
        spot = np.array([x, rng.uniform(6, depth - 6)])
        scene.wall(spot - half, spot + half, height - 2.6, height - 0.4, banner, double_sided=True)
    scene.route = _rounded((3.6, 3.6, length - 3.6, depth - 3.6), 2.0)
    return scene


def street(rng: Generator) -> Scene:
    """Streets around a block of houses, with shops, parked cars, trees, lamp posts and a sky."""
    length, depth, width = rng.uniform(30, 38), rng.uniform(22, 28), rng.uniform(9, 11)
    block: Rect = (0, 0, length, depth)
    outer: Rect = (-width, -width, length + width, depth + width)
    scene, density = Scene(height_m=1.5), 32.0
    scene.casters.append(((0.5, 0.5, 0.0), (length - 0.5, depth - 0.5, 8.0)))
    for side, (left, right) in enumerate(_outsides(block) + _sides(outer)):
        span, x = _span(left, right), 0.0
        along = (right - left) / span
        out = np.array([along[1], -along[0]])
        while x < span - 0.1:
            front = float(rng.uniform(6, 12))
            if span - x - front < 5:
                front = span - x
            high = rng.uniform(6.5, 12)
            house = tx.facade(rng, int(high * density), int(front * density), density)
            p, q = left + along * x, left + along * (x + front)
            plain = _canvas(rng, tx.concrete, 6.0, high, 16)
            scene.box(np.array([p, q, q - 6 * out, p - 6 * out]), 0.0, high, [house, plain, plain, plain], plain)
            if side >= 4:
                low, top = np.minimum(p, q - 6 * out) - 0.2 * out, np.maximum(p, q - 6 * out) - 0.2 * out
                scene.casters.append(((low[0], low[1], 0.0), (top[0], top[1], high)))
            x += front
    strips: list[Rect] = [
        (outer[0], outer[1], outer[2], 0),
        (outer[0], depth, outer[2], outer[3]),
        (outer[0], 0, 0, depth),
        (length, 0, outer[2], depth),
    ]
    for strip in strips:
        scene.floor(strip, 0.0, _canvas(rng, tx.asphalt, strip[2] - strip[0], strip[3] - strip[1], 40))
    paving = int(rng.integers(1 << 30))
    for rect, builder in ((block, _outsides), (outer, _sides)):
        for left, right in builder(rect):
            along = (right - left) / np.linalg.norm(right - left)
            out = np.array([along[1], -along[0]])
            ends = [left, right, left + out * 1.6, right + out * 1.6]
            if rect is block:  # the pavement reaches around the corners
                ends += [left - along * 1.6, right + along * 1.6]
            (left_x, low_y), (right_x, high_y) = np.min(ends, axis=0), np.max(ends, axis=0)
            strip = (float(left_x), float(low_y), float(right_x), float(high_y))
            texture = _canvas(np.random.default_rng(paving), tx.tiles, strip[2] - strip[0], strip[3] - strip[1], 40)
            scene.floor(strip, 0.03, texture)
            _street_furniture(rng, scene, left, right, along, out)
    middle: Rect = (-width / 2, -width / 2, length + width / 2, depth + width / 2)
    for left, right in _sides(middle):
        along = (right - left) / np.linalg.norm(right - left)
        for t in np.arange(1.0, float(np.linalg.norm(right - left)) - 2, 3.0):
            p, q = left + along * t, left + along * (t + 1.2)
            dash = np.concatenate([np.minimum(p, q) - 0.06, np.maximum(p, q) + 0.06])
            scene.floor((dash[0], dash[1], dash[2], dash[3]), 0.02, np.full((4, 4, 3), 215, np.uint8))
    _sky(rng, scene)
    scene.route = _rounded(middle, 2.5)
    return scene


def _street_furniture(rng: Generator, scene: Scene, left: Array, right: Array, along: Array, out: Array) -> None:
    angle = float(np.arctan2(along[1], along[0]))
    x = rng.uniform(2, 5)
    while x < np.linalg.norm(right - left) - 3:
        kind = rng.random()
        if kind < 0.35:
            spot = left + along * x + out * 2.4
            side, ends = _painted(rng, tx.car_side, 200, 50), _painted(rng, tx.car_end, 90, 40)
            ends[ends[..., 0] == ends[0, 0, 0]] = side[6, 6]
            paint = side[4:8, 4:8]
            scene.box(_turned(spot, (4.0, 1.7), angle), 0.25, 0.85, [side, ends], paint)
            glass = _canvas(rng, tx.concrete, 2.0, 0.5, 30) // 2
            scene.box(_turned(spot - along * 0.1, (2.1, 1.5), angle), 0.85, 1.4, [glass], paint)
            x += 3
        elif kind < 0.6:
            spot = left + along * x + out * 1.2
            _plant(rng, scene, spot, rng.uniform(3.5, 5.5), tree=True)
        elif kind < 0.8:
            spot = left + along * x + out * 1.4
            steel = np.full((8, 4, 3), tx.colour(rng, 0.3, (0.15, 0.4)), np.uint8)
            scene.box(_turned(spot, (0.12, 0.12), angle), 0.0, 4.5, [steel], steel)
            _hanging_sign(rng, scene, spot - 0.35 * out, spot + 0.35 * out, 2.0, 2.6)
            scene.lamps.append((float(spot[0] + out[0]), float(spot[1] + out[1]), 4.4))
        else:
            spot = left + along * x + out * 1.0
            _crate(rng, scene, spot, (rng.uniform(0.5, 1.2), rng.uniform(0.4, 0.7)), 0.0, rng.uniform(0.6, 1.5), angle)
        x += rng.uniform(2.5, 6)


def _sky(rng: Generator, scene: Scene) -> None:
    """Five far faces that move with the camera, clouds on all of them."""
    far, high = 400.0, 300.0
    blue = np.array([130, 170, 225], np.float32)
    for left, right in _sides((-far, -far, far, far)):
        cloud = np.clip(tx.fractal(rng, 160, 400, 90, 6) * 0.5, 0, 1)[..., None]
        haze = np.linspace(0.0, 1.0, 160, dtype=np.float32)[:, None, None] ** 2 * 0.7
        sky = blue + (np.float32(245) - blue) * np.maximum(cloud, haze)
        along = np.array([*(right - left), 0.0])
        texture = sky.astype(np.uint8)
        scene.surfaces.append(Surface(np.array([*left, high]), along, np.array([0, 0, -high - 60]), texture, sky=True))
    cloud = np.clip(tx.fractal(rng, 200, 200, 60, 6) * 0.5, 0, 1)[..., None]
    top = (blue + (np.float32(245) - blue) * cloud).astype(np.uint8)
    right, down = np.array([2 * far, 0.0, 0]), np.array([0.0, 2 * far, 0])
    scene.surfaces.append(Surface(np.array([-far, -far, high]), right, down, top, sky=True))


KINDS: dict[str, Callable[[Generator], Scene]] = {
    "corridor": corridor,
    "office": office,
    "hall": hall,
    "street": street,
}
