"""Camera infos, stamps, parameters and parameter files that are not what they should be, on the real node."""

import subprocess
import time
from itertools import count

import pytest
import yaml
from rcl_interfaces.srv import GetParameters, ListParameters
from rclpy.parameter import parameter_value_to_python
from rclpy.qos import QoSDurabilityPolicy, QoSProfile, qos_profile_sensor_data
from sensor_msgs.msg import CameraInfo
from std_srvs.srv import SetBool

from pnv_ros.parameters import DECLARED
from test.ros.camera import Camera, Health, image, reliable, scene
from test.ros.processes import NODE, Listener, Process, executable, running_node, wait_until
from test.ros.test_faults import EAGER, at
from test.tally import tally

pytestmark = pytest.mark.process


def calibration(**changes):
    info = CameraInfo(width=320, height=240, distortion_model="plumb_bob", d=[-0.2, 0.0, 0.0, 0.0, 0.0])
    info.k = [300.0, 0.0, 160.0, 0.0, 300.0, 120.0, 0.0, 0.0, 1.0]
    for name, value in changes.items():
        setattr(info, name, value)
    return info


def warned(health, words, meanwhile=lambda: None):
    def said():
        meanwhile()
        status = health.status
        return status.level == b"\x01" and words in status.message and status.message

    return wait_until(said, 60, words)


def test_camera_infos_are_heard_checked_and_taken_anew_and_frames_without_one_are_a_warning(listener):
    with running_node(camera_info_topics=["camera_info"], **EAGER) as node:
        health = Health(listener)
        camera = Camera(listener, health, "camera/image_raw")
        camera.send(image(scene(1), at(1)))
        assert "waits for its camera info; nobody publishes camera_info" in warned(health, "none is used")
        infos = listener.node.create_publisher(CameraInfo, "camera_info", qos_profile_sensor_data)  # best effort

        def heard(info, words):  # a camera sends its info with every image
            node.wait_for(words, meanwhile=lambda: infos.publish(info))

        bad = calibration(k=[300.0, 0.0, 160.0, 0.0, 0.0, 120.0, 0.0, 0.0, 1.0])
        heard(bad, "camera info of camera/image_raw: camera info of 320x240 has focal lengths 300, 0")
        camera.send(image(scene(2), at(2)))
        assert health.count("dropped: no_camera_info") == 2
        heard(calibration(), "images of camera/image_raw are rectified as 320x240")
        heard(calibration(d=[-0.1, 0.0, 0.0, 0.0, 0.0]), "images of camera/image_raw are anew rectified as 320x240")
        camera.send(image(scene(3), at(3)))
        assert health.count("frames processed") == 1
        tally("4 camera infos heard by the node", 3, 3)
        assert node.end() == 0
        assert "Traceback" not in node.output


def test_a_camera_info_that_was_said_once_before_the_node_was_there_is_heard(listener):
    once = QoSProfile(depth=1, durability=QoSDurabilityPolicy.TRANSIENT_LOCAL)
    listener.node.create_publisher(CameraInfo, "camera_info", once).publish(calibration())
    with running_node(camera_info_topics=["camera_info"], **EAGER) as node:
        health = Health(listener)
        camera = Camera(listener, health, "camera/image_raw")
        seconds = count(1)

        def shows():  # until frames wait for their camera info, and are used
            camera.send(image(scene(1), at(next(seconds))))
            return health.count("frames processed")

        wait_until(shows, 60, "a frame in use")
        assert "images of camera/image_raw are rectified as 320x240" in node.output
        assert node.end() == 0


