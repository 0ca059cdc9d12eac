"""Where keyframes stand in ~/markers, by themselves."""

from pnv_core.decide.odometry import Odometry
from pnv_core.types import ImageRef
from pnv_ros.markers import Placing, map_markers, timeline

SECOND = 10**9


def test_a_keyframe_stands_at_the_pose_nearest_in_time_and_stays_there():
    track = Odometry()
    markers = Placing(track)
    for seconds in range(10):
        track.add(seconds * SECOND, float(seconds), 0.0, 0.0)
    refs = [ImageRef(0, 3 * SECOND + 400_000_000, "front"), ImageRef(1, 20 * SECOND, "front")]
    assert markers.place(refs) == {0: (3.0, 0.0, 0.0)}  # nothing is known of the second one
    for seconds in range(10, 30_000):
        track.add(seconds * SECOND, float(seconds), 0.0, 0.0)
    assert markers.place(refs[:1]) == {0: (3.0, 0.0, 0.0)}  # long after its poses were forgotten
    assert markers.place([]) == {}


def test_without_poses_keyframes_stand_on_a_time_line_per_camera_and_session():
    refs = [
        ImageRef(0, 100 * SECOND, "front", 0),
        ImageRef(1, 110 * SECOND, "front", 0),
        ImageRef(2, 110 * SECOND, "rear", 0),
        ImageRef(3, 5 * SECOND, "front", 1),
    ]
    assert timeline(refs) == {0: (0.0, 0.0, 0.0), 1: (1.0, 0.0, 0.0), 2: (1.0, 1.0, 0.0), 3: (0.0, 2.0, 0.0)}


def test_closures_are_lines_between_placed_keyframes_coloured_by_score():
    placed = {0: (0.0, 0.0, 0.0), 1: (4.0, 0.0, 0.0)}
    keyframes, lines = map_markers(placed, [(1, 0, 0.75), (9, 0, 1.0)], "map", arcs=False).markers
    assert [(p.x, p.y, p.z) for p in keyframes.points] == [(0.0, 0.0, 0.0), (4.0, 0.0, 0.0)]
    assert [(p.x, p.z) for p in lines.points] == [(4.0, 0.0), (0.0, 0.0)]  # the evicted one is not drawn
    assert (lines.colors[0].r, lines.colors[0].g) == (0.25, 0.75)
    arc = map_markers(placed, [(1, 0, 0.75)], "map", arcs=True).markers[1]
    assert max(p.z for p in arc.points) == 1.0
