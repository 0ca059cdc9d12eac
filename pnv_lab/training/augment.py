"""Synthetic views of one image: another viewpoint, another light, another camera. All random draws come from `rng`.

Geometry is drawn on the coarse grid of `nodes` and interpolated, which is exact to a fraction of a pixel for the smooth
warps used here and makes the correspondence of feature cells a by-product. H x W view, h x w = H // 16 x W // 16 cells.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Pixels = NDArray[np.uint8]
Rng = np.random.Generator

_OUTSIDE = 1e4  # where a cell shows nothing of the source, far from every true coordinate
_CELL = 16  # pixels per feature cell of the trunks that are trained
_NODE = 8  # pixels per node of the warp grid


@dataclass(frozen=True, eq=False)
class View:
    """An augmented view (H, W, 3) and, per cell, where in its source it lies: (h, w, 3), in cells of a typical view."""

    pixels: Pixels
    coordinates: NDArray[np.float32]


@dataclass(frozen=True)
class SampledCamera:
    """Where a view of a panorama looks, in radians."""

    yaw: float
    pitch: float
    roll: float
    field_of_view: float


def flat_view(
    source: Pixels, size: tuple[int, int], strength: float, mirror: bool, rng: Rng, advance: float = 1.0
) -> View:
    """A view of a photograph: homography, crop and a smooth parallax-like displacement; `strength` 0 shows it as it is.

    `size` is (width, height) of the view; `advance` magnifies, as going forward does.
    """
    width, height = size
    unit = _node_grid(width, height)  # (n, m, 2) in [-0.5, 0.5]
    points = unit.reshape(-1, 2)
    zoom = np.exp(rng.uniform(-0.25, 0.08) * strength) / advance  # < 1 looks at less of the source
    stretch = np.exp(rng.normal(0, 0.08) * strength)
    angle = np.deg2rad(rng.normal(0, 6) * strength)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    aspect = np.array([width / height, 1.0])
    points = (points * aspect) @ turn.T / aspect * zoom * np.array([stretch, 1 / stretch])
    tilt = rng.normal(0, 0.22, 2) * strength
    points = points / (1 + points @ tilt)[:, None]
    slack = 0.16 * zoom * strength
    points = points + rng.uniform(-slack, slack, 2) * np.array([1.0, 0.7])
    points = points.reshape(unit.shape) + _parallax(unit.shape[:2], 0.02 * strength, rng)
    if mirror:
        points = points * np.array([-1.0, 1.0])
    rows, cols = source.shape[:2]
    x, y = (points[..., 0] + 0.5) * cols - 0.5, (points[..., 1] + 0.5) * rows - 0.5
    pixels = _sample(source, x, y, size, cv2.BORDER_REFLECT_101)
    inside = (np.abs(points) < 0.5).all(-1)
    place = np.dstack([points[..., 0] * 20, points[..., 1] * 20 * rows / cols, np.zeros_like(x)])
    place[~inside] = _OUTSIDE
    return View(pixels, _cell_values(place, size))


def panorama_view(
    source: Pixels, size: tuple[int, int], camera: SampledCamera, strength: float, mirror: bool, rng: Rng
) -> View:
    """A perspective view of an equirectangular panorama, with the same parallax-like displacement."""
    width, height = size
    unit = _node_grid(width, height) + _parallax(_nodes(width, height), 0.013 * strength, rng)
    reach = np.tan(camera.field_of_view / 2)
    x, y = unit[..., 0] * 2 * reach, unit[..., 1] * 2 * reach * height / width
    if mirror:
        x = -x
    c, s = np.cos(camera.roll), np.sin(camera.roll)
    rays = np.dstack([c * x - s * y, s * x + c * y, np.ones_like(x)])
    rays /= np.linalg.norm(rays, axis=2, keepdims=True)
    c, s = np.cos(camera.pitch), np.sin(camera.pitch)
    rays = np.dstack([rays[..., 0], c * rays[..., 1] + s * rays[..., 2], -s * rays[..., 1] + c * rays[..., 2]])
    c, s = np.cos(camera.yaw), np.sin(camera.yaw)
    rays = np.dstack([c * rays[..., 0] + s * rays[..., 2], rays[..., 1], -s * rays[..., 0] + c * rays[..., 2]])
    rows, cols = source.shape[:2]
    longitude = np.unwrap(np.arctan2(rays[..., 0], rays[..., 2]), axis=1)
    longitude += 2 * np.pi * np.round((longitude[:, :1].mean() - longitude[:, :1]) / (2 * np.pi))
    u = (longitude / (2 * np.pi) + 0.5) * cols
    v = (np.arcsin(np.clip(rays[..., 1], -1, 1)) / np.pi + 0.5) * rows
    pixels = _sample(source, u - 0.5, v - 0.5, size, cv2.BORDER_WRAP)
    return View(pixels, _cell_values(rays * 12.0, size))


def relight(pixels: Pixels, strength: float, rng: Rng, occluder: Pixels | None = None) -> Pixels:
    """Another light, sensor and weather: (H, W, 3) -> (H, W, 3). `occluder` lends its texture to things in the way."""
    image = pixels
    if occluder is not None and rng.random() < 0.25 * strength:
        image = _occluded(image, occluder, rng)
    image = _night(image, rng) if rng.random() < 0.3 * strength else _tone(image, strength, rng)
    if rng.random() < 0.08 * strength:
        veil = np.full_like(image, int(rng.integers(120, 240)))
        share = rng.uniform(0.2, 0.6)
        image = cv2.addWeighted(image, 1 - share, veil, share, 0)
    if rng.random() < 0.06 * strength:
        image = _banded(image, rng)
    if rng.random() < 0.2 * strength:
        sigma = rng.uniform(0.5, 2.0)
        image = cv2.GaussianBlur(image, (0, 0), sigma)
    elif rng.random() < 0.2 * strength:
        image = _motion_blur(image, rng)
    if rng.random() < 0.15 * strength:
        image = small_picture(image, int(rng.integers(72, 180)))
    if rng.random() < 0.35 * strength:
        image = _noisy(image, rng.uniform(3, 16), rng)
    if rng.random() < 0.25 * strength:
        _, coded = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(15, 60))])
        image = np.asarray(cv2.imdecode(coded, cv2.IMREAD_COLOR), np.uint8)
    if rng.random() < 0.2 * strength:
        image = cv2.cvtColor(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), cv2.COLOR_GRAY2RGB)
    return np.ascontiguousarray(image)


def _nodes(width: int, height: int) -> tuple[int, int]:
    return height // _NODE + 1, width // _NODE + 1


def _node_grid(width: int, height: int) -> NDArray[np.float64]:
    """(n, m, 2) positions (x, y) in [-0.5, 0.5] of nodes that span the view from edge to edge."""
    n, m = _nodes(width, height)
    x, y = np.meshgrid(np.linspace(-0.5, 0.5, m), np.linspace(-0.5, 0.5, n))
    return np.dstack([x, y])


def _parallax(shape: tuple[int, int], size: float, rng: Rng) -> NDArray[np.float64]:
    """A smooth random displacement field (n, m, 2), as a change of viewpoint gives surfaces at several depths."""
    coarse = rng.normal(0, size, (4, 5, 2)).astype(np.float32)
    return cv2.resize(coarse, (shape[1], shape[0]), interpolation=cv2.INTER_CUBIC).astype(np.float64)


def _dense(nodes: NDArray[np.floating], size: tuple[int, int]) -> NDArray[np.float32]:
    """Node values (n, m) -> pixel values (H, W): bilinear between nodes that lie on the view's edges."""
    width, height = size
    n, m = nodes.shape[:2]
    matrix = np.array(
        [[(m - 1) / width, 0, 0.5 * (m - 1) / width], [0, (n - 1) / height, 0.5 * (n - 1) / height]], np.float32
    )
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return cv2.warpAffine(nodes.astype(np.float32), matrix, size, flags=flags, borderMode=cv2.BORDER_REPLICATE)


