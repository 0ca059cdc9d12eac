"""A camera for the examples, as a process of its own: publishes a sequence, and odometry where a file gives it.

Where the node drops frames because it is busy, the camera slows down: a small machine shows the same closures later.
Prints one JSON line per image: {"name", "stamp_ns", "sent": seconds of the monotonic clock}.
"""

import argparse
import csv
import json
import sys
import time
from collections import deque
from pathlib import Path

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from nav_msgs.msg import Odometry
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import QoSProfile, QoSReliabilityPolicy
from sensor_msgs.msg import CameraInfo, Image

from examples.sources import add_source_flags, named_frames
from msg_adapters.loop_closures import to_time
from msg_adapters.pictures import rgb_to_message
from pnv_core.errors import PnvError

IMAGE_TOPIC, INFO_TOPIC = "camera/image_raw", "camera/camera_info"
ODOMETRY_TOPIC = "odometry"
BUSY = "dropped: busy"  # of the node's diagnostics
_WAIT_FOR_LISTENERS_S = 120.0


def read_odometry(path: Path) -> deque[tuple[int, list[float]]]:
    """(stamp in ns, [x, y, z, qx, qy, qz, qw]) per row of a CSV with those columns."""
    with path.open(newline="") as file:
        rows = csv.DictReader(file)
        return deque(
            (int(row["stamp_ns"]), [float(row[key]) for key in ("x", "y", "z", "qx", "qy", "qz", "qw")]) for row in rows
        )


def odometry_message(stamp_ns: int, pose: list[float]) -> Odometry:
    message = Odometry()
    message.header.stamp = to_time(stamp_ns)
    message.header.frame_id, message.child_frame_id = "odom", "base_link"
    position, orientation = message.pose.pose.position, message.pose.pose.orientation
    position.x, position.y, position.z = pose[:3]
    orientation.x, orientation.y, orientation.z, orientation.w = pose[3:]
    return message


def camera_info(image: Image, intrinsics: str) -> CameraInfo:
    """CameraInfo of an image without distortion."""
    fx, fy, cx, cy = (float(value) for value in intrinsics.split(","))
    message = CameraInfo(header=image.header, height=image.height, width=image.width, distortion_model="plumb_bob")
    message.d = [0.0] * 5
    message.k = [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]
    message.r = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
    message.p = [fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0]
    return message


class Pace:
    """The clock of the playback: `playback` times faster than the stamps, slower where the node cannot follow."""

    def __init__(self, node: Node, playback: float) -> None:
        self._node, self._playback = node, playback
        self._last_stamp_ns: int | None = None
        self._due = time.monotonic()
        self._share, self._busy = 1.0, 0
        node.create_subscription(DiagnosticArray, "/diagnostics", self._adapt, 10)

    def _adapt(self, message: DiagnosticArray) -> None:
        for value in (pair.value for status in message.status for pair in status.values if pair.key == BUSY):
            self._share = min(1.0, self._share * (1.15 if int(value) == self._busy else 0.6))
            self._busy = int(value)

    def wait(self, stamp_ns: int) -> None:
        """Until the frame of this stamp is due."""
        step_ns = 0 if self._last_stamp_ns is None else max(0, stamp_ns - self._last_stamp_ns)
        self._last_stamp_ns = stamp_ns
        start = self._due
        while True:
            self._due = start + step_ns / 1e9 / self._playback / self._share
            left = self._due - time.monotonic()
            if left <= 0:
                break
            rclpy.spin_once(self._node, timeout_sec=left)
        self._due = max(self._due, time.monotonic() - 1.0)  # a slow source is not made up for by a burst


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    add_source_flags(parser)
    parser.add_argument("--playback", type=float, default=2.0, help="times faster than the stamps, at most; default 2")
    parser.add_argument("--intrinsics", metavar="FX,FY,CX,CY", help="publish them as camera info")
    parser.add_argument("--odometry", type=Path, help="CSV of stamp_ns,x,y,z,qx,qy,qz,qw to publish as odometry")
    args = parser.parse_args()
    poses = read_odometry(args.odometry) if args.odometry else deque()
    rclpy.init(args=[])
    node = Node("example_camera")
    reliable = QoSProfile(depth=10, reliability=QoSReliabilityPolicy.RELIABLE)
    images = node.create_publisher(Image, IMAGE_TOPIC, reliable)
    odometry = node.create_publisher(Odometry, ODOMETRY_TOPIC, QoSProfile(depth=500))
    info = node.create_publisher(CameraInfo, INFO_TOPIC, reliable) if args.intrinsics else None
    try:
        _wait_for_listeners([images] + [odometry] * bool(poses) + [info] * bool(info))
        pace = Pace(node, args.playback)
        for name, frame in named_frames(args):
            message = rgb_to_message(frame.rgb, frame.stamp_ns, "camera")
            pace.wait(frame.stamp_ns)
            while poses and poses[0][0] <= frame.stamp_ns:
                odometry.publish(odometry_message(*poses.popleft()))
            if info is not None:
                info.publish(camera_info(message, args.intrinsics))
            images.publish(message)
            print(json.dumps({"name": name, "stamp_ns": frame.stamp_ns, "sent": time.monotonic()}), flush=True)
        while poses:
            odometry.publish(odometry_message(*poses.popleft()))
        odometry.wait_for_all_acked(Duration(seconds=20))
        time.sleep(1.0)  # the last image is on its way
    except PnvError as error:
        print(f"publisher: {error}", file=sys.stderr)
        return 2
    except (KeyboardInterrupt, BrokenPipeError):
        return 130
    finally:
        node.destroy_node()
        rclpy.try_shutdown()
    return 0


def _wait_for_listeners(publishers: list) -> None:
    """Until everyone who should listen does, so that the first frame is not lost. Raises PnvError after two minutes."""
    end = time.monotonic() + _WAIT_FOR_LISTENERS_S
    while not all(publisher.get_subscription_count() for publisher in publishers):
        if time.monotonic() > end:
            raise PnvError(f"nobody listens to {publishers[0].topic_name} after {_WAIT_FOR_LISTENERS_S:.0f} s")
        time.sleep(0.05)


if __name__ == "__main__":
    sys.exit(main())
