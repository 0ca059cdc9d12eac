"""What keyframes keep for poses, through a map and back; a verifier that knows the scene gives exact matches."""

import json
from types import SimpleNamespace

import numpy as np
import pytest

from pnv_core.database import KeyframeDatabase
from pnv_core.decide.odometry import Odometry
from pnv_core.maps import MapStore
from pnv_core.pose.geometry import Intrinsics
from pnv_core.pose.keyframe_geometry import KeyframeGeometry
from pnv_core.pose.relative_poses import RelativePoses
from pnv_core.rotations import OPTICAL_IN_BODY, exponential, inverse, mount_of, quaternion_of, rigid
from pnv_core.types import Frame, ImageRef, LoopClosure
from pnv_core.verify.verifier import EpipolarCheck
from test.database.synthetic import place

RNG = np.random.default_rng(5)
SCENE = np.column_stack([RNG.uniform(4, 9, 120), RNG.uniform(-3, 3, 120), RNG.uniform(-1.5, 2.5, 120)])  # ahead of x
LEFT = Intrinsics.of_pixels(500.0, 500.0, 319.5, 239.5, 640)
WIDE = Intrinsics.of_pixels(350.0, 360.0, 300.0, 250.0, 640)
CAMERAS = {"left": LEFT, "right": LEFT, "wide": WIDE}
SECOND = 10**9


class Exact:
    """A verifier that keeps the pose of an image and sees every point of the scene, a tenth of a pixel off."""

    def check(self, query, query_camera, reference, reference_camera):
        a, b = self._seen(query, query_camera), self._seen(reference, reference_camera)
        return EpipolarCheck(a, b, np.ones(len(a), bool), 0.5)

    @staticmethod
    def _seen(kept, camera):
        pose, c = np.array(json.loads(kept)), CAMERAS[camera]
        points = SCENE @ inverse(pose)[:3, :3].T + inverse(pose)[:3, 3]
        image = points[:, :2] / points[:, 2:] * (c.fx, c.fy) + (c.cx, c.cy)
        noise = np.random.default_rng(len(kept)).normal(0, 0.1 / 640, image.shape)
        return (image + noise).astype(np.float32)


def base(x, y=0.0, yaw=0.0):
    return rigid(exponential(np.array([0, 0, yaw])), [x, y, 0.0])


