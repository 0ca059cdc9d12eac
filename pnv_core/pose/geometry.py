"""The pose of a query relative to its match, from matched points of their images. M = matches.

Camera frames are optical: x right, y down, z forward. A pose (R, t) of the query in the match's frame takes a point x
of the query's frame to R x + t. Scale is never made up: where depth is known at too few points only rotation and
direction are given.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from pnv_core.errors import ConfigError
from pnv_core.rotations import cross_matrix, exponential, inverse, inverted, logarithm, quaternion_of, rigid
from pnv_core.verify.verifier import EpipolarCheck

Array = NDArray[np.float64]
Pose = tuple[Array, Array]  # rotation (3, 3), translation (3,)

_LEAST = 12  # points a pose is taken from; five would determine it, chance agrees on eight
_NOISE = 1.0 / 320  # a matched point is rarely further off, in image widths
_LEAST_NOISE = 0.1 * _NOISE  # nor better than this, however well the points agree
_SHARED_NOISE = 0.25 * _NOISE  # all points of an image may be off together: principal point, detector
_LARGEST_DOUBT = 0.5  # radians of a direction, or of a scale's logarithm: one less certain than this is none
_HALVES, _MOST_FAILED = 24, 6  # halves of the matches that are solved, and how many of them may show nothing
_LEAST_HALF = 8  # points; five determine an essential matrix
_LEAST_SHARED = 5  # points seen in three views, for a scale
_NEAR, _FAR = 0.05, 100.0  # metres; depths outside are no measurement
_FOCAL = 500.0  # of the common camera that OpenCV's thresholds are in pixels of
_TOLERANCE = 0.3  # of the search for an essential matrix, in noises
_CONFIDENCE, _SAMPLES = 0.99, 1000
_FARTHEST = 1000.0  # ways between the views; a point beyond says nothing of which side is ahead
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

    def inverse(self) -> "RelativePose":
        """The match's camera in the frame of the query's; of a metric pose."""
        back, covariance = inverse(self.matrix), inverted(self.covariance, self.matrix)
        return replace(self, rotation=back[:3, :3], translation=back[:3, 3], covariance=covariance)


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
    rays = query.rays(check.query), match.rays(check.reference)
    here, there = (_known(check, depth) for depth in (query_depth, match_depth))
    sight = _Sight(*rays, here, there, _NOISE / query.fx, _NOISE / match.fx)
    return _metric(sight, scale_error) or _direction(check, query, match)


def pose_by_way(
    check: EpipolarCheck,
    beside: EpipolarCheck,
    query: Intrinsics,
    match: Intrinsics,
    other: Intrinsics,
    metres: float,
    way_error: float,
) -> RelativePose | None:
    """The metric pose where only the length of the way from the query to a view `beside` it is known.

    `beside` holds matches of the same query with that view, whose camera is `other`; points that both views share give
    the ratio of the two ways. `way_error` is relative. None where it cannot be told.
    """
    if not metres > 0:
        return None
    pair, short = _Matched.of(check, query, match), _Matched.of(beside, query, other)
    found = [(one.pose, two.pose, ratio) for one, two in _halves(pair, short) if (ratio := _ratio(one, two)) > 0]
    if len(found) < _HALVES - _MOST_FAILED:
        return None
    mean, away = _spread([pose for pose, *_ in found])
    beside_away = _spread([pose for _, pose, _ in found])[1]  # random where the robot stood, whatever its wheels say
    logs = np.log([ratio for *_, ratio in found])
    length = metres * float(np.exp(np.median(logs)))
    covariance = _covariance(np.column_stack([away, logs - np.median(logs)]), pair.noise)
    covariance[5, 5] += way_error**2
    doubts = _doubt(covariance), _doubt(_covariance(beside_away, short.noise)), float(np.sqrt(covariance[5, 5]))
    if max(doubts) > _LARGEST_DOUBT:
        return None
    jacobian = np.zeros((6, 6))
    jacobian[:3, :2], jacobian[:3, 5], jacobian[3:, 2:5] = length * _across(mean[1]).T, length * mean[1], np.eye(3)
    shared = int(np.isin(pair.points, short.points).sum())
    return RelativePose(mean[0], length * mean[1], True, shared, jacobian @ covariance @ jacobian.T)


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
        solved = _solved(sight[agree], pose) if (agree & known).sum() >= _LEAST else None
        if solved is None:
            return None
        pose, covariance, scale = solved
        bound = _AGREEING * np.array([scale[sight.kind[agree] == one].max(initial=0) for one in range(3)])[sight.kind]
    return pose, covariance, int((agree & known).sum())


@dataclass(frozen=True, eq=False)
class _Matched:
    """Distinct matches of two images: rays (M, 2) of both, which point of the first image each is of, the noise."""

    a: Array
    b: Array
    points: NDArray[np.int64]
    noise: float

    @classmethod
    def of(cls, check: EpipolarCheck, query: Intrinsics, match: Intrinsics) -> "_Matched":
        distinct = np.ones(len(check.query), bool) if check.distinct is None else check.distinct
        at, to = check.query[distinct], check.reference[distinct]
        column, row = np.rint(np.asarray(at, np.float64).T * (1 << 20)).astype(np.int64)
        noise = _NOISE * (1 / query.fx + 1 / match.fx) / 2
        return cls(query.rays(at), match.rays(to), column * (1 << 30) + row, noise)

    def __getitem__(self, chosen: NDArray) -> "_Matched":
        return _Matched(self.a[chosen], self.b[chosen], self.points[chosen], self.noise)

    def solved(self) -> "_Solved | None":
        """The essential matrix that most matches agree on, by USAC with MAGSAC's scores (Barath et al., CVPR 2020)."""
        if len(self.a) < _LEAST_HALF:
            return None
        a, b = (np.ascontiguousarray(rays * _FOCAL) for rays in (self.a, self.b))
        camera, pixels = np.diag([_FOCAL, _FOCAL, 1.0]), _TOLERANCE * self.noise * _FOCAL
        essential, mask = cv2.findEssentialMat(a, b, camera, cv2.USAC_MAGSAC, _CONFIDENCE, pixels, _SAMPLES)
        if essential is None or essential.shape != (3, 3) or (agree := mask.ravel() > 0).sum() < _LEAST_SHARED:
            return None
        front = cv2.recoverPose(essential, a[agree], b[agree], camera, distanceThresh=_FARTHEST)
        agree[agree] = front[3].ravel() > 0
        return _Solved((front[1], front[2].ravel()), self[agree])


