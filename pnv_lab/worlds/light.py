"""Light of one visit: what is baked into the textures (lamps, sun, shadows) and what the camera adds to the frame."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.random import Generator, default_rng
from numpy.typing import NDArray

from pnv_lab.worlds.rendering import Surface

Array = NDArray[np.float64]

_CELL_M = 0.4  # grid of the light map


@dataclass(frozen=True)
class Light:
    """One lighting of a world.

    ambient: even light on everything; lamps: power of the world's lamps (1 lights what is 2 m below by 1);
    lamps_off: share of the lamps that is dark; extra_lamps: further lamps at places drawn from `seed`;
    sun_deg: (azimuth, elevation) outdoors, light from that side and cast shadows, None for an overcast sky;
    blotches: depth of soft shadows; tint: colour cast per RGB channel; gamma: of the camera curve; noise: deviation of
    the pixel noise in grey values; vignette: loss of light in the image corners.
    """

    ambient: float = 0.62
    lamps: float = 0.5
    lamps_off: float = 0.0
    extra_lamps: int = 0
    sun_deg: tuple[float, float] | None = (40.0, 50.0)
    blotches: float = 0.1
    tint: tuple[float, float, float] = (1.0, 1.0, 1.0)
    gamma: float = 1.0
    noise: float = 3.0
    vignette: float = 0.18
    seed: int = 0

    @classmethod
    def changed(cls, seed: int, strength: float = 1.0) -> "Light":
        """Another time of day: cast, curve, lamps, sun and noise differ from Light() by about `strength`."""
        rng = default_rng((seed, 77))
        warm = rng.uniform(-0.16, 0.16) * strength
        return cls(
            ambient=0.62 - strength * rng.uniform(0.05, 0.22),
            lamps=0.5 + strength * rng.uniform(-0.15, 0.3),
            lamps_off=min(0.8, strength * rng.uniform(0.2, 0.5)),
            extra_lamps=round(strength * int(rng.integers(2, 6))),
            sun_deg=(40.0 + strength * rng.uniform(60, 200), 50.0 - min(1.0, strength) * rng.uniform(5, 25)),
            blotches=0.1 + 0.07 * strength,
            tint=(1 + warm, 1 + strength * rng.uniform(-0.04, 0.04), 1 - warm),
            gamma=float(np.exp(strength * rng.uniform(-0.3, 0.3))),
            noise=3.0 + 3.0 * strength,
            seed=seed,
        )


def lit_texture(surface: Surface, light: Light, lamps: Array, casters: Array, rng: Generator) -> NDArray[np.uint8]:
    """The surface's texture under the light.

    `lamps` (L, 3) are the lamps that are on; `casters` (B, 2, 3) the low and high corners of boxes that cast shadows.
    """
    if surface.lamp or surface.sky:
        return surface.texture
    rows, cols = (int(np.clip(np.linalg.norm(side) / _CELL_M, 1, 400)) + 1 for side in (surface.down, surface.right))
    across, along = np.meshgrid(np.linspace(0, 1, cols), np.linspace(0, 1, rows))
    points = surface.points(np.stack([across.ravel(), along.ravel()], axis=1))
    bright = np.full(len(points), light.ambient)
    for lamp in lamps:
        ray = lamp - points
        square = (ray**2).sum(1) + 0.3
        cosine = ray @ surface.normal / np.sqrt(square)
        facing = np.abs(cosine) if surface.double_sided else np.maximum(cosine, 0)
        bright += light.lamps * 4.0 / (square + 2.0) * facing
    if light.sun_deg is not None and len(casters):
        bright += 0.55 * _sunlight(points, surface, light.sun_deg, casters)
    bright *= 1 + light.blotches * np.clip(_blotches(rng, rows, cols).ravel(), -1.5, 1.5)
    h, w = surface.texture.shape[:2]
    light_map = cv2.resize(bright.reshape(rows, cols).astype(np.float32), (w, h), interpolation=cv2.INTER_LINEAR)
    lit = surface.texture.copy()
    lit[..., :3] = np.clip(surface.texture[..., :3] * light_map[..., None], 0, 255)
    return lit


def _blotches(rng: Generator, rows: int, cols: int) -> NDArray[np.float32]:
    coarse = rng.standard_normal((rows // 5 + 2, cols // 5 + 2), dtype=np.float32)
    smooth = cv2.resize(coarse, (cols, rows), interpolation=cv2.INTER_CUBIC)
    return smooth.reshape(rows, cols).astype(np.float32, copy=False)


def _sunlight(points: Array, surface: Surface, sun_deg: tuple[float, float], casters: Array) -> Array:
    """(N,) share of direct sun: the cosine of incidence, 0 where a box lies between the point and the sun."""
    azimuth, elevation = np.deg2rad(sun_deg)
    towards = np.array([np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)])
    cosine = float(surface.normal @ towards)
    cosine = abs(cosine) if surface.double_sided else cosine
    if cosine <= 0:
        return np.zeros(len(points))
    start = points + 0.05 * surface.normal
    with np.errstate(divide="ignore", invalid="ignore"):
        low = (casters[:, 0, None] - start[None]) / towards  # (B, N, 3) slab entries
        high = (casters[:, 1, None] - start[None]) / towards
    enter, leave = np.minimum(low, high).max(2), np.maximum(low, high).min(2)
    blocked = ((leave > np.maximum(enter, 0)) & (leave > 0.1)).any(0)
    return np.where(blocked, 0.0, cosine)


def exposed(image: NDArray[np.uint8], light: Light, rng: Generator) -> NDArray[np.uint8]:
    """What the camera makes of the scene: vignette, curve, colour cast, slight blur, noise drawn from `rng`."""
    h, w = image.shape[:2]
    y, x = np.linspace(-1, 1, h, dtype=np.float32), np.linspace(-1, 1, w, dtype=np.float32)
    fall = 1 - light.vignette / 2 * (y[:, None] ** 2 + x[None] ** 2)
    dimmed = cv2.multiply(image, cv2.merge([fall, fall, fall]), dtype=cv2.CV_8U)
    level = np.arange(256)[:, None] / 255.0
    curve = np.clip(255 * np.array(light.tint) * level**light.gamma, 0, 255).astype(np.uint8)
    coloured = cv2.LUT(dimmed, curve[:, None, :])
    soft = cv2.GaussianBlur(coloured, (3, 3), 0.45)
    grain = _grain(rng, h, w) * light.noise
    return cv2.add(soft, np.rint(grain), dtype=cv2.CV_8U).astype(np.uint8, copy=False)


_GRAIN = default_rng(20210620).standard_normal((701, 997, 3), dtype=np.float32)


def _grain(rng: Generator, height: int, width: int) -> NDArray[np.float32]:
    """(height, width, 3) unit noise: a window at a random place of a fixed field, which repeats."""
    row, col = rng.integers(0, _GRAIN.shape[0]), rng.integers(0, _GRAIN.shape[1])
    rows = (row + np.arange(height)) % _GRAIN.shape[0]
    cols = (col + np.arange(width)) % _GRAIN.shape[1]
    field: NDArray[np.float32] = _GRAIN[rows[:, None], cols[None]]
    return field
