"""Worlds and walks through them: rendered frames with exact poses and known revisits."""

from collections.abc import Iterator
from collections.abc import Sequence as Sequence_
from dataclasses import dataclass
from functools import cached_property
from zlib import crc32

import cv2
import numpy as np
from numpy.random import default_rng
from numpy.typing import NDArray

from pnv_core.errors import ConfigError
from pnv_core.types import Frame
from pnv_lab.worlds.light import Light, exposed, lit_texture
from pnv_lab.worlds.rendering import CAMERA_IN_BODY, Camera, Pose, depth_image, pyramid, rasterise, wrapped
from pnv_lab.worlds.scenes import KINDS, Scene

Array = NDArray[np.float64]

CAMERA = "/camera/image_raw"
_START_NS = 1_700_000_000_000_000_000


class World:
    """A place made from a seed. Raises ConfigError for an unknown kind."""

    def __init__(self, seed: int, kind: str = "corridor") -> None:
        if kind not in KINDS:
            raise ConfigError(f"world kind {kind!r} is not one of {', '.join(KINDS)}")
        self.seed, self.kind = seed, kind
        self._scene: Scene = KINDS[kind](default_rng((seed, crc32(kind.encode()))))
        self._lit: tuple[Light, list[list[NDArray[np.uint8]]]] | None = None
        self.route = self._scene.route  # (N, 2) corners of the closed walk
        self.height_m = self._scene.height_m

    def render(
        self, pose: Pose, light: Light | None = None, size: tuple[int, int] = (320, 240), noise_seed: int = 0
    ) -> NDArray[np.uint8]:
        """The view from a pose: rgb (height, width, 3) for size (width, height). Equal arguments give equal bytes.

        Textures are lit once per light and kept for the last one used.
        """
        light = light or Light()
        image = rasterise(self._scene.surfaces, self._lit_pyramids(light), Camera(*size), pose)
        return exposed(image, light, default_rng((light.seed, noise_seed)))

    def depth(self, pose: Pose, size: tuple[int, int] = (320, 240)) -> NDArray[np.float32]:
        """(height, width) metres along the optical axis of what `render` shows; 0 for the sky."""
        return depth_image(self._scene.surfaces, Camera(*size), pose)

    def _lit_pyramids(self, light: Light) -> list[list[NDArray[np.uint8]]]:
        if self._lit is None or self._lit[0] != light:
            rng = default_rng((self.seed, light.seed, 5))
            lamps = np.array(self._scene.lamps).reshape(-1, 3)
            on = lamps[rng.random(len(lamps)) >= light.lamps_off]
            spots = self.route[rng.integers(0, len(self.route), light.extra_lamps)]
            extra = np.column_stack([spots + rng.normal(0, 0.7, spots.shape), rng.uniform(0.8, 2.2, len(spots))])
            shining = np.concatenate([on, extra])
            casters = np.array(self._scene.casters).reshape(-1, 2, 3)
            lit = [pyramid(lit_texture(s, light, shining, casters, rng)) for s in self._scene.surfaces]
            self._lit = light, lit
        return self._lit[1]

    @cached_property
    def _smooth_route(self) -> tuple[Array, Array]:
        """The route with rounded corners, sampled every 5 cm: points (N, 2) and headings (N,)."""
        corners = np.concatenate([self.route, self.route[:1]])
        lengths = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))])
        along = np.arange(0, lengths[-1], 0.05)
        points = np.stack([np.interp(along, lengths, corners[:, axis]) for axis in (0, 1)], axis=1)
        window = 41  # 2 m, so that corners are walked as arcs
        kernel = np.hanning(window + 2)[1:-1] / np.hanning(window + 2)[1:-1].sum()
        padded = np.concatenate([points[-window:], points, points[:window]])
        smooth = np.stack([np.convolve(padded[:, axis], kernel, "same") for axis in (0, 1)], axis=1)[window:-window]
        step = np.roll(smooth, -1, axis=0) - np.roll(smooth, 1, axis=0)
        return smooth, np.arctan2(step[:, 1], step[:, 0])

    @property
    def route_length_m(self) -> float:
        return len(self._smooth_route[0]) * 0.05

    def pose_on_route(self, metres: float, offset_m: float = 0.0, turn: float = 0.0, rise_m: float = 0.0) -> Pose:
        """The pose so far along the route, `offset_m` to the left of it, turned left by `turn`, raised by `rise_m`."""
        points, headings = self._smooth_route
        k = round(metres / 0.05) % len(points)
        left = np.array([-np.sin(headings[k]), np.cos(headings[k])])
        x, y = points[k] + offset_m * left
        return Pose(float(x), float(y), self.height_m + rise_m, float(headings[k]) + turn)


