"""Relative poses of closures, with the scale that depth, stereo or odometry gives, or none."""

import math
from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pnv_core.decide.odometry import Odometry
from pnv_core.pose.geometry import (
    Intrinsics,
    RelativePose,
    depth_at,
    pose_by_way,
    relative_pose,
    triangulated,
)
from pnv_core.pose.keyframe_geometry import KeyframeGeometry
from pnv_core.recognizer import PlaceRecognizer
from pnv_core.rotations import OPTICAL_IN_BODY, inverse, matrix_of, rigid, transported
from pnv_core.types import Frame, ImageRef, LoopClosure
from pnv_core.verify.verifier import EpipolarCheck

Array = NDArray[np.float64]

_LEAST_WAY_M = 0.05  # of shorter ones odometry knows little
_LONGEST_WAY_M = 5.0
_BEST_WAY_M = 0.4  # parallax enough at the distances of a room and of a street, and nearly the same sight
_WAY_ERROR = 0.1  # of the way between two views as odometry has it
_STEREO_ERROR = 0.01
_TOGETHER_NS = 10_000_000  # both images of a stereo pair
_FIRST = 10
_RECENT = 16  # views before the query


@dataclass(frozen=True, eq=False)
class _View:
    """An image that can be matched: what the verifier kept of it, and what is known for poses."""

    camera: str
    stamp_ns: int
    kept: bytes
    known: KeyframeGeometry


@dataclass(frozen=True, eq=False)
class Fix:
    """Where the robot's base is in the frame of the map's poses: (4, 4), and covariance (6, 6) as ROS has it.

    The covariance is that of the sight; that of the map's own poses is not known.
    """

    stamp_ns: int
    pose: Array
    covariance: Array


