"""Textured surfaces, a pinhole camera and the rasteriser.

World frame: x and y level, z up, metres. Body frame: x forward, y left, z up. Camera frame: x right, y down, z forward.
"""

from dataclasses import dataclass, field
from math import cos, pi, sin

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

NEAR_M = 0.05
_SUBPIXEL = 4  # bits of fillConvexPoly's fixed point
CAMERA_IN_BODY = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # camera axes as columns
_UNIT_SQUARE = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])


@dataclass(frozen=True)
class Pose:
    """Where the camera is and looks: metres and radians. yaw turns left, pitch looks down, roll dips the right side."""

    x: float
    y: float
    z: float = 1.2
    yaw: float = 0.0
    pitch: float = 0.0
    roll: float = 0.0

    def matrix(self) -> Array:
        """(4, 4) body to world."""
        cy, sy, cp, sp, cr, sr = (f(a) for a in (self.yaw, self.pitch, self.roll) for f in (cos, sin))
        about_z = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
        about_y = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
        about_x = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
        transform = np.eye(4)
        transform[:3, :3] = about_z @ about_y @ about_x
        transform[:3, 3] = self.x, self.y, self.z
        return transform


@dataclass(frozen=True)
class Camera:
    """A pinhole without distortion, square pixels, principal point at the image centre; integer pixels are centres."""

    width: int
    height: int
    horizontal_view_deg: float = 75.0

    @property
    def focal(self) -> float:
        return self.width / 2 / float(np.tan(np.deg2rad(self.horizontal_view_deg) / 2))

    def matrix(self) -> Array:
        """(3, 3) intrinsic matrix."""
        f = self.focal
        return np.array([[f, 0, (self.width - 1) / 2], [0, f, (self.height - 1) / 2], [0, 0, 1]])

    def project(self, points: Array, pose: Pose) -> tuple[Array, Array]:
        """World points (N, 3) -> pixels (N, 2) as (x, y) and depths (N,) along the optical axis."""
        body = pose.matrix()
        local = (points - body[:3, 3]) @ (body[:3, :3] @ CAMERA_IN_BODY)
        pixels = local @ self.matrix().T
        return pixels[:, :2] / pixels[:, 2:], local[:, 2]


@dataclass(eq=False)
class Surface:
    """A textured parallelogram. Texture column runs along `right`, row along `down`, both from `origin` (top left).

    It is seen from the side where right points right and down points down; `double_sided` from both. A texture of four
    channels is cut out by its alpha. `lamp` surfaces shine by themselves; a `sky` surface moves with the camera.
    """

    origin: Array
    right: Array
    down: Array
    texture: NDArray[np.uint8]
    double_sided: bool = False
    lamp: bool = False
    sky: bool = False
    normal: Array = field(init=False)

    def __post_init__(self) -> None:
        normal = -np.cross(self.right, self.down)
        self.normal = normal / np.linalg.norm(normal)

    def points(self, square: Array) -> Array:
        """Fractions (N, 2) along right and down -> world points (N, 3)."""
        points: Array = self.origin + square[:, :1] * self.right + square[:, 1:] * self.down
        return points


