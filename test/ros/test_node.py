"""The node as other processes see it: life cycle, inputs, outputs, time, maps."""

import signal
import sys
import time
from contextlib import closing

import cv2
import numpy as np
import pytest
from lifecycle_msgs.msg import State, Transition
from nav_msgs.msg import Odometry
from rclpy.qos import QoSProfile, QoSReliabilityPolicy
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, PointCloud2
from std_msgs.msg import Float64MultiArray
from visualization_msgs.msg import MarkerArray

from msg_adapters.loop_closures import closures_from_message
from pnv_core.types import Reason
from pnv_ros.markers import MARKERS_QOS
from pnv_ros.outputs import CLOSURES_QOS
from test.ros.camera import EPOCH_S, Camera, Health, compressed, image, reliable, scene
from test.ros.controls import set_together, state, transition, trigger
from test.ros.processes import NODE, Listener, Process, executable, ros_arguments, running_node, wait_until
from test.ros.tables import rows_of

pytestmark = pytest.mark.process
EAGER = {"min_interval_s": 0.0, "min_change": 0.0, "consistency": 0} | reliable("camera/image_raw", "front", "rear")


def at(seconds, nanoseconds=0):
    return (EPOCH_S + seconds) * 10**9 + nanoseconds


def test_the_life_cycle_keeps_the_map_when_inactive_and_frees_it_on_clean_up(domain, listener):
    with running_node(autostart=False, ready="", **EAGER) as node:
        assert state(listener) == State.PRIMARY_STATE_UNCONFIGURED
        assert not transition(listener, Transition.TRANSITION_ACTIVATE)  # not from here
        assert set_together(listener, weights="/no/such/model").successful  # not running: anything may change
        assert not transition(listener, Transition.TRANSITION_CONFIGURE)
        node.wait_for("cannot be configured: weights '/no/such/model': no such file")
        assert state(listener) == State.PRIMARY_STATE_UNCONFIGURED
        assert trigger(listener, "reset").message.startswith("the node is not configured")

        assert set_together(listener, weights="default").successful
        assert transition(listener, Transition.TRANSITION_CONFIGURE)
        assert transition(listener, Transition.TRANSITION_ACTIVATE)
        health = Health(listener)
        camera = Camera(listener, health, "camera/image_raw")
        camera.send(image(scene(1), at(0)))
        assert health.count("keyframes") == 1
        assert transition(listener, Transition.TRANSITION_DEACTIVATE)
        assert state(listener) == State.PRIMARY_STATE_INACTIVE
        assert transition(listener, Transition.TRANSITION_ACTIVATE)
        assert trigger(listener, "reset").message == "forgot 1 keyframes"
        assert transition(listener, Transition.TRANSITION_DEACTIVATE)
        assert transition(listener, Transition.TRANSITION_CLEANUP)
        assert trigger(listener, "reset").message.startswith("the node is not configured")
        assert node.end() == 0
        assert "Traceback" not in node.output


@pytest.mark.parametrize(
    ("parameters", "words"),
    [
        ({"accept_score": 1.5}, "accept_score"),
        ({"image_topics": ["a", "a"]}, "allowed: one or more different topic names"),
        ({"image_topics": ["bad topic"]}, "image_topics names 'bad topic'"),
        ({"memory_budget_mb": 1, "image_width": 1280, "image_height": 960, "patch_precision": "float32"},
         "holds no keyframe"),
    ],
)  # fmt: skip
def test_a_start_with_unusable_settings_ends_with_status_2_and_one_line(domain, parameters, words):
    process = Process(executable(), *ros_arguments(**parameters))
    assert process.wait() == 2
    assert words in process.output
    assert "Traceback" not in process.output


