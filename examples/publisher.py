"""A camera for the examples, as a process of its own: publishes a sequence, and odometry where a file gives it.

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
from nav_msgs.msg import Odometry
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import QoSProfile, QoSReliabilityPolicy
from sensor_msgs.msg import Image

from examples.sources import add_source_flags, named_frames
from msg_adapters.loop_closures import to_time
from msg_adapters.pictures import rgb_to_message
from pnv_core.errors import PnvError

IMAGE_TOPIC = "camera/image_raw"
ODOMETRY_TOPIC = "odometry"
_WAIT_FOR_LISTENERS_S = 60.0


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


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    add_source_flags(parser)
    parser.add_argument("--playback", type=float, default=2.0, help="times faster than the stamps; default 2")
    parser.add_argument("--odometry", type=Path, help="CSV of stamp_ns,x,y,z,qx,qy,qz,qw to publish as odometry")
    args = parser.parse_args()
    poses = read_odometry(args.odometry) if args.odometry else deque()
    rclpy.init(args=[])
    node = Node("example_camera")
    reliable = QoSProfile(depth=10, reliability=QoSReliabilityPolicy.RELIABLE)
    images = node.create_publisher(Image, IMAGE_TOPIC, reliable)
    odometry = node.create_publisher(Odometry, ODOMETRY_TOPIC, QoSProfile(depth=500))
    try:
        _wait_for_listeners([images] + [odometry] * bool(poses))
        first_stamp, start = None, time.monotonic()
        for name, frame in named_frames(args):
            first_stamp = frame.stamp_ns if first_stamp is None else first_stamp
            due = start + (frame.stamp_ns - first_stamp) / 1e9 / args.playback
            message = rgb_to_message(frame.rgb, frame.stamp_ns, "camera")
            time.sleep(max(0.0, due - time.monotonic()))
            while poses and poses[0][0] <= frame.stamp_ns:
                odometry.publish(odometry_message(*poses.popleft()))
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
    """Until everyone who should listen does, so that the first frame is not lost. Raises PnvError after a minute."""
    end = time.monotonic() + _WAIT_FOR_LISTENERS_S
    while not all(publisher.get_subscription_count() for publisher in publishers):
        if time.monotonic() > end:
            raise PnvError(f"nobody listens to {publishers[0].topic_name} after {_WAIT_FOR_LISTENERS_S:.0f} s")
        time.sleep(0.05)


if __name__ == "__main__":
    sys.exit(main())
