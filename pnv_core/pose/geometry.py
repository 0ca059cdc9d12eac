"""The pose of a query relative to its match, from matched points of their images. M = matches.

Camera frames are optical: x right, y down, z forward. A pose (R, t) of the query in the match's frame takes a point x
of the query's frame to R x + t. Scale is never made up: where depth is known at too few points only rotation and
direction are given.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from pnv_core.errors import ConfigError
from pnv_core.rotations import cross_matrix, exponential, logarithm, quaternion_of, rigid
from pnv_core.verify.verifier import EpipolarCheck

Array = NDArray[np.float64]
Pose = tuple[Array, Array]  # rotation (3, 3), translation (3,)

_LEAST = 12  # points a pose is taken from; five would determine it, chance agrees on eight
_NOISE = 1.0 / 320  # a matched point is rarely further off, in image widths
_LEAST_NOISE = 0.1 * _NOISE  # nor better than this, however well the points agree
_SHARED_NOISE = 0.25 * _NOISE  # all points of an image may be off together: principal point, detector
_LEAST_PARALLAX = 1.0  # noises; where nearly all points move less beside a turn, the direction cannot be told
_LARGE_SHARE = 0.8
_LARGEST_DOUBT = 0.5  # radians: a direction less certain than this is none
_NEAR, _FAR = 0.05, 100.0  # metres; depths outside are no measurement
_FOCAL = 500.0  # of the common camera that OpenCV's thresholds are in pixels of
_TOLERANCES = 0.3, 0.9  # of the search for an essential matrix, in noises
_AGREEING = 3.0
_ITERATIONS, _STILL = 20, 1e-5
_CAUCHY = 2.385  # 95 % efficiency (Zhang 1997)
_EPIPOLAR, _FORWARD, _BACKWARD = 0, 1, 2  # what a match says: no depth, depth in the query, depth in the match


@dataclass(frozen=True)
class Intrinsics:
    """A rectified pinhole camera: focal lengths and principal point, all in image widths, from the top left corner."""

    fx: float
    fy: float
    cx: float
    cy: float

    @classmethod
    def of_pixels(cls, fx: float, fy: float, cx: float, cy: float, width: int) -> "Intrinsics":
        """From pixels of an image `width` wide, as in CameraInfo: (0, 0) is the centre of the first pixel.

        Raises ConfigError for an uncalibrated camera.
        """
        if not width > 0:
            raise ConfigError(f"camera of width {width}; allowed: a calibrated camera, above 0")
        return cls.of_widths(fx / width, fy / width, (cx + 0.5) / width, (cy + 0.5) / width)

    @classmethod
    def of_widths(cls, fx: float, fy: float, cx: float, cy: float) -> "Intrinsics":
        """Raises ConfigError for an uncalibrated camera."""
        if not (fx > 0 and fy > 0 and np.isfinite([fx, fy, cx, cy]).all()):
            raise ConfigError(f"camera fx = {fx}, fy = {fy}; allowed: a calibrated camera, both above 0")
        return cls(fx, fy, cx, cy)

    def rays(self, points: NDArray) -> Array:
        """(M, 2) points in image widths -> (M, 2) on the plane z = 1."""
        centred = np.asarray(points, np.float64) - (self.cx, self.cy)
        return centred / (self.fx, self.fy)


@dataclass(frozen=True, eq=False)
class RelativePose:
    """The query's camera in the frame of the match's camera.

    `translation` (3,) is in metres if `metric`, else a direction of length 1, or zeros where the views are too close to
    tell one. `covariance` (6, 6) is of (x, y, z, rotation about x, y, z) in the match's frame, in the unit of the
    translation and radians; along a direction it is 0, of an unknown direction 1. `inliers` is the number of points it
    rests on.
    """

    rotation: Array
    translation: Array
    metric: bool
    inliers: int
    covariance: Array

    @property
    def matrix(self) -> Array:
        """(4, 4)."""
        return rigid(self.rotation, self.translation)

    @property
    def quaternion(self) -> Array:
        """(x, y, z, w)."""
        return quaternion_of(self.rotation)


def relative_pose(
    check: EpipolarCheck,
    query: Intrinsics,
    match: Intrinsics,
    query_depth: Array | None = None,
    match_depth: Array | None = None,
    scale_error: float = 0.0,
) -> RelativePose | None:
    """The pose that the matches agree on, metric where depth is known, with its covariance; None for too few matches.

    `query_depth`, `match_depth`: (M,) metres along the optical axis at the matched points; 0, NaN or None = unknown.
    `scale_error` is the relative error that all depths share, as from a baseline. A match counts by its reprojection
    where its depth is known and by its epipolar distance elsewhere, so that all of them say something of the rotation.
    """
    if len(check.query) < _LEAST:
        return None
    rays, depths = (query.rays(check.query), match.rays(check.reference)), (query_depth, match_depth)
    here, there = (_known(check, depth) for depth in depths)
    sight = _Sight(*rays, here, there, _NOISE / query.fx, _NOISE / match.fx)[_distinct(check)]
    return _metric(sight, scale_error) or _direction(sight)


def _distinct(check: EpipolarCheck) -> NDArray[np.int64]:
    """One match of each point: a detector gives a point once per orientation, which is no further evidence."""
    pixels = np.rint(np.hstack([check.query, check.reference]) * (2 / _NOISE)).astype(np.int64)
    chosen = np.arange(len(pixels))
    for side in (pixels[:, :2], pixels[:, 2:]):
        chosen = np.intersect1d(chosen, np.unique(side, axis=0, return_index=True)[1])
    return chosen


def depth_at(depth: NDArray[np.floating], points: NDArray) -> Array:
    """(h, w) metres, aligned to the image, at (M, 2) points in image widths; NaN where unknown."""
    h, w = depth.shape
    column, row = (np.clip((points[:, axis] * w).astype(int), 0, most - 1) for axis, most in ((0, w), (1, h)))
    z = depth[row, column].astype(np.float64)
    return np.where((z > _NEAR) & (z < _FAR), z, np.nan)  # false for NaN


def triangulated(check: EpipolarCheck, view: Intrinsics, beside: Intrinsics, motion: Array) -> Array:
    """(M,) depths in the first view of a check against a view beside it, whose frame `motion` (4, 4) takes points to.

    `motion` must be metric. NaN for matches that disagree with it, and where the parallax is of the order of the noise.
    """
    a, b = view.rays(check.query), beside.rays(check.reference)
    away = np.column_stack([a, np.ones(len(a))]) @ motion[:3, :3].T
    t = motion[:3, 3]
    # z away + t is along (b, 1): two equations in z, by least squares
    u, v = away[:, :2] - b * away[:, 2:], b * t[2] - t[:2]
    strength = (u**2).sum(1)
    with np.errstate(divide="ignore", invalid="ignore"):
        z = (u * v).sum(1) / strength
        there = away * z[:, None] + t
        error = np.linalg.norm(there[:, :2] / there[:, 2:] - b, axis=1)
        noise = _NOISE / beside.fx
        moved = np.linalg.norm(u * z[:, None], axis=1) / np.abs(there[:, 2])  # parallax, in rays
        good = (z > _NEAR) & (z < _FAR) & (there[:, 2] > _NEAR) & (error < 2 * noise) & (moved > 4 * noise)
    return np.where(good, z, np.nan)


def depth_by_way(check: EpipolarCheck, view: Intrinsics, beside: Intrinsics, metres: float) -> Array:
    """(M,) depths in the first view of a check where only the way to the second is known; its direction is seen."""
    pose = relative_pose(check, view, beside) if metres > 0 else None
    if pose is None or not pose.translation.any():
        return np.full(len(check.query), np.nan)
    return triangulated(check, view, beside, rigid(pose.rotation, pose.translation * metres))


def _known(check: EpipolarCheck, depth: Array | None) -> Array:
    if depth is None:
        return np.full(len(check.query), np.nan)
    z = np.asarray(depth, np.float64)
    return np.where((z > _NEAR) & (z < _FAR), z, np.nan)


@dataclass(frozen=True, eq=False)
class _Sight:
    """Rays (M, 2) of matched points in query (a) and match (b), their depths (M,) or NaN, and the tolerances."""

    a: Array
    b: Array
    za: Array
    zb: Array
    noise_a: float
    noise_b: float

    def __getitem__(self, chosen: NDArray) -> "_Sight":
        a, b, za, zb = (v[chosen] for v in (self.a, self.b, self.za, self.zb))
        return _Sight(a, b, za, zb, self.noise_a, self.noise_b)

    def __len__(self) -> int:
        return len(self.a)

    @property
    def kind(self) -> NDArray[np.int64]:
        return np.where(np.isfinite(self.za), _FORWARD, np.where(np.isfinite(self.zb), _BACKWARD, _EPIPOLAR))

    def residuals(self, rotation: Array, translation: Array) -> Array:
        """(M, 2) in tolerances; of an epipolar match the first is the Sampson distance and the second 0."""
        out, kind = np.zeros((len(self), 2)), self.kind
        one = kind == _FORWARD
        out[one] = (_seen(_points(self.a[one], self.za[one]) @ rotation.T + translation) - self.b[one]) / self.noise_b
        one = kind == _BACKWARD
        out[one] = (_seen((_points(self.b[one], self.zb[one]) - translation) @ rotation) - self.a[one]) / self.noise_a
        one = kind == _EPIPOLAR
        ha, hb = _points(self.a[one], 1.0), _points(self.b[one], 1.0)
        essential = cross_matrix(translation) @ rotation
        ea, eb = ha @ essential.T, hb @ essential
        gradient = (ea[:, :2] ** 2).sum(1) * self.noise_b**2 + (eb[:, :2] ** 2).sum(1) * self.noise_a**2
        out[one, 0] = (hb * ea).sum(1) / np.sqrt(gradient + 1e-30)
        return out

    def of_shared(self, pose: Pose) -> Array:
        """(M, 2, 4): how the residuals change where all points of the query or of the match are off by the deviation
        that they share, across or down."""
        share, plain = _SHARED_NOISE / _NOISE, self.residuals(*pose)
        off = [replace(self, a=self.a + axis * share * self.noise_a) for axis in np.eye(2)]
        off += [replace(self, b=self.b + axis * share * self.noise_b) for axis in np.eye(2)]
        return np.stack([one.residuals(*pose) - plain for one in off], axis=-1)


def _points(rays: Array, depth: Array | float) -> Array:
    return np.column_stack([rays, np.ones(len(rays))]) * np.reshape(depth, (-1, 1))


def _seen(points: Array) -> Array:
    """(M, 3) -> (M, 2) on the plane z = 1; far outside for points behind the camera."""
    ahead = points[:, 2:] > _NEAR / 10
    return np.where(ahead, points[:, :2] / np.where(ahead, points[:, 2:], 1.0), 1e3)


def _metric(sight: _Sight, scale_error: float) -> RelativePose | None:
    forward, backward = np.isfinite(sight.za), np.isfinite(sight.zb)
    back = backward.sum() > forward.sum()
    known = backward if back else forward
    if known.sum() < _LEAST:
        return None
    one = sight[known]
    rays, depth, other = (one.b, one.zb, one.a) if back else (one.a, one.za, one.b)
    tolerance = 3 * (sight.noise_a if back else sight.noise_b) * _FOCAL
    camera = np.diag([_FOCAL, _FOCAL, 1.0])
    ok, turn, shift, inlier = cv2.solvePnPRansac(
        _points(rays, depth), np.ascontiguousarray(other * _FOCAL), camera, None, reprojectionError=tolerance,
        iterationsCount=300, confidence=0.999, flags=cv2.SOLVEPNP_EPNP,
    )  # fmt: skip
    if not ok or inlier is None or len(inlier) < _LEAST:
        return None
    rotation, translation = cv2.Rodrigues(turn)[0], shift.ravel()
    if back:
        rotation, translation = rotation.T, -rotation.T @ translation
    solved = _solved_twice(sight, (rotation, translation), known)
    if solved is None:
        return None
    pose, covariance, inliers = solved
    covariance[:3, :3] += np.outer(pose[1], pose[1]) * scale_error**2
    return RelativePose(*pose, True, inliers, covariance)


def _solved_twice(sight: _Sight, pose: Pose, known: NDArray[np.bool_]) -> tuple[Pose, Array, int] | None:
    """With the matches that agree with a first pose, then with those that agree with the better one."""
    bound: Array | float = _AGREEING
    for _ in range(2):
        agree = np.linalg.norm(sight.residuals(*pose), axis=1) < bound
        solved = _solved(sight[agree], pose, _moved, 6) if (agree & known).sum() >= _LEAST else None
        if solved is None:
            return None
        pose, covariance, scale = solved
        bound = _AGREEING * np.array([scale[sight.kind[agree] == one].max(initial=0) for one in range(3)])[sight.kind]
    return pose, covariance, int((agree & known).sum())


def _direction(sight: _Sight) -> RelativePose | None:
    """Rotation and direction of motion from the essential matrix, refined on the Sampson distance.

    Sought with a narrow and a wide tolerance. The solution that more of the matches agree with is taken; where the
    other one explains them nearly as well, as on flat scenes, the difference becomes doubt.
    """
    unknown = np.full(len(sight), np.nan)
    sight = replace(sight, za=unknown, zb=unknown)
    starts = [found for tolerance in _TOLERANCES if (found := _essential(sight, tolerance)) is not None]
    turned, still = _only_turned(sight)
    most = max((start[0].sum() for start in starts), default=_LEAST)
    if still.sum() >= max(_LEAST, _LARGE_SHARE * most):
        return _turn(sight[still], turned)
    solutions = [solved for start in starts if (solved := _refined(sight, *start)) is not None]
    if not solutions:
        return None
    best, *others = sorted(solutions, key=lambda solved: solved.cost)
    covariance = best.covariance.copy()
    for other in others:
        if other.cost <= 1.25 * best.cost + 2:
            across = _across(best.pose[1])
            away = np.append(across.T @ across @ other.pose[1], logarithm(other.pose[0] @ best.pose[0].T))
            covariance += np.outer(away, away)
    if np.sqrt(np.linalg.eigvalsh(covariance[:3, :3])[-1]) > _LARGEST_DOUBT:
        return None
    return RelativePose(*best.pose, False, best.inliers, covariance)


@dataclass(frozen=True, eq=False)
class _Direction:
    pose: Pose
    covariance: Array  # (6, 6), 0 along the direction
    inliers: int
    cost: float


def _refined(sight: _Sight, agree: NDArray[np.bool_], pose: Pose) -> _Direction | None:
    """With the matches that agree with a first pose, then with those that agree with the better one."""
    for _ in range(2):
        solved = _solved(sight[agree], pose, _moved_direction, 5) if agree.sum() >= _LEAST else None
        if solved is None:
            return None
        pose, inner, scale = solved
        fits = np.linalg.norm(sight.residuals(*pose), axis=1) < _AGREEING * scale.max()
        used, agree = agree, fits & _in_front(sight, pose)
    jacobian = np.zeros((6, 5))
    jacobian[:3, :2], jacobian[3:, 2:] = _across(pose[1]).T, np.eye(3)
    return _Direction(pose, jacobian @ inner @ jacobian.T, int(used.sum()), _cost(sight, pose))


def _essential(sight: _Sight, tolerance: float) -> tuple[NDArray[np.bool_], Pose] | None:
    """The matches that agree within `tolerance` noises on an essential matrix, and its pose with them in front."""
    a, b = (np.ascontiguousarray(rays * _FOCAL) for rays in (sight.a, sight.b))
    camera, pixels = np.diag([_FOCAL, _FOCAL, 1.0]), tolerance * (sight.noise_a + sight.noise_b) / 2 * _FOCAL
    essential, mask = cv2.findEssentialMat(a, b, camera, cv2.USAC_MAGSAC, 0.999, pixels)
    if essential is None or essential.shape != (3, 3) or (mask.ravel() > 0).sum() < _LEAST:
        return None
    agree = mask.ravel() > 0
    _, rotation, translation, front = cv2.recoverPose(essential, a[agree], b[agree], camera)
    agree[agree] = front.ravel() > 0
    return (agree, (rotation, translation.ravel())) if agree.sum() >= _LEAST else None


def _cost(sight: _Sight, pose: Pose) -> float:
    return float(np.minimum((np.linalg.norm(sight.residuals(*pose), axis=1) / _TOLERANCES[0]) ** 2, 4.0).sum())


def _in_front(sight: _Sight, pose: Pose) -> NDArray[np.bool_]:
    """Which rays meet ahead of both cameras, within what the noise allows."""
    away, b = _points(sight.a, 1.0) @ pose[0].T, _points(sight.b, 1.0)
    normal = np.cross(away, b)
    ahead = (np.cross(pose[1], b) * -normal).sum(1), (np.cross(pose[1], away) * -normal).sum(1)
    slack = 3 * sight.noise_b * np.linalg.norm(away, axis=1) * np.linalg.norm(b, axis=1)
    return np.minimum(*ahead) > -slack


def _moved_direction(pose: Pose, step: Array) -> Pose:
    """A step (5,): two radians across the direction, three of rotation."""
    translation = pose[1] + step[:2] @ _across(pose[1])
    return exponential(step[2:]) @ pose[0], translation / np.linalg.norm(translation)


def _moved(pose: Pose, step: Array) -> Pose:
    """A step (6,): metres, radians."""
    return exponential(step[3:]) @ pose[0], pose[1] + step[:3]


def _across(direction: Array) -> Array:
    """(2, 3): two unit vectors across a unit vector, the same for the same one."""
    return np.linalg.svd(direction[None])[2][1:]


def _only_turned(sight: _Sight) -> tuple[Array, NDArray[np.bool_]]:
    """The rotation that most matches agree with if nothing moved, and which do."""
    agree = np.ones(len(sight), bool)
    for _ in range(10):
        rotation = _rotation_between(sight.a[agree], sight.b[agree])
        size = np.linalg.norm(_seen(_points(sight.a, 1.0) @ rotation.T) - sight.b, axis=1) / sight.noise_b
        agree = size <= max(_LEAST_PARALLAX, float(np.median(size)))
    return rotation, size < _LEAST_PARALLAX


def _turn(sight: _Sight, rotation: Array) -> RelativePose:
    """A rotation alone: what the motion adds to the residuals makes it less certain."""
    residual = _seen(_points(sight.a, 1.0) @ rotation.T) - sight.b
    variance = max((residual**2).sum() / (2 * len(sight) - 3), (_LEAST_NOISE / _NOISE * sight.noise_b) ** 2)
    d = _points(sight.a, 1.0)
    d /= np.linalg.norm(d, axis=1)[:, None]
    information = len(d) * np.eye(3) - d.T @ d
    covariance = np.eye(6)
    covariance[3:, 3:] = np.linalg.inv(information) * variance
    return RelativePose(rotation, np.zeros(3), False, len(sight), covariance)


def _rotation_between(a: Array, b: Array) -> Array:
    """The rotation that best takes the directions of rays a to those of b (Kabsch)."""
    da, db = _points(a, 1.0), _points(b, 1.0)
    da, db = da / np.linalg.norm(da, axis=1)[:, None], db / np.linalg.norm(db, axis=1)[:, None]
    u, _, vt = np.linalg.svd(db.T @ da)
    return u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt


def _solved(
    sight: _Sight, pose: Pose, moved: Callable[[Pose, Array], Pose], freedom: int
) -> tuple[Pose, Array, Array] | None:
    """Gauss-Newton on the Cauchy loss: the pose, the covariance (freedom, freedom) of a step that `moved` takes, and
    the noise (M,) of each match.

    Each kind of match has its own noise, estimated from its residuals. None where the points do not determine it.
    """
    kind = sight.kind
    for _ in range(_ITERATIONS):
        residual = sight.residuals(*pose)
        scale = _scales(residual, kind)
        weight = 1 / (1 + (np.linalg.norm(residual, axis=1) / scale / _CAUCHY) ** 2)
        jacobian = _jacobian(sight, pose, moved, freedom) / scale[:, None, None]
        normal = np.einsum("m,mij,mik->jk", weight, jacobian, jacobian)
        if not np.isfinite(normal).all() or np.linalg.cond(normal) > 1e12:
            return None
        step = -np.linalg.solve(normal, np.einsum("m,mij,mi->j", weight, jacobian, residual / scale[:, None]))
        if np.abs(step).max() < _STILL:
            break
        pose = moved(pose, step)
    covariance = np.linalg.inv(normal)
    shared = np.einsum("m,mij,mik->jk", weight, jacobian, sight.of_shared(pose) / scale[:, None, None])
    carried = covariance @ shared
    return pose, covariance + carried @ carried.T, scale


def _jacobian(sight: _Sight, pose: Pose, moved: Callable[[Pose, Array], Pose], freedom: int) -> Array:
    """(M, 2, freedom), by central differences."""
    h = 1e-6
    sides = [[sight.residuals(*moved(pose, sign * h * step)) for sign in (1, -1)] for step in np.eye(freedom)]
    return np.stack([(up - down) / (2 * h) for up, down in sides], axis=-1)


def _scales(residual: Array, kind: NDArray[np.int64]) -> Array:
    """(M,) standard deviation of each match's kind, from the median, which false matches do not move."""
    size, scale = np.linalg.norm(residual, axis=1), np.ones(len(residual))
    for one in range(3):
        if (chosen := kind == one).any():
            median = float(np.median(size[chosen])) / (0.6745 if one == _EPIPOLAR else 1.1774)
            few = 1 + 5 / chosen.sum()  # the fit has bent towards few points
            scale[chosen] = max(median * few, _LEAST_NOISE / _NOISE)
    return scale