def _sample(
    source: Pixels, x: NDArray[np.floating], y: NDArray[np.floating], size: tuple[int, int], border: int
) -> Pixels:
    return cv2.remap(source, _dense(x, size), _dense(y, size), cv2.INTER_LINEAR, borderMode=border)


def _cell_values(nodes: NDArray[np.floating], size: tuple[int, int]) -> NDArray[np.float32]:
    """Node values (n, m, 3) at the cell centres, which are every other node: (h, w, 3)."""
    step = _CELL // _NODE
    return nodes[1::step, 1::step][: size[1] // _CELL, : size[0] // _CELL].astype(np.float32)


def _curve(image: Pixels, curves: NDArray[np.floating]) -> Pixels:
    """Per-channel tone curves (3, 256)."""
    table = np.clip(curves, 0, 255).astype(np.uint8).T.reshape(1, 256, 3)
    return cv2.LUT(image, np.ascontiguousarray(table))


def _light_field(image: Pixels, spread: float, rng: Rng) -> Pixels:
    """Multiply by a smooth random brightness."""
    coarse = np.exp(rng.normal(0, spread, (3, 4))).astype(np.float32)
    field = cv2.resize(coarse, (image.shape[1], image.shape[0]), interpolation=cv2.INTER_CUBIC)
    return cv2.multiply(image, cv2.merge([field] * 3), dtype=cv2.CV_8U)


def _tone(image: Pixels, strength: float, rng: Rng) -> Pixels:
    level = np.linspace(0, 1, 256)
    gamma = np.exp(rng.normal(0, 0.35) * strength)
    cast = np.exp(rng.normal(0, 0.12, (3, 1)) * strength)
    gain = np.exp(rng.normal(-0.05, 0.2) * strength)
    lift = rng.normal(0, 0.05) * strength
    image = _curve(image, 255 * (lift + gain * cast * level**gamma))
    return _light_field(image, 0.35, rng) if rng.random() < 0.4 * strength else image


def _night(image: Pixels, rng: Rng) -> Pixels:
    """Dusk or night: dark and noisy, a cast, a sky that may turn dark, lamps that light their surroundings."""
    level = np.linspace(0, 1, 256)
    curve = level ** np.exp(rng.uniform(0.0, 1.0))
    if rng.random() < 0.5:  # the sky, brightest by day, is dark: the top of the tone scale folds down
        knee = rng.uniform(0.5, 0.8)
        depth = rng.uniform(0.5, 1.0)
        curve = np.where(level > knee, curve * (1 - depth * (level - knee) / (1 - knee)), curve)
    cast = np.exp(rng.normal(0, 0.3, (3, 1)))
    dark = _curve(image, 255 * rng.uniform(0.15, 0.6) * cast * curve)
    height, width = image.shape[:2]
    y, x = np.mgrid[0 : height // 8, 0 : width // 8].astype(np.float32) * 8
    glow = np.zeros_like(x)
    lamps = np.zeros_like(x)
    for _ in range(int(rng.integers(0, 6))):
        distance = np.hypot(x - rng.uniform(0, width), y - rng.uniform(0, height)) / width
        glow += rng.uniform(0.5, 3.0) * np.exp(-((distance / rng.uniform(0.08, 0.3)) ** 2))
        lamps += rng.uniform(60, 255) * np.exp(-((distance / rng.uniform(0.01, 0.05)) ** 2))
    warm = np.array([1.0, rng.uniform(0.6, 1.0), rng.uniform(0.3, 1.0)], np.float32)
    field = cv2.resize(np.dstack([1 + glow * w for w in warm]), (width, height))
    lit = cv2.multiply(dark, field, dtype=cv2.CV_8U)
    added = cv2.resize(np.dstack([lamps * w for w in warm]).clip(0, 255).astype(np.uint8), (width, height))
    return _noisy(cv2.add(lit, added), rng.uniform(1, 12), rng)


def _noisy(image: Pixels, spread: float, rng: Rng) -> Pixels:
    """With Gaussian noise of standard deviation `spread`. OpenCV's generator is the thread's own, seeded from `rng`."""
    cv2.setRNGSeed(int(rng.integers(2**31)))
    noise = np.empty(image.shape, np.int16)
    cv2.randn(noise, 0, float(spread))
    return cv2.add(image, noise, dtype=cv2.CV_8U)


def _banded(image: Pixels, rng: Rng) -> Pixels:
    """Rolling exposure under flickering light."""
    rows = np.arange(image.shape[0], dtype=np.float32)
    phase = 2 * np.pi * (rows / image.shape[0] * rng.uniform(1, 6) + rng.random())
    gain = (1 + rng.uniform(0.1, 0.4) * np.sin(phase)).astype(np.float32)
    return cv2.multiply(image, np.broadcast_to(gain[:, None, None], image.shape).copy(), dtype=cv2.CV_8U)


def _motion_blur(image: Pixels, rng: Rng) -> Pixels:
    length = int(rng.integers(3, 12))
    angle = rng.normal(0, 0.4)
    kernel = np.zeros((length, length), np.float32)
    reach = (length - 1) / 2
    for t in np.linspace(-reach, reach, 2 * length):
        kernel[round(reach + t * np.sin(angle)), round(reach + t * np.cos(angle))] = 1
    return cv2.filter2D(image, -1, kernel / kernel.sum())


def small_picture(image: Pixels, small_width: int) -> Pixels:
    """As if it had been stored far too small."""
    height, width = image.shape[:2]
    small = cv2.resize(image, (small_width, max(1, small_width * height // width)), interpolation=cv2.INTER_AREA)
    return cv2.resize(small, (width, height), interpolation=cv2.INTER_LINEAR)


def _occluded(image: Pixels, texture: Pixels, rng: Rng) -> Pixels:
    height, width = image.shape[:2]
    image = image.copy()
    texture = cv2.resize(texture, (width, height))
    mask = np.zeros((height, width), np.uint8)
    for _ in range(int(rng.integers(1, 4))):
        centre = (int(rng.uniform(0, width)), int(rng.uniform(0.2, 1) * height))
        axes = (int(rng.uniform(0.03, 0.15) * width), int(rng.uniform(0.05, 0.35) * height))
        if rng.random() < 0.5:
            cv2.ellipse(mask, centre, axes, float(rng.uniform(-20, 20)), 0, 360, 1, -1)
        else:
            cv2.rectangle(
                mask, (centre[0] - axes[0], centre[1] - axes[1]), (centre[0] + axes[0], centre[1] + axes[1]), 1, -1
            )
    covered = mask.astype(bool)
    image[covered] = texture[covered] if rng.random() < 0.6 else rng.integers(0, 256, 3)
    return image