class Robot:
    """The parts of a recogniser that poses ask, and frames as the recogniser hands them on."""

    def __init__(self, mount=None, calibrated=True):
        self.mount = OPTICAL_IN_BODY if mount is None else mount
        self.database = KeyframeDatabase(16, memory_budget_mb=10.0)
        judge = SimpleNamespace(verifier=Exact())
        self.recognizer = SimpleNamespace(database=self.database, odometry=Odometry(), judge=judge, geometry_of=None)
        self.poses = RelativePoses(self.recognizer, dict(CAMERAS) if calibrated else {})
        self.poses.mounts = dict.fromkeys(CAMERAS, self.mount)

    def sees(self, seconds, where, camera="left", odometry=False, depth=False, beside=0.0):
        """A query from `where` (4, 4) of the base; `beside` metres to the right of it for a stereo pair's right."""
        optical = where @ self.mount @ rigid(np.eye(3), [beside, 0, 0])
        if odometry:
            self.recognizer.odometry.add(seconds * SECOND, *where[:3, 3], quaternion_of(where[:3, :3]))
        self.kept = json.dumps(optical.tolist()).encode()
        frame = Frame(seconds * SECOND, camera, np.zeros((480, 640, 3), np.uint8))
        if depth:
            image = np.zeros((480, 640), np.float32)
            points = SCENE @ inverse(optical)[:3, :3].T + inverse(optical)[:3, 3]
            column, row = (Exact._seen(self.kept, camera) * 640).astype(int).T
            inside = (column >= 0) & (column < 640) & (row >= 0) & (row < 480)
            image[row[inside], column[inside]] = points[inside, 2]
            frame = Frame(frame.stamp_ns, camera, frame.rgb, depth=image)
        self.geometry = self.recognizer.geometry_of(frame, self.kept)
        return ImageRef(-1, frame.stamp_ns, camera, self.database.session)

    def takes(self, *args, **options):
        """The same as a keyframe."""
        ref = self.sees(*args, **options)
        seen = place(np.random.default_rng(ref.stamp_ns // SECOND))
        kept = type(seen)(seen.global_vector, seen.patches, seen.texture, self.kept, self.geometry)
        return self.database.add(ref.stamp_ns, ref.camera, kept)

    def saved(self, folder):
        MapStore(folder, "f" * 16).save(self.database.snapshot())

    def loads(self, folder):
        MapStore(folder, "f" * 16).load(self.database)
        self.database.read_only = True
        return self


def closure(query, match):
    return LoopClosure(query, match, 0.9, 0.8, 0.5, 40, True)


def off(pose, truth):
    """Metres between a relative pose and the truth."""
    return np.linalg.norm(pose.translation - truth[:3, 3])


HERE, THERE = base(0.3, 0.2, 0.1), base(0.0)
TRUTH = inverse(THERE @ OPTICAL_IN_BODY) @ HERE @ OPTICAL_IN_BODY


@pytest.mark.parametrize("camera", ["left", "wide"])
def test_a_keyframe_keeps_its_depth_through_a_map_for_a_query_of_any_camera(tmp_path, camera):
    maker = Robot()
    match = maker.takes(1, THERE, depth=True)
    assert len(maker.geometry) < 1000  # bytes, for 120 points
    maker.saved(tmp_path / "map")
    finder = Robot().loads(tmp_path / "map")
    pose = finder.poses.estimate(closure(finder.sees(2, HERE, camera), match))
    assert pose.metric
    assert off(pose, TRUTH) < 0.01
    assert np.allclose(pose.rotation, TRUTH[:3, :3], atol=0.002)


def test_a_map_without_depth_gives_no_scale_until_the_query_has_one(tmp_path):
    maker = Robot()
    match = maker.takes(1, THERE)
    maker.saved(tmp_path / "map")
    finder = Robot().loads(tmp_path / "map")
    without = finder.poses.estimate(closure(finder.sees(2, HERE), match))
    assert not without.metric
    assert without.translation @ TRUTH[:3, 3] > 0.99 * np.linalg.norm(TRUTH[:3, 3])
    within = finder.poses.estimate(closure(finder.sees(3, HERE, depth=True), match))
    assert within.metric
    assert off(within, TRUTH) < 0.01


def test_a_keyframe_saved_before_there_was_geometry_is_one_without(tmp_path):
    maker = Robot(calibrated=False)
    match = maker.takes(1, THERE)
    assert maker.geometry == b""
    maker.saved(tmp_path / "map")
    finder = Robot().loads(tmp_path / "map")
    assert finder.database.picture(match.id) == maker.kept
    assert not finder.poses.estimate(closure(finder.sees(2, HERE), match)).metric  # by the query's own intrinsics
    assert Robot(calibrated=False).loads(tmp_path / "map").poses.estimate(closure(finder.sees(2, HERE), match)) is None


@pytest.mark.parametrize("side", ["query", "match"])
def test_the_way_of_odometry_gives_the_scale_of_either_side(tmp_path, side):
    maker = Robot()
    for seconds, x in ((1, -0.4), (2, 0.0), (3, 0.4)):
        match = maker.takes(seconds, base(x), odometry=side == "match")
        match = match if seconds == 2 else maker.database.ref(max(match.id - 1, 0))
    maker.saved(tmp_path / "map")
    finder = Robot().loads(tmp_path / "map")
    finder.sees(8, base(0.0, 0.2, 0.1), odometry=side == "query")
    pose = finder.poses.estimate(closure(finder.sees(10, HERE, odometry=side == "query"), match))
    assert pose.metric
    assert off(pose, TRUTH) < 0.05
    assert off(pose, TRUTH) < 4 * np.sqrt(np.trace(pose.covariance[:3, :3]))


def test_a_stereo_pair_gives_the_scale():
    robot = Robot()
    match = robot.takes(1, THERE)
    robot.poses.baselines["right"] = 0.2
    robot.sees(5, HERE, "right", beside=0.2)
    pose = robot.poses.estimate(closure(robot.sees(5, HERE, "left"), match))
    assert pose.metric
    assert off(pose, TRUTH) < 0.01


def test_a_fix_is_the_base_in_the_frame_of_the_map(tmp_path):
    mount = mount_of([0.3, -0.1, 0.5, 0.0, 0.2, -0.4])
    maker = Robot(mount)
    match = maker.takes(1, base(1.0, 0.5, 0.3), odometry=True, depth=True)
    maker.saved(tmp_path / "map")
    finder = Robot(OPTICAL_IN_BODY).loads(tmp_path / "map")  # another robot, whose camera sits elsewhere
    truth = base(1.2, 0.4, 0.1)
    seen = closure(finder.sees(9, truth), match)
    fix = finder.poses.fix(seen, finder.poses.estimate(seen))
    assert np.linalg.norm(fix.pose[:3, 3] - truth[:3, 3]) < 0.01
    assert np.allclose(fix.pose[:3, :3], truth[:3, :3], atol=0.003)
    assert (np.linalg.eigvalsh(fix.covariance) > 0).all()


def test_odometry_of_a_later_session_is_in_another_frame_and_gives_no_fix():
    robot = Robot()
    first = robot.takes(1, THERE, odometry=True, depth=True)
    robot.database.new_session()
    robot.recognizer.odometry.forget()
    second = robot.takes(100, THERE, odometry=True, depth=True)
    query = robot.sees(200, HERE)
    fixes = [robot.poses.fix(c, robot.poses.estimate(c)) for c in (closure(query, first), closure(query, second))]
    assert [fix is None for fix in fixes] == [False, True]


def test_damaged_geometry_says_nothing():
    robot = Robot()
    robot.takes(1, THERE, odometry=True, depth=True)
    whole = robot.geometry
    assert KeyframeGeometry.decode(whole).pose is not None
    for cut in range(0, len(whole), 7):
        known = KeyframeGeometry.decode(whole[:cut])
        assert (known.camera, known.pose, len(known.points)) == (None, None, 0)
    nan = whole[:6] + b"\xff" * 16 + whole[22:]
    assert KeyframeGeometry.decode(nan).camera is None