class RelativePoses:
    """Poses from what a recogniser keeps of its images; what poses need is kept with every keyframe from then on.

    `cameras` holds the intrinsics of every calibrated camera. `mounts` (4, 4) says where a camera's optical frame is on
    the robot; else it looks ahead from the base. `baselines` is how far right of the left camera of a stereo pair a
    camera is, metres. `track` holds poses in one frame for all sessions where a driver has them, as from a SLAM.
    """

    def __init__(self, recognizer: PlaceRecognizer, cameras: dict[str, Intrinsics] | None = None) -> None:
        self._recognizer = recognizer
        self.cameras = cameras if cameras is not None else {}
        self.mounts: dict[str, Array] = {}
        self.baselines: dict[str, float] = {}
        self.track: Odometry | None = None
        self._recent: deque[_View] = deque(maxlen=_RECENT)
        self._last: tuple[tuple[ImageRef, ImageRef], RelativePose | None] | None = None
        recognizer.geometry_of = self._keep

    def estimate(self, closure: LoopClosure) -> RelativePose | None:
        """The query's camera in the frame of the match's; metric where a scale is known, never by a guess.

        None for an uncalibrated camera, images of which the verifier kept nothing, and where too few points agree.
        """
        key = closure.query, closure.match
        if self._last is None or self._last[0] != key:
            self._last = key, self._estimated(closure)
        return self._last[1]

    def _estimated(self, closure: LoopClosure) -> RelativePose | None:
        query, match = self._view(closure.query), self._view(closure.match)
        if query is None or match is None or query.known.camera is None or match.known.camera is None:
            return None
        check = self._check(query, match)
        cameras = query.known.camera, match.known.camera
        here, there = query.known.depth_near(check.query), match.known.depth_near(check.reference)
        found = relative_pose(check, *cameras, here, there)
        if found is None or found.metric:
            return found
        for view, others in (
            (query, self._beside_query(closure.query, query)),
            (match, self._beside(closure.match, match)),
        ):
            for other in others:
                if found.translation.any() or _stereo(view, other):
                    metric = self._scaled(check, query, match, view, other)
                    if metric is not None:
                        return metric
        return found

    def _scaled(
        self, check: EpipolarCheck, query: _View, match: _View, view: _View, other: _View
    ) -> RelativePose | None:
        """The pose with the scale by another view beside one of the two; None where that tells none."""
        assert query.known.camera is not None
        assert match.known.camera is not None
        assert other.known.camera is not None
        beside, cameras = self._check(view, other), (query.known.camera, match.known.camera)
        if _stereo(view, other):
            depth = self._stereo_depth(view, other, beside, check.query if view is query else check.reference)
            here, there = (depth, None) if view is query else (None, depth)
            metric = relative_pose(check, *cameras, here, there, _STEREO_ERROR)
            return metric if metric is not None and metric.metric else None
        way = _way(view, other)
        if view is query:
            return pose_by_way(check, beside, *cameras, other.known.camera, way, _WAY_ERROR)
        back = pose_by_way(check.swapped(), beside, *cameras[::-1], other.known.camera, way, _WAY_ERROR)
        return None if back is None else back.inverse()

    def fix(self, closure: LoopClosure, pose: RelativePose) -> Fix | None:
        """The robot in the map by a metric pose; None where the keyframe has no pose in the map's frame.

        Poses of odometry count for the first session that has any: every later one began elsewhere.
        """
        known = KeyframeGeometry.decode(self._recognizer.database.geometry(closure.match.id))
        if not pose.metric or known.pose is None or not (known.shared or closure.match.session == self._first_posed()):
            return None
        base = inverse(self._mount(closure.query.camera))
        covariance = transported(pose.covariance, pose.matrix, known.pose, base)
        return Fix(closure.query.stamp_ns, known.pose @ pose.matrix @ base, covariance)

    def _first_posed(self) -> int:
        database, first = self._recognizer.database, dict[int, list[int]]()
        for ref in database.refs():
            first.setdefault(ref.session, []).append(ref.id)
        for session, ids in sorted(first.items()):  # odometry may begin some keyframes late
            if any(KeyframeGeometry.decode(database.geometry(i)).pose is not None for i in ids[:_FIRST]):
                return session
        return -1

    def _mount(self, camera: str) -> Array:
        return self.mounts.get(camera, OPTICAL_IN_BODY)

    def _keep(self, frame: Frame, kept: bytes) -> bytes:
        """What a keyframe keeps for poses; the view is remembered for those that come."""
        pose, shared = self._pose_at(frame.camera, frame.stamp_ns)
        points, depth = np.empty((0, 2), np.float32), np.empty(0, np.float32)
        if frame.depth is not None:  # at the points that the verifier finds: all match the image itself
            points = self._recognizer.judge.verifier.check(kept, frame.camera, kept, frame.camera).query
            depth = depth_at(frame.depth, points).astype(np.float32)
            points, depth = points[np.isfinite(depth)], depth[np.isfinite(depth)]
        camera, baseline = self.cameras.get(frame.camera), self.baselines.get(frame.camera, 0.0)
        encoded = KeyframeGeometry(camera, pose, shared, baseline, points, depth).encode()
        known = KeyframeGeometry.decode(encoded)  # with the precision that a map keeps
        self._recent.append(_View(frame.camera, frame.stamp_ns, kept, known))
        return encoded

    def _pose_at(self, camera: str, stamp_ns: int) -> tuple[Array | None, bool]:
        """The camera's pose (4, 4) at a stamp, and whether its frame is that of all sessions."""
        for track, shared in ((self.track, True), (self._recognizer.odometry, False)):
            at = track.at(stamp_ns) if track is not None else None
            if at is not None:
                return rigid(matrix_of(at.quaternion), at.xyz) @ self._mount(camera), shared
        return None, False

    def _view(self, ref: ImageRef) -> _View | None:
        for view in reversed(self._recent):
            if (view.stamp_ns, view.camera) == (ref.stamp_ns, ref.camera):
                return view
        database = self._recognizer.database
        kept = database.picture(ref.id)
        if not kept:
            return None
        known, now = KeyframeGeometry.decode(database.geometry(ref.id)), ref.session == database.session
        pose, shared = known.pose, known.shared
        if pose is None and now:
            pose, shared = self._pose_at(ref.camera, ref.stamp_ns)
        camera = known.camera or self.cameras.get(ref.camera)
        filled = KeyframeGeometry(camera, pose, shared, known.baseline_m, known.points, known.depth)
        return _View(ref.camera, ref.stamp_ns, kept, filled)

    def _check(self, one: _View, other: _View) -> EpipolarCheck:
        return self._recognizer.judge.verifier.check(one.kept, one.camera, other.kept, other.camera)

    def _beside_query(self, ref: ImageRef, view: _View) -> list[_View]:
        """Views that can give a query its depths, the best first."""
        if view in self._recent:
            return _useful(view, [other for other in reversed(self._recent) if other is not view])
        return self._beside(ref, view)

    def _beside(self, ref: ImageRef, view: _View) -> list[_View]:
        database = self._recognizer.database
        if ref.id not in database:
            return []
        near = [*database.neighbours(ref.id, 2)]
        near += [r for r in database.refs() if r.camera != ref.camera and abs(r.stamp_ns - ref.stamp_ns) < _TOGETHER_NS]
        return _useful(view, [other for r in near if (other := self._view(r)) is not None])

    def _stereo_depth(self, view: _View, other: _View, check: EpipolarCheck, points: NDArray) -> Array:
        """(M,) depths of a view's points by the other image of a stereo pair."""
        assert view.known.camera is not None
        assert other.known.camera is not None
        motion = rigid(np.eye(3), [view.known.baseline_m - other.known.baseline_m, 0.0, 0.0])
        depth = triangulated(check, view.known.camera, other.known.camera, motion)
        known = np.isfinite(depth)
        at = KeyframeGeometry(points=check.query[known], depth=depth[known].astype(np.float32))
        return at.depth_near(points)


def _stereo(one: _View, other: _View) -> bool:
    """Whether two images are those of a stereo pair; CameraInfo says how far apart its cameras are."""
    apart = one.camera != other.camera and one.known.baseline_m != other.known.baseline_m
    return apart and abs(one.stamp_ns - other.stamp_ns) < _TOGETHER_NS


def _way(one: _View, other: _View) -> float:
    if one.known.pose is None or other.known.pose is None or one.known.shared != other.known.shared:
        return math.nan
    return float(np.linalg.norm(one.known.pose[:3, 3] - other.known.pose[:3, 3]))


def _useful(view: _View, others: list[_View]) -> list[_View]:
    """The stereo partner, then the two views of the same camera whose way is nearest to a useful one."""
    calibrated = [other for other in others if other.known.camera is not None]
    stereo = [other for other in calibrated if _stereo(view, other)]
    moved = [
        other for other in calibrated
        if other.camera == view.camera and _LEAST_WAY_M <= _way(view, other) <= _LONGEST_WAY_M
    ]  # fmt: skip
    return [*stereo[:1], *sorted(moved, key=lambda other: abs(_way(view, other) - _BEST_WAY_M))[:2]]