def test_a_place_seen_again_is_closed_shown_and_told_to_every_listener(domain, listener):
    """Two cameras, two message types, one database; stamps that repeat and go back; every output at once."""
    health = Health(listener)
    tables = listener.collect(PointCloud2, f"{NODE}/candidates")
    pictures = listener.collect(Image, f"{NODE}/match_image")
    markers = listener.collect(MarkerArray, f"{NODE}/markers", MARKERS_QOS)
    pairs = listener.collect(Float64MultiArray, f"{NODE}/lio_sam")
    with running_node(image_topics=["front", "rear"], accept_score=0.0, **EAGER) as node:
        rear = Camera(listener, health, "rear", CompressedImage)
        node.wait_for("now listening to /rear (CompressedImage")
        front = Camera(listener, health, "front")
        for place in range(3):
            front.send(image(scene(place), at(place, 7)))
        front.send(image(scene(9), at(2, 7)))
        node.wait_for("1700000002.000000007 of front repeats; such frames are skipped")
        front.send(image(scene(9), at(-100)))
        node.wait_for("stamps of front went back by 102.000 s")
        rear.send(compressed(scene(1), at(60, 999_999_999)))
        late = listener.collect(Float64MultiArray, "/loop_closures", CLOSURES_QOS)  # transient local

        closure = closures_from_message(wait_until(lambda: late, 60, "the closure")[0], ["front", "rear"])[0]
        assert (closure.query.stamp_ns, closure.query.camera) == (at(60, 999_999_999), "rear")
        assert (closure.match.stamp_ns, closure.match.camera) == (at(1, 7), "front")
        assert np.allclose(wait_until(lambda: pairs, 60, "lio_sam")[0].data, [EPOCH_S + 61.0, EPOCH_S + 1.0])
        best = rows_of(wait_until(lambda: tables, 60, "candidates")[0])[0]
        assert (best["query_camera"], best["match_camera"], best["accepted"]) == (1, 0, 1)
        picture = wait_until(lambda: pictures, 60, "match image")[0]
        assert picture.encoding == "rgb8"
        assert np.asarray(picture.data).std() > 20
        newest = wait_until(lambda: markers and markers[-1].markers[1].points and markers[-1], 60, "markers")
        assert len(newest.markers[0].points) == 4
        assert health.count("keyframes") == 4
        assert health.count("dropped: stamp_repeated") == health.count("dropped: stamp_back") == 1
        assert node.output.count("repeats; such frames") == 1
        assert node.end(signal.SIGTERM) == 0


def test_a_bag_in_a_loop_closes_against_its_own_first_run(domain, listener):
    health = Health(listener)
    closures = listener.collect(Float64MultiArray, "/loop_closures", CLOSURES_QOS)
    with running_node(on_stamp_back="new_session", accept_score=0.0, use_sim_time=True, **EAGER) as node:
        camera = Camera(listener, health, "camera/image_raw")
        for place in (1, 2, 1):
            camera.send(image(scene(place), at(place if place != 1 or not closures else 1)))
            if place == 2:
                camera.send(image(scene(2), at(1, 5 * 10**8)))  # late by half a second: skipped, no new run
        node.wait_for("went back by 1.000 s to 1700000001.000000000: a new session begins")
        first = closures_from_message(wait_until(lambda: closures, 60, "a closure")[0])[0]
        assert (first.query.stamp_ns, first.match.stamp_ns, first.query.id) == (at(1), at(1), 2)
        assert node.end() == 0


def test_a_node_restarted_with_its_map_recognises_yesterdays_places(domain, listener, tmp_path):
    health, map_path = Health(listener), tmp_path / "map"
    closures = listener.collect(Float64MultiArray, "/loop_closures", CLOSURES_QOS)
    keep = {"map_path": map_path, "autosave": True, "load_on_start": True, "accept_score": 0.0} | EAGER
    with running_node(**keep) as node:
        node.wait_for(f"no map at {map_path} yet")
        camera = Camera(listener, health, "camera/image_raw")
        for place in (1, 2, 3):
            camera.send(image(scene(place), at(place)))
        assert trigger(listener, "save").message.startswith(f"saved {map_path}: 3 keyframes")
        camera.send(image(scene(4), at(4)))
        assert node.end(signal.SIGTERM) == 0
        assert "autosaved" in node.output
        assert not closures
    with running_node(**keep) as node:
        node.wait_for("loaded 4 keyframes")
        again = Camera(listener, Health(listener), "camera/image_raw")
        again.send(image(scene(4), at(90_000)))
        found = closures_from_message(wait_until(lambda: closures, 60, "a closure")[0])[0]
        assert (found.match.stamp_ns, found.match.id, found.query.id) == (at(4), 3, 4)
        assert trigger(listener, "load").success  # back to what was saved
        node.child.send_signal(signal.SIGKILL)
        node.wait()
    with running_node(**keep | {"localization": True, "autosave": False}) as node:
        node.wait_for("loaded 4 keyframes")
        closures.clear()
        with closing(Listener()) as fresh:  # it does not take the node that was killed for this one
            health = Health(fresh)
            Camera(fresh, health, "camera/image_raw").send(image(scene(2), at(190_000)))
            found = closures_from_message(wait_until(lambda: closures, 60, "a closure")[0])[0]
            assert (found.match.stamp_ns, found.query.id) == (at(2), -1)
            assert health.count("keyframes") == 4
        assert node.end() == 0
    ignored = Process(executable(), *ros_arguments(map_path=map_path, autosave=True))
    assert ignored.wait() == 2
    assert "holds a map that is not loaded and would not be overwritten; allowed: load_on_start" in ignored.output


def test_an_incompatible_publisher_is_reported_with_both_profiles_and_the_remedy(domain, listener):
    override = "qos_overrides./camera/image_raw.subscription.reliability"
    with running_node(**{override: "reliable"}) as node:
        best_effort = QoSProfile(depth=1, reliability=QoSReliabilityPolicy.BEST_EFFORT)
        listener.node.create_publisher(Image, "/camera/image_raw", best_effort)
        line = node.wait_for("no images from listener on /camera/image_raw")
        assert "it offers best effort, volatile, this node asks for reliable, volatile" in line
        assert line.endswith(f"set {override} to best effort")
        assert node.end() == 0