@dataclass(frozen=True, eq=False)
class _Solved:
    """A pose with a translation of length 1, and the matches that agree with it ahead of both cameras."""

    pose: Pose
    matched: _Matched

    def nearness(self) -> tuple[Array, Array]:
        """(M,) inverse depths in the first view, in 1 / the way; how far (M,) a unit of that moves a ray."""
        away, b, (rotation, t) = self.matched.a, self.matched.b, self.pose
        away = _points(away, 1.0) @ rotation.T
        u, v = away[:, :2] - b * away[:, 2:], b * t[2] - t[:2]  # u = nearness v, two equations in one unknown
        strength = np.maximum((v**2).sum(1), 1e-12)
        return (u * v).sum(1) / strength, np.sqrt(strength) / np.abs(away[:, 2])


def _halves(*sights: _Matched) -> Iterator[list[_Solved]]:
    """Every sight solved from the matches of one half of the points, for many halves; those that show nothing are not
    among them.

    How solutions of halves scatter is how far that of all is off (delete-half jackknife: Shao and Wu 1989). Unlike
    derivatives at one solution it knows of the others that fit nearly as well, as of flat and of far scenes.
    """
    rng, points = np.random.default_rng(0), np.unique(np.concatenate([sight.points for sight in sights]))
    for _ in range(_HALVES):
        half = rng.permutation(points)[: (len(points) + 1) // 2]
        solved = [sight[np.isin(sight.points, half)].solved() for sight in sights]
        if (found := [one for one in solved if one is not None]) and len(found) == len(sights):
            yield found


def _spread(poses: list[Pose]) -> tuple[Pose, Array]:
    """The mean of poses with translations of length 1, and how far they are from it, (n, 5): two radians across the
    direction, three of rotation.
    """
    u, _, vt = np.linalg.svd(np.mean([rotation for rotation, _ in poses], axis=0))
    rotation, towards = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt, np.array([t for _, t in poses])
    direction = towards.mean(0) / max(float(np.linalg.norm(towards.mean(0))), 1e-9)
    side = towards @ _across(direction).T
    sine = np.maximum(np.linalg.norm(side, axis=1), 1e-9)
    side *= (np.arctan2(sine, towards @ direction) / sine)[:, None]
    return (rotation, direction), np.hstack([side, [logarithm(r @ rotation.T) for r, _ in poses]])


def _covariance(away: Array, noise: float) -> Array:
    """Of n deviations (n, d), rotation third to fifth; divided by what makes the mean of its inverse right (Wishart).

    What all points of both images may be off together does not scatter, and turns the view.
    """
    n, d = away.shape
    turned = np.isin(np.arange(d), (2, 3, 4)) * 2 * (_LEAST_NOISE / _NOISE * noise) ** 2
    return away.T @ away / (n - d - 1) + np.diag(turned)


def _doubt(covariance: Array) -> float:
    """The largest deviation of a direction, radians."""
    return float(np.sqrt(np.linalg.eigvalsh(covariance[:2, :2])[-1]))


def _direction(check: EpipolarCheck, query: Intrinsics, match: Intrinsics) -> RelativePose | None:
    """Rotation and direction of motion: the mean of what halves of the matches say, and how they scatter."""
    matched = _Matched.of(check, query, match)
    found = [solved for (solved,) in _halves(matched)]
    if len(found) < _HALVES - _MOST_FAILED:
        return None
    pose, away = _spread([solved.pose for solved in found])
    inner, inliers = _covariance(away, matched.noise), 2 * int(np.median([len(solved.matched.a) for solved in found]))
    if _doubt(inner) > _LARGEST_DOUBT:
        covariance = np.eye(6)
        covariance[3:, 3:] = inner[2:, 2:]
        return RelativePose(pose[0], np.zeros(3), False, inliers, covariance)
    jacobian = np.zeros((6, 5))
    jacobian[:3, :2], jacobian[3:, 2:] = _across(pose[1]).T, np.eye(3)
    return RelativePose(*pose, False, inliers, jacobian @ inner @ jacobian.T)


def _ratio(pair: _Solved, short: _Solved) -> float:
    """How many times as long the way of `pair` is as that of `short`, by the points of both; 0 where it is not told.

    The points lie about a line through the origin, by their parallax in one and in the other; both are measured, so the
    line is the median of their angles, by length.
    """
    _, one, two = np.intersect1d(pair.matched.points, short.matched.points, return_indices=True)
    if len(one) < _LEAST_SHARED:
        return 0.0
    (y, gain_y), (x, gain_x) = (solved.nearness() for solved in (pair, short))
    scale_y, scale_x = np.median(gain_y[one]), np.median(gain_x[two])
    moved = np.column_stack([np.maximum(x[two], 0) * scale_x, np.maximum(y[one], 0) * scale_y])
    angle, length = np.arctan2(moved[:, 1], moved[:, 0]), np.linalg.norm(moved, axis=1)
    order = np.argsort(angle)
    total = np.cumsum(length[order])
    middle = angle[order][np.searchsorted(total, total[-1] / 2)]
    return float(np.tan(middle) * scale_x / scale_y) if 0 < middle < 1.57 else 0.0


def _moved(pose: Pose, step: Array) -> Pose:
    """A step (6,): metres, radians."""
    return exponential(step[3:]) @ pose[0], pose[1] + step[:3]


def _across(direction: Array) -> Array:
    """(2, 3): two unit vectors across a unit vector, the same for the same one."""
    return np.linalg.svd(direction[None])[2][1:]


def _solved(sight: _Sight, pose: Pose) -> tuple[Pose, Array, Array] | None:
    """Gauss-Newton on the Cauchy loss: the pose, the covariance (6, 6) of a step that `_moved` takes, and the noise
    (M,) of each match.

    Each kind of match has its own noise, estimated from its residuals. None where the points do not determine it.
    """
    kind = sight.kind
    for _ in range(_ITERATIONS):
        residual = sight.residuals(*pose)
        scale = _scales(residual, kind)
        weight = 1 / (1 + (np.linalg.norm(residual, axis=1) / scale / _CAUCHY) ** 2)
        jacobian = _jacobian(sight, pose) / scale[:, None, None]
        normal = np.einsum("m,mij,mik->jk", weight, jacobian, jacobian)
        if not np.isfinite(normal).all() or np.linalg.cond(normal) > 1e12:
            return None
        step = -np.linalg.solve(normal, np.einsum("m,mij,mi->j", weight, jacobian, residual / scale[:, None]))
        if np.abs(step).max() < _STILL:
            break
        pose = _moved(pose, step)
    covariance = np.linalg.inv(normal)
    shared = np.einsum("m,mij,mik->jk", weight, jacobian, sight.of_shared(pose) / scale[:, None, None])
    carried = covariance @ shared
    return pose, covariance + carried @ carried.T, scale


def _jacobian(sight: _Sight, pose: Pose) -> Array:
    """(M, 2, 6), by central differences."""
    h = 1e-6
    sides = [[sight.residuals(*_moved(pose, sign * h * step)) for sign in (1, -1)] for step in np.eye(6)]
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