def pyramid(texture: Image) -> list[Image]:
    """The texture and its halvings by area, down to a few pixels."""
    levels: list[Image] = [texture]
    while min(levels[-1].shape[:2]) >= 4 and len(levels) < 8:
        h, w = levels[-1].shape[:2]
        half = cv2.resize(levels[-1], ((w + 1) // 2, (h + 1) // 2), interpolation=cv2.INTER_AREA)
        levels.append(half.astype(np.uint8, copy=False))
    return levels


def rasterise(surfaces: list[Surface], pyramids: list[list[Image]], camera: Camera, pose: Pose) -> Image:
    """The scene as the camera sees it, (H, W, 3). `pyramids` holds the lit texture levels of every surface."""
    return _rasterised(surfaces, pyramids, camera, pose)[0]


def depth_image(surfaces: list[Surface], camera: Camera, pose: Pose) -> NDArray[np.float32]:
    """(H, W) metres along the optical axis; 0 where there is nothing or the sky."""
    solid = [s for s in surfaces if not s.sky]
    nearness = _rasterised(solid, [[s.texture] for s in solid], camera, pose)[1]
    return np.divide(1, nearness, out=np.zeros_like(nearness), where=nearness > 0)


def _rasterised(
    surfaces: list[Surface], pyramids: list[list[Image]], camera: Camera, pose: Pose
) -> tuple[Image, NDArray[np.float32]]:
    body = pose.matrix()
    eye = body[:3, 3]
    world_to_camera = (body[:3, :3] @ CAMERA_IN_BODY).T
    project = camera.matrix() @ world_to_camera
    image = np.zeros((camera.height, camera.width, 3), np.uint8)
    nearness = np.zeros((camera.height, camera.width), np.float32)  # inverse depth of what is drawn

    origins = np.array([s.origin if not s.sky else s.origin + eye for s in surfaces]) - eye
    rights, downs = np.array([s.right for s in surfaces]), np.array([s.down for s in surfaces])
    normals = np.array([s.normal for s in surfaces])
    both = np.array([s.double_sided for s in surfaces])
    corners = np.stack([origins, origins + rights, origins + rights + downs, origins + downs], axis=1)
    h = corners @ project.T
    depth = h[..., 2]
    facing = both | (np.einsum("ij,ij->i", normals, origins) < 0)
    outside = (
        (depth < NEAR_M).all(1)
        | (h[..., 0] < 0).all(1)
        | (h[..., 1] < 0).all(1)
        | (h[..., 0] > depth * (camera.width - 1)).all(1)
        | (h[..., 1] > depth * (camera.height - 1)).all(1)
    )
    visible = np.flatnonzero(facing & ~outside)
    for i in visible[np.argsort(np.maximum(depth[visible], 0).min(1))]:
        plane = project @ np.stack([rights[i], downs[i], origins[i]], axis=1)  # (fraction right, down, 1) -> pixel
        for square in _pieces(plane, _UNIT_SQUARE, 0):
            _draw(image, nearness, plane, square, pyramids[i])
    return image, nearness


def _pieces(plane: Array, square: Array, level: int) -> list[Array]:
    """Split a rectangle of the surface until the depth over a piece varies little: one level of detail fits it."""
    depth = plane[2, :2] @ square.T + plane[2, 2]
    if depth.max() < NEAR_M:
        return []
    if level == 6 or depth.max() < 1.7 * max(depth.min(), 4 * NEAR_M):
        return [square]
    low, high = square[0], square[2]
    axis = int(np.argmax(np.abs(plane[2, :2]) * (high - low)))
    middle = (low[axis] + high[axis]) / 2
    first, second = square.copy(), square.copy()
    first[first[:, axis] > middle, axis] = middle
    second[second[:, axis] < middle, axis] = middle
    return _pieces(plane, first, level + 1) + _pieces(plane, second, level + 1)


def _clip_near(homogeneous: Array) -> Array:
    """The part of a convex polygon (N, 3) of (x*z, y*z, z) with z >= NEAR_M."""
    kept = []
    for a, b in zip(homogeneous, np.roll(homogeneous, -1, axis=0), strict=True):
        if a[2] >= NEAR_M:
            kept.append(a)
        if (a[2] >= NEAR_M) != (b[2] >= NEAR_M):
            kept.append(a + (NEAR_M - a[2]) / (b[2] - a[2]) * (b - a))
    return np.array(kept)


def _draw(image: Image, nearness: NDArray[np.float32], plane: Array, square: Array, levels: list[Image]) -> None:
    polygon = square @ plane[:, :2].T + plane[:, 2]
    if polygon[:, 2].min() < NEAR_M:
        polygon = _clip_near(polygon)
    if len(polygon) < 3:
        return
    pixels = polygon[:, :2] / polygon[:, 2:]
    height, width = nearness.shape
    x0, y0 = np.maximum(np.floor(pixels.min(0)).astype(int), 0)
    x1, y1 = np.minimum(np.ceil(pixels.max(0)).astype(int), (width - 1, height - 1))
    if x1 < x0 or y1 < y0:
        return
    w, h = int(x1 - x0 + 1), int(y1 - y0 + 1)

    to_fraction = np.linalg.inv(plane)  # pixel -> (fraction right, down, 1) / depth
    shifted = to_fraction @ np.array([[1.0, 0, x0], [0, 1.0, y0], [0, 0, 1]])
    a, b, c = (np.float32(coefficient) for coefficient in shifted[2])
    near = (b * np.arange(h, dtype=np.float32) + c)[:, None] + (a * np.arange(w, dtype=np.float32))[None]
    region = nearness[y0 : y1 + 1, x0 : x1 + 1]
    mask = np.zeros((h, w), np.uint8)
    fixed = np.clip(np.round((pixels - (x0, y0)) * 2**_SUBPIXEL), -(2**20), 2**20).astype(np.int32)
    cv2.fillConvexPoly(mask, fixed, 255, cv2.LINE_8, _SUBPIXEL)
    cv2.bitwise_and(mask, cv2.compare(near, region, cv2.CMP_GT), mask)
    if not cv2.countNonZero(mask):
        return

    texels = np.prod(square[2] - square[0]) * levels[0].shape[0] * levels[0].shape[1]
    area = max(cv2.contourArea(pixels.astype(np.float32)), 1.0)
    level = int(np.clip(np.round(0.5 * np.log2(texels / area) - 0.2), 0, len(levels) - 1))
    texture = levels[level]
    th, tw = texture.shape[:2]
    to_texel = np.array([[tw, 0, -0.5], [0, th, -0.5], [0, 0, 1.0]]) @ shifted
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    painted = cv2.warpPerspective(texture, to_texel, (w, h), flags=flags, borderMode=cv2.BORDER_REPLICATE)
    if painted.shape[2] == 4:
        cv2.bitwise_and(mask, cv2.inRange(painted[..., 3], 128, 255), mask)
        painted = np.ascontiguousarray(painted[..., :3])
    cv2.copyTo(painted, mask, image[y0 : y1 + 1, x0 : x1 + 1])
    cv2.copyTo(near, mask, region)


def wrapped(angle: Array) -> Array:
    """Angles in radians, brought into [-pi, pi)."""
    turned: Array = (np.asarray(angle) + pi) % (2 * pi) - pi
    return turned