def test_diagnostics_say_why_none_of_the_frames_that_come_is_used(listener):
    with running_node(image_topics=["front", "rear"], no_image_warning_s=1000.0, **EAGER) as node:
        health = Health(listener)
        front, rear = (Camera(listener, health, topic) for topic in ("front", "rear"))
        front.send(image(scene(0), 2_145_916_800 * 10**9))  # 2038
        rear.send(image(scene(0), at(0)))
        seconds = count(1)

        def both():
            second = next(seconds)
            front.send(image(scene(second), at(second)), wait=False)
            rear.send(image(scene(second), at(second)), wait=False)
            time.sleep(1)

        assert "their stamps lie before 2145916800.000000000" in warned(health, "on front and none is used", both)
        last = next(seconds)

        def the_same():
            rear.send(image(scene(1), at(last)), wait=False)
            time.sleep(1)

        assert "every header stamp is the same" in warned(health, "on rear and none is used", the_same)
        broken = image(scene(1), at(last))
        broken.encoding = "no such"

        def unusable():
            broken.header.stamp.sec += 1
            rear.send(broken, wait=False)
            time.sleep(1)

        assert "every image is unusable" in warned(health, "every image is unusable", unusable)
        listener.call(SetBool, f"{NODE}/pause", SetBool.Request(data=True))
        rear.send(image(scene(1), at(10_000)))
        warned(health, "paused")
        tally("5 cameras none of whose frames is used, said on /diagnostics", 4, 4)
        assert node.end() == 0


def dumped(listener: Listener) -> dict:
    """What `ros2 param dump` writes: every parameter of the node."""
    names = listener.call(ListParameters, f"{NODE}/list_parameters", ListParameters.Request()).result.names
    values = listener.call(GetParameters, f"{NODE}/get_parameters", GetParameters.Request(names=names)).values
    tree: dict = {}
    for name, value in zip(names, values, strict=True):
        *groups, last = name.split(".")
        place = tree
        for group in groups:
            place = place.setdefault(group, {})
        found = parameter_value_to_python(value)
        place[last] = list(found) if isinstance(found, bytes) or hasattr(found, "tolist") else found
    return {NODE: {"ros__parameters": tree}}


def test_a_node_starts_from_its_own_dump_with_the_same_parameters(listener, tmp_path):
    given = {"accept_score": 0.61, "crop": [1, 2, 3, 4], "frame_id": "odom"} | reliable("camera/image_raw")
    with running_node(**given) as node:
        first = dumped(listener)
        assert node.end() == 0
    assert set(DECLARED) <= set(first[NODE]["ros__parameters"])
    (tmp_path / "params.yaml").write_text(yaml.safe_dump(first))
    with running_node("--params-file", str(tmp_path / "params.yaml")) as node:
        assert dumped(listener) == first
        tally("6 parameters given back as they were dumped", len(DECLARED), len(DECLARED))
        assert node.end() == 0
        assert "no parameter" not in node.output


FILES = {
    "no yaml": "a: [1, 2\n b: {",
    "tabs": "/**:\n\tros__parameters:\n",
    "a list": "- 1\n- 2\n",
    "binary": "\x00\x01\x02\xff",
    "deep": "[" * 2000,
    "no such type": "/**:\n  ros__parameters:\n    accept_score: [1, a, true]\n",
    "a wrong value": "/**:\n  ros__parameters:\n    accept_score: 7.0\n",
    "an empty frame": "/**:\n  ros__parameters:\n    frame_id: ''\n",
}


@pytest.mark.parametrize("kind", FILES)
def test_a_parameter_file_that_cannot_be_used_is_one_line(tmp_path, kind):
    (tmp_path / "params.yaml").write_bytes(FILES[kind].encode("latin1"))
    done = subprocess.run([executable(), "--ros-args", "--params-file", str(tmp_path / "params.yaml")],
                          capture_output=True, text=True, timeout=120)  # fmt: skip
    assert done.returncode == 2, done.stderr
    assert "Traceback" not in done.stderr
    said = [line for line in done.stderr.splitlines() if line.startswith("place_recognizer: ")]
    assert len(said) == 1
    assert len(said[0]) <= 1100
    tally("6 parameter files that cannot be used", 1, 1)


def test_a_parameter_that_the_node_does_not_have_is_named(listener):
    with running_node(acept_score=0.7, weights_folder="/x") as node:
        assert "did you mean accept_score?" in node.wait_for("no parameter acept_score")
        node.wait_for("no parameter weights_folder")
        assert node.end() == 0


def test_a_flag_that_ros_does_not_know_is_one_line():
    node = Process(executable(), "--ros-args", "--no-such-flag")
    assert node.wait(60) == 2
    assert "Traceback" not in node.output
    assert "place_recognizer: " in node.output