def test_mask_crop_and_camera_info_shape_what_is_looked_at(domain, listener, tmp_path):
    mask = np.full((240, 320), 255, np.uint8)
    mask[200:] = 0
    cv2.imwrite(str(tmp_path / "mask.png"), mask)
    health = Health(listener)
    with running_node(masks=[tmp_path / "mask.png"], crop=[8, 0, 8, 0], camera_info_topics=["camera_info"],
                      **EAGER) as node:  # fmt: skip
        camera = Camera(listener, health, "camera/image_raw")
        camera.send(image(scene(1), at(0)))
        node.wait_for("frames of camera/image_raw wait for its camera info")
        infos = listener.node.create_publisher(CameraInfo, "camera_info", 1)
        k = [300.0, 0.0, 160.0, 0.0, 300.0, 120.0, 0.0, 0.0, 1.0]
        d = [-0.2, 0.05, 0.0, 0.0, 0.0]
        info = CameraInfo(width=320, height=240, distortion_model="plumb_bob", d=d, k=k)
        node.wait_for("images of camera/image_raw are rectified as 320x240", meanwhile=lambda: infos.publish(info))
        camera.send(image(scene(1), at(1)))
        assert health.count("frames processed") == 1
        camera.send(image(scene(1, 160, 120), at(2)))
        node.wait_for("image is 160x120; allowed by its camera info: 320x240")
        assert health.fresh().level == b"\x01"
        assert node.end() == 0


def test_odometry_rules_out_a_closure_and_places_the_keyframes(domain, listener):
    health = Health(listener)
    tables = listener.collect(PointCloud2, f"{NODE}/candidates")
    markers = listener.collect(MarkerArray, f"{NODE}/markers", MARKERS_QOS)
    with running_node(odometry_topic="odom", accept_score=0.0, **EAGER) as node:
        camera = Camera(listener, health, "camera/image_raw")
        odometry = listener.node.create_publisher(Odometry, "odom", 10)
        wait_until(odometry.get_subscription_count, 60, "odometry")
        listener.met_by(NODE)
        for seconds, x in ((0, 0.0), (60, 10_000.0)):
            sample = Odometry()
            sample.header.stamp.sec, sample.header.frame_id, sample.pose.pose.position.x = EPOCH_S + seconds, "odom", x
            for _ in range(20):  # best effort may lose one
                odometry.publish(sample)
                time.sleep(0.1)
            camera.send(image(scene(1), at(seconds)))
        best = rows_of(wait_until(lambda: tables, 60, "candidates")[0])[0]
        assert (best["accepted"], best["reason"]) == (0, list(Reason).index(Reason.ODOMETRY))
        newest = wait_until(lambda: markers and len(markers[-1].markers[0].points) == 2 and markers[-1], 60, "markers")
        assert [p.x for p in newest.markers[0].points] == [0.0, 10_000.0]
        assert newest.markers[0].header.frame_id == "odom"
        assert node.end() == 0


@pytest.mark.parametrize("half", ["look", "recognise"])
def test_a_worker_that_fails_ends_the_process_with_its_traceback(domain, listener, half):
    broken = (
        "import sys; from pnv_core.recognizer import PlaceRecognizer; "
        f"PlaceRecognizer.{half} = lambda *_: 1 / 0; "
        "from pnv_ros.place_recognizer import main; sys.exit(main())"
    )
    node = Process(sys.executable, "-c", broken, *ros_arguments(**EAGER))
    node.wait_for("publishes")
    health = Health(listener)
    Camera(listener, health, "camera/image_raw").send(image(scene(1), at(1)), wait=False)
    assert node.wait() == 1
    assert "ZeroDivisionError: division by zero" in node.output
    assert "Traceback" in node.output
    wait_until(lambda: health.status.level == b"\x02", 60, "the last word on /diagnostics")


def test_two_nodes_with_namespaces_do_not_hear_each_other(domain, listener):
    with running_node("-r", "__ns:=/a", accept_score=0.0, **EAGER) as one:
        with running_node("-r", "__ns:=/b", accept_score=0.0, **EAGER) as two:
            heard = {n: listener.collect(Float64MultiArray, f"/{n}/loop_closures", CLOSURES_QOS) for n in "ab"}
            camera = Camera(listener, Health(listener, "/a/place_recognizer"), "/a/camera/image_raw")
            for seconds in (0, 60):
                camera.send(image(scene(1), at(seconds)))
            wait_until(lambda: heard["a"], 60, "a closure")
            time.sleep(0.5)
            assert not heard["b"]
            assert two.end() == 0
        assert one.end() == 0