@dataclass(frozen=True, eq=False)
class Sequence:
    """A walk: one pose, light and stamp per frame. A frame is rendered when it is taken, always to the same bytes."""

    world: World
    poses: tuple[Pose, ...]
    lights: tuple[Light, ...]
    stamps_ns: tuple[int, ...]
    size: tuple[int, int]

    def __len__(self) -> int:
        return len(self.poses)

    def __getitem__(self, index: int) -> Frame:
        rgb = self.world.render(self.poses[index], self.lights[index], self.size, noise_seed=index)
        return Frame(self.stamps_ns[index], CAMERA, rgb)

    def __iter__(self) -> Iterator[Frame]:
        return (self[index] for index in range(len(self)))

    @cached_property
    def matrices(self) -> Array:
        """(n, 4, 4) body to world; the body's x looks forward, z up."""
        return np.stack([pose.matrix() for pose in self.poses])

    def same_place(self, a: int, b: int, radius_m: float = 2.0, heading_deg: float = 40.0) -> bool:
        """Whether two frames stand within `radius_m` and look within `heading_deg` of each other."""
        return bool(self.places(radius_m, heading_deg)[a, b])

    def places(self, radius_m: float = 2.0, heading_deg: float = 40.0) -> NDArray[np.bool_]:
        """(n, n) same_place of all pairs."""
        xyz = np.array([(p.x, p.y, p.z) for p in self.poses])
        yaw = np.array([p.yaw for p in self.poses])
        close = np.linalg.norm(xyz[:, None] - xyz[None], axis=2) <= radius_m
        table: NDArray[np.bool_] = close & (np.abs(wrapped(yaw[:, None] - yaw[None])) <= np.deg2rad(heading_deg))
        return table

    def shared_view(self, a: int, b: int, size: tuple[int, int] = (80, 60)) -> float:
        """Share of what one frame shows that the other shows too, the lesser of both ways, in [0, 1].

        By the exact depth at `size` (width, height): a surface point counts as seen where the other frame's depth there
        is its own within 5 % and 10 cm. The sky counts for nothing.
        """
        camera, poses = Camera(*size), (self.poses[a], self.poses[b])
        depths = [self.world.depth(pose, size).astype(float) for pose in poses]
        return min(_seen_too(camera, poses, depths), _seen_too(camera, poses[::-1], depths[::-1]))

    def revisits(
        self, gap_s: float = 30.0, radius_m: float = 2.0, heading_deg: float = 40.0
    ) -> list[NDArray[np.int64]]:
        """For every frame, the earlier frames of the same place that are at least `gap_s` older, oldest first."""
        stamps = np.array(self.stamps_ns)
        older = stamps[None] <= stamps[:, None] - int(gap_s * 1e9)
        table = self.places(radius_m, heading_deg) & older
        return [np.flatnonzero(row) for row in table]


def _seen_too(camera: Camera, poses: Sequence_[Pose], depths: Sequence_[Array]) -> float:
    """Share of the surface points of the first pose's view that lie on what the second one sees."""
    y, x = np.nonzero(depths[0])
    if not len(x):
        return 0.0
    rays = np.column_stack([x, y, np.ones(len(x))]) @ np.linalg.inv(camera.matrix()).T
    body = poses[0].matrix()
    points = (rays * depths[0][y, x, None]) @ (body[:3, :3] @ CAMERA_IN_BODY).T + body[:3, 3]
    pixels, depth = camera.project(points, poses[1])
    u, v = np.rint(np.where(depth[:, None] > 0, pixels, -1)).astype(int).T
    inside = (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    there = depths[1][v[inside], u[inside]]
    seen = np.abs(there - depth[inside]) <= 0.05 * depth[inside] + 0.1
    return float((seen & (there > 0)).sum() / len(x))


def loop_sequence(
    seed: int,
    kind: str = "corridor",
    *,
    laps: float = 2.0,
    speed_m_s: float = 1.2,
    fps: float = 4.0,
    size: tuple[int, int] = (320, 240),
    light_change: float = 1.0,
    view_change: float = 1.0,
) -> Sequence:
    """Walk the world's closed route `laps` times; every lap after the first has its own light and line.

    light_change 0 keeps the light, 1 is another time of day. view_change 0 repeats the line exactly; 1 shifts it by up
    to about 0.3 m, turns it by a few degrees and raises the camera by about 0.1 m.
    """
    world = World(seed, kind)
    rng = default_rng((seed, 31))
    total = world.route_length_m * laps
    metres = np.arange(0, total, speed_m_s / fps)
    lap = (metres // world.route_length_m).astype(int)
    lights = [Light(seed=seed)] + [Light.changed(seed * 101 + k, light_change) for k in range(1, lap.max() + 1)]
    n = lap.max() + 1
    moved = (np.arange(n) > 0) * view_change  # the first lap keeps the middle of the way
    offset = rng.uniform(0.15, 0.3, n) * rng.choice([-1, 1], n) * moved
    turn, rise = rng.normal(0, 0.06, n) * moved, rng.normal(0, 0.06, n) * moved
    phase = rng.uniform(0, 2 * np.pi, (n, 2))
    poses = []
    for s, k in zip(metres, lap, strict=True):
        sway = 0.08 * view_change * np.sin(s / 2.3 + phase[k, 0])
        look = 0.04 * view_change * np.sin(s / 1.7 + phase[k, 1])
        poses.append(world.pose_on_route(float(s), offset[k] + sway, turn[k] + look, rise[k]))
    stamps = _START_NS + np.round(np.arange(len(metres)) * 1e9 / fps).astype(np.int64)
    return Sequence(world, tuple(poses), tuple(lights[k] for k in lap), tuple(int(t) for t in stamps), size)


def contact_sheet(frames: list[NDArray[np.uint8]], columns: int) -> NDArray[np.uint8]:
    """Frames of one size side by side, row by row."""
    blank = np.zeros_like(frames[0])
    rows = -(-len(frames) // columns)
    padded = frames + [blank] * (rows * columns - len(frames))
    return np.vstack([cv2.hconcat(padded[row * columns : (row + 1) * columns]) for row in range(rows)])
