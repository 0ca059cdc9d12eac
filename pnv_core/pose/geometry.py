"""The pose of a query relative to its match, from matched points of their images. N = points.

Camera frames are optical: x right, y down, z forward. A pose (R, t) of the query in the match's frame takes a point x
of the query's frame to R x + t. Scale is never made up: without depth or a known baseline only rotation and direction
are given.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from pnv_core.errors import ConfigError
from pnv_core.verify.local_features import WIDTH
from pnv_core.verify.verifier import EpipolarCheck

Array = NDArray[np.float64]

_LEAST = 12  # points a pose is taken from; five would determine it, chance agrees on eight
_NOISE = 1.0 / WIDTH  # standard deviation of a matched point, in image widths: one thumbnail pixel
_LEAST_PARALLAX = 1.5 * _NOISE  # below it the direction of motion cannot be told
_NEAR, _FAR = 0.05, 100.0  # metres; depths outside are no measurement


@dataclass(frozen=True)
class Intrinsics:
    """A rectified pinhole camera: focal lengths and principal point, all in image widths."""

    fx: float
    fy: float
    cx: float
    cy: float

    @classmethod
    def of_pixels(cls, fx: float, fy: float, cx: float, cy: float, width: int) -> "Intrinsics":
        """From pixels of an image `width` wide, as in CameraInfo. Raises ConfigError for an uncalibrated camera."""
        if not (fx > 0 and fy > 0 and width > 0 and np.isfinite([fx, fy, cx, cy]).all()):
            raise ConfigError(
                f"camera fx = {fx}, fy = {fy}, width = {width}; allowed: a calibrated camera, all above 0"
            )
        return cls(fx / width, fy / width, cx / width, cy / width)

    def rays(self, points: NDArray) -> Array:
        """(N, 2) points in image widths -> (N, 2) on the plane z = 1."""
        centred = np.asarray(points, np.float64) - (self.cx, self.cy)
        return centred / (self.fx, self.fy)


@dataclass(frozen=True, eq=False)
class RelativePose:
    """The query's camera in the frame of the match's camera.

    `translation` (3,) is in metres if `metric`, else a direction of length 1, or zeros where the views are too close to
    tell one. `covariance` (6, 6) is of (x, y, z, rotation about x, y, z), metres and radians, for metric poses only.
    `inliers` is the number of points it rests on.
    """

    rotation: Array
    translation: Array
    metric: bool
    inliers: int
    covariance: Array | None = None

    @property
    def quaternion(self) -> Array:
        """(x, y, z, w)."""
        vector = cv2.Rodrigues(self.rotation)[0].ravel()
        angle = float(np.linalg.norm(vector))
        axis = vector / angle if angle else np.zeros(3)
        return np.append(axis * np.sin(angle / 2), np.cos(angle / 2))


def relative_direction(check: EpipolarCheck, query: Intrinsics, match: Intrinsics) -> RelativePose | None:
    """Rotation and direction of motion from the essential matrix, refined on the Sampson distance.

    None where too few points agree on one.
    """
    a, b = query.rays(check.query[check.inlier]), match.rays(check.reference[check.inlier])
    if len(a) < _LEAST:
        return None
    noise = 2 * _NOISE / (query.fx + match.fx)
    essential, _ = cv2.findEssentialMat(a, b, np.eye(3), cv2.RANSAC, 0.999, 1.5 * noise)
    if essential is None or essential.shape != (3, 3):
        return None
    count, rotation, translation, mask = cv2.recoverPose(essential, a, b, np.eye(3))
    good = mask.ravel() > 0
    turned_only = _rotation_between(a, b)
    parallax = np.median(np.linalg.norm(_turned(turned_only, a) - b, axis=1))
    if parallax < _LEAST_PARALLAX / match.fx:
        return RelativePose(turned_only, np.zeros(3), metric=False, inliers=len(a))
    if count < _LEAST:
        return None
    rotation, translation = _refined(rotation, translation.ravel(), a[good], b[good], noise)
    return RelativePose(rotation, translation, metric=False, inliers=int(count))


def _rotation_between(a: Array, b: Array) -> Array:
    """The rotation that best takes the directions of rays a to those of b (Kabsch)."""
    da, db = (np.column_stack([r, np.ones(len(r))]) for r in (a, b))
    da, db = da / np.linalg.norm(da, axis=1)[:, None], db / np.linalg.norm(db, axis=1)[:, None]
    u, _, vt = np.linalg.svd(db.T @ da)
    return u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt


def _turned(rotation: Array, rays: Array) -> Array:
    turned = np.column_stack([rays, np.ones(len(rays))]) @ rotation.T
    return turned[:, :2] / turned[:, 2:]


def _refined(rotation: Array, translation: Array, a: Array, b: Array, noise: float) -> tuple[Array, Array]:
    ha, hb = np.column_stack([a, np.ones(len(a))]), np.column_stack([b, np.ones(len(b))])
    basis = np.linalg.svd(translation[None])[2][1:]  # two directions across the translation

    def pose(x: Array) -> tuple[Array, Array]:
        t = translation + x[3:] @ basis
        return cv2.Rodrigues(x[:3])[0] @ rotation, t / np.linalg.norm(t)

    def sampson(x: Array) -> Array:
        r, t = pose(x)
        e = np.cross(np.eye(3), t).T @ r  # [t]x R
        ea, eb = ha @ e.T, hb @ e
        residual = (hb * ea).sum(1)
        return residual / np.sqrt((ea[:, :2] ** 2).sum(1) + (eb[:, :2] ** 2).sum(1) + 1e-18) / noise

    from scipy.optimize import least_squares  # slow to import, and not needed to recognise

    return pose(least_squares(sampson, np.zeros(5), loss="soft_l1", max_nfev=30).x)


def metric_from_points(points: Array, rays: Array, focal: float, scale_error: float = 0.0) -> RelativePose | None:
    """The metric pose from (N, 3) points in the query's frame [m] and their rays (N, 2) in the match's image.

    `focal` is that of the match's camera in image widths; `scale_error` the relative error all points share, as from
    a baseline. None where too few points agree.
    """
    if len(points) < _LEAST:
        return None
    tolerance = 3 * _NOISE / focal
    points, rays = np.ascontiguousarray(points, np.float64), np.ascontiguousarray(rays, np.float64)
    ok, turn, shift, inlier = cv2.solvePnPRansac(
        points, rays, np.eye(3), None, reprojectionError=tolerance, iterationsCount=200, confidence=0.999,
        flags=cv2.SOLVEPNP_EPNP,
    )  # fmt: skip
    if not ok or inlier is None or len(inlier) < _LEAST:
        return None
    chosen = inlier.ravel()
    turn, shift = cv2.solvePnPRefineLM(points[chosen], rays[chosen], np.eye(3), None, turn, shift)
    projected, jacobian = cv2.projectPoints(points[chosen], turn, shift, np.eye(3), None)
    residual = projected.reshape(-1, 2) - rays[chosen]
    variance = max(float((residual**2).sum() / (2 * len(chosen) - 6)), (_NOISE / focal) ** 2)
    normal = jacobian[:, :6].T @ jacobian[:, :6]  # of (rotation vector, translation)
    if np.linalg.cond(normal) > 1e12:
        return None
    covariance = np.linalg.inv(normal) * variance
    order = [3, 4, 5, 0, 1, 2]
    covariance = covariance[np.ix_(order, order)]
    t = shift.ravel()
    covariance[:3, :3] += np.outer(t, t) * scale_error**2
    return RelativePose(cv2.Rodrigues(turn)[0], t, metric=True, inliers=len(chosen), covariance=covariance)


def metric_from_depth(
    check: EpipolarCheck, depth: NDArray[np.floating], query: Intrinsics, match: Intrinsics
) -> RelativePose | None:
    """The metric pose where the query has a depth image (h, w) in metres, registered to it; 0 or NaN = unknown."""
    points, seen = check.query[check.inlier], check.reference[check.inlier]
    h, w = depth.shape
    column = np.clip((points[:, 0] * w).astype(int), 0, w - 1)
    row = np.clip((points[:, 1] * w).astype(int), 0, h - 1)
    z = depth[row, column].astype(np.float64)
    known = np.isfinite(z) & (z > _NEAR) & (z < _FAR)
    rays = query.rays(points[known])
    xyz = np.column_stack([rays, np.ones(len(rays))]) * z[known, None]
    return metric_from_points(xyz, match.rays(seen[known]), match.fx)


def metric_from_baseline(
    check: EpipolarCheck, neighbour: EpipolarCheck, baseline_m: float, query: Intrinsics, match: Intrinsics,
    scale_error: float = 0.1,
) -> RelativePose | None:  # fmt: skip
    """The metric pose where odometry knows how far the query's camera is from a neighbouring view of its own.

    check: query against match; neighbour: the same query against that view, `baseline_m` metres away. The points both
    share are triangulated from the neighbour. None where the baseline shows no parallax or too few points are shared.
    """
    if not baseline_m > 0:
        return None
    pair = relative_direction(neighbour, query, query)
    if pair is None or not pair.translation.any():
        return None
    mine, there = check.query[check.inlier], check.reference[check.inlier]
    also, beside = neighbour.query[neighbour.inlier], neighbour.reference[neighbour.inlier]
    where = {tuple(point): i for i, point in enumerate(also)}
    shared = [(i, where[tuple(point)]) for i, point in enumerate(mine) if tuple(point) in where]
    if len(shared) < _LEAST:
        return None
    first, second = np.array(shared).T
    a, b = query.rays(mine[first]), query.rays(beside[second])
    projection = np.column_stack([pair.rotation, pair.translation])
    homogeneous = cv2.triangulatePoints(np.eye(3, 4), projection, a.T, b.T)
    with np.errstate(divide="ignore", invalid="ignore"):
        xyz = (homogeneous[:3] / homogeneous[3]).T * baseline_m
    ahead = (xyz[:, 2] > _NEAR) & (xyz[:, 2] < 50 * baseline_m)  # beyond, the parallax is of the order of the noise
    return metric_from_points(xyz[ahead], match.rays(there[first][ahead]), match.fx, scale_error)
