"""Cameras: publish images from files or noise with given stamps, as a process of its own.

python -m test.ros.publish --topic camera/image_raw --stamps STAMPS.csv --rate 10
The CSV has one row per image: nanoseconds, path (empty: seeded noise).
"""

import argparse
import csv
import sys
import time
from array import array

import cv2
import numpy as np
from rclpy.qos import QoSProfile, QoSReliabilityPolicy
from sensor_msgs.msg import CompressedImage, Image

from test.ros.processes import NODE, PATIENCE_S, Listener, wait_until

ENCODINGS = {
    "bgr8": lambda bgr: bgr,
    "rgb8": lambda bgr: cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB),
    "mono8": lambda bgr: cv2.cvtColor(bgr, cv2.COLOR_BGR2GRAY),
    "rgba8": lambda bgr: cv2.cvtColor(bgr, cv2.COLOR_BGR2RGBA),
    "mono16": lambda bgr: cv2.cvtColor(bgr, cv2.COLOR_BGR2GRAY).astype("<u2") * 257,
}


def image_message(bgr: np.ndarray, encoding: str) -> Image | CompressedImage:
    if encoding not in ENCODINGS:
        data = cv2.imencode("." + encoding, bgr)[1].tobytes()
        return CompressedImage(format=encoding, data=array("B", data))
    pixels = ENCODINGS[encoding](bgr)
    height, width = pixels.shape[:2]
    data = array("B", pixels.tobytes())
    return Image(encoding=encoding, height=height, width=width, step=pixels[0].nbytes, data=data)


def main() -> int:
    parser = argparse.ArgumentParser()
    parser.add_argument("--topic", default="camera/image_raw", help="or several, with commas")
    parser.add_argument("--stamps", required=True)
    parser.add_argument("--rate", type=float, default=10.0)
    parser.add_argument("--encoding", default="bgr8")  # of ENCODINGS, or jpeg, png
    parser.add_argument("--reliable", action="store_true")
    parser.add_argument("--size", default="320x240")  # of noise
    parser.add_argument("--same", action="store_true")  # one picture again and again, for speed
    parser.add_argument("--linger", type=float, default=1.0)
    args = parser.parse_args()

    driver = Listener("camera_driver")
    reliability = QoSReliabilityPolicy.RELIABLE if args.reliable else QoSReliabilityPolicy.BEST_EFFORT
    kind = Image if args.encoding in ENCODINGS else CompressedImage
    qos = QoSProfile(depth=5, reliability=reliability)
    publishers = [driver.node.create_publisher(kind, topic, qos) for topic in args.topic.split(",")]
    for publisher in publishers:
        wait_until(publisher.get_subscription_count, PATIENCE_S, "a listener")
    driver.met_by(NODE)

    width, height = (int(v) for v in args.size.split("x"))
    with open(args.stamps, newline="") as file:
        rows = [(int(stamp), path) for stamp, path in csv.reader(file)]
    due = time.monotonic()
    message = None
    for number, (stamp_ns, path) in enumerate(rows):
        if message is None or not args.same:
            noise = np.random.default_rng(number).integers(0, 256, (height, width, 3), dtype=np.uint8)
            message = image_message(cv2.imread(path) if path else noise, args.encoding)
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp_ns, 10**9)
        for publisher in publishers:
            publisher.publish(message)
        due += 1.0 / args.rate
        time.sleep(max(0.0, due - time.monotonic()))
    time.sleep(args.linger)
    driver.close()
    print(f"published {len(rows)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
