"""Frames and ground-truth poses of a rosbag2 as a folder of images with a poses.csv."""

import csv
import hashlib
import json
import os
import shutil
from collections.abc import Callable, Iterable
from contextlib import closing
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from msg_adapters.images import message_to_frame
from pnv_cli.sources import IMAGE_TYPES, open_bag
from pnv_core.errors import PnvError

_POSE_TYPES = (
    "nav_msgs/msg/Odometry",
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
)
_MAX_GAP_S = 0.1  # between an image and its pose; odometry comes at 10 Hz or more
_HEADER = ("frame", "timestamp", "x", "y", "z", "qx", "qy", "qz", "qw")


def unpacked(
    bag: Path,
    cache: Path,
    image_topic: str | None,
    pose_topic: str | None,
    every_s: float,
    progress: Callable[[Iterable[Any], int, str], Iterable[Any]],
) -> Path:
    """A folder with an image every `every_s` seconds and the pose nearest in time, made once per bag and choice.

    Raises PnvError for a bag without images or poses, naming the topics it has.
    """
    if not bag.exists():
        raise PnvError(f"{bag}: no such bag")
    files = sorted(p for p in (bag.rglob("*") if bag.is_dir() else [bag]) if p.is_file())
    what = [str(bag.resolve()), image_topic, pose_topic, every_s, *((p.name, p.stat().st_size) for p in files)]
    name = f"{bag.stem}-{hashlib.sha256(json.dumps(what).encode()).hexdigest()[:12]}"
    done = cache / name
    if (done / "poses.csv").is_file():
        return done
    with closing(open_bag(bag)) as reader:
        images = _one_topic(reader.connections, IMAGE_TYPES, image_topic, bag, "image")
        poses = _one_topic(reader.connections, _POSE_TYPES, pose_topic, bag, "pose")
        times, values = [], []
        for connection, _, raw in reader.messages(poses):
            message: Any = reader.deserialize(raw, connection.msgtype)
            held = message.pose.pose if hasattr(message.pose, "pose") else message.pose
            times.append(_seconds(message.header.stamp))
            at, turn = held.position, held.orientation
            values.append((at.x, at.y, at.z, turn.x, turn.y, turn.z, turn.w))
        if not times:
            raise PnvError(f"{bag}: topic {poses[0].topic} holds no pose")
        order = np.argsort(times, kind="stable")
        known = np.array(times)[order]
        part = cache / f".{name}.{os.getpid()}.part"
        shutil.rmtree(part, ignore_errors=True)
        (part / "images").mkdir(parents=True)
        rows: list[tuple[object, ...]] = []
        last = -np.inf
        count = sum(c.msgcount for c in images)
        for connection, _, raw in progress(reader.messages(images), count, f"{bag.name}: unpacking"):
            message = reader.deserialize(raw, connection.msgtype)
            stamp = _seconds(message.header.stamp)
            nearest = int(np.abs(known - stamp).argmin())
            if stamp - last < every_s or abs(known[nearest] - stamp) > _MAX_GAP_S:
                continue
            last = stamp
            frame = f"{len(rows):06}.png"
            rgb = message_to_frame(message, connection.topic).rgb
            cv2.imwrite(str(part / "images" / frame), cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR))
            rows.append((frame, f"{stamp:.9f}", *values[order[nearest]]))
    if not rows:
        shutil.rmtree(part)
        raise PnvError(f"{bag}: no image has a pose within {_MAX_GAP_S} s; do both topics use the same clock?")
    with open(part / "poses.csv", "w", newline="") as file:
        csv.writer(file).writerows([_HEADER, *rows])
    shutil.rmtree(done, ignore_errors=True)
    os.replace(part, done)
    return done


def _one_topic(connections: Any, kinds: tuple[str, ...], wanted: str | None, bag: Path, what: str) -> list[Any]:
    """The connections of the wanted topic, or of the only one of these kinds."""
    offered = [c for c in connections if c.msgtype in kinds]
    topics = sorted({c.topic for c in offered})
    if wanted is None and len(topics) == 1:
        wanted = topics[0]
    chosen = [c for c in offered if c.topic == wanted]
    if not chosen:
        given = f"--{what}-topic {wanted}" if wanted else f"no --{what}-topic"
        raise PnvError(f"{bag}: {given}; {what} topics in the bag: {', '.join(topics) or 'none'}")
    return chosen


def _seconds(stamp: Any) -> float:
    return float(stamp.sec) + stamp.nanosec * 1e-9
