"""pnv bag IN -o OUT: what the node would have published of a bag, as a bag to play beside it."""

import argparse
import os
import shutil
import sys
import tempfile
from array import array
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pnv_cli.common import ALWAYS_SHOWN, add_config_flags, config_from
from pnv_cli.sources import IMAGE_TYPES, open_bag
from pnv_core.errors import ConfigError, ImageError, PnvError

if TYPE_CHECKING:
    from pnv_core.recognizer import PlaceRecognizer

NODE = "/place_recognizer"  # as the topics of the node are named
TOPICS = {
    "/loop_closures": "std_msgs/msg/Float64MultiArray",
    f"{NODE}/candidates": "sensor_msgs/msg/PointCloud2",
    f"{NODE}/relative_pose": "geometry_msgs/msg/PoseWithCovarianceStamped",
}


def add_parser(subparsers: argparse._SubParsersAction) -> None:
    parser = subparsers.add_parser(
        "bag",
        description="Writes what the node publishes of a bag's images (/loop_closures, ~/candidates, ~/relative_pose) "
        "as a bag of its own, each message at the time of its image: Foxglove shows both together.",
    )
    parser.add_argument("bag", metavar="IN", help="bag folder, .mcap or .db3")
    parser.add_argument("-o", "--output", required=True, metavar="OUT", help="folder of the new bag")
    parser.add_argument("--topic", help="image topic; default all image topics")
    parser.add_argument("--camera-info", metavar="TOPIC", help="rectify by it; gives ~/relative_pose with --odometry")
    parser.add_argument("--odometry", metavar="TOPIC", help="nav_msgs/Odometry, as the node's odometry_topic")
    parser.add_argument("--storage", choices=("mcap", "sqlite3"), default="mcap", help="default mcap")
    add_config_flags(parser, shown=(*ALWAYS_SHOWN, "accept_score", "exclude_recent_s"))
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    from pnv_core.describe.describer import describer_from
    from pnv_core.recognizer import PlaceRecognizer

    output = Path(args.output)
    if output.exists():
        raise ConfigError(f"-o {output}: exists; allowed: a new folder")
    if not output.parent.is_dir():
        raise ConfigError(f"-o {output}: the folder {output.parent} does not exist")
    config = config_from(args)
    reader = open_bag(args.bag)
    try:
        images, others = _chosen(reader, args)
        recognizer = PlaceRecognizer(describer_from(config))
        with _new_bag(output, args.storage) as write:
            counts = _fill(write, reader, recognizer, images, others)
    finally:
        reader.close()
    frames, queries, closures = counts
    print(f"{frames} frames, {queries} queries, {closures} closures -> {output}")
    return 0


def _chosen(reader: Any, args: argparse.Namespace) -> tuple[list[Any], list[Any]]:
    """Image connections, and those of camera info and odometry. Raises PnvError for a topic the bag lacks."""

    def of(topic: str | None, kinds: tuple[str, ...], what: str) -> list[Any]:
        offered = [c for c in reader.connections if c.msgtype in kinds]
        found = [c for c in offered if topic in (None, c.topic)]
        if not found:
            topics = ", ".join(sorted({c.topic for c in offered})) or "none"
            raise PnvError(f"{args.bag}: no {what} on {topic or 'any topic'}; {what} topics in the bag: {topics}")
        return found

    images = of(args.topic, IMAGE_TYPES, "image")
    others = of(args.camera_info, ("sensor_msgs/msg/CameraInfo",), "camera info") if args.camera_info else []
    others += of(args.odometry, ("nav_msgs/msg/Odometry",), "odometry") if args.odometry else []
    if args.camera_info and len({c.topic for c in images}) > 1:
        raise ConfigError("--camera-info belongs to one camera; allowed: together with --topic")
    return images, others


def _fill(
    write: Any, reader: Any, recognizer: "PlaceRecognizer", images: list[Any], others: list[Any]
) -> tuple[int, int, int]:
    """Frames, queries and closures; every message is handed to `write`."""
    from msg_adapters.camera_info import Rectifier
    from msg_adapters.images import message_to_frame, stamp_of
    from msg_adapters.loop_closures import candidates_to_message, closures_to_message
    from msg_adapters.relative_pose import relative_pose_to_message
    from pnv_cli.progress import bar
    from pnv_core.pose.geometry import Intrinsics
    from pnv_core.pose.relative_poses import RelativePoses
    from pnv_core.types import Frame

    cameras = sorted({c.topic for c in images})
    poses = RelativePoses(recognizer)
    rectifier: Rectifier | None = None
    waits = any(c.msgtype.endswith("CameraInfo") for c in others)
    frames = queries = closed = 0
    held = bar(reader.messages([*images, *others]), total=sum(c.msgcount for c in (*images, *others)), unit="message")
    for connection, recorded_ns, raw in held:
        message = reader.deserialize(raw, connection.msgtype)
        if connection.msgtype.endswith("Odometry"):
            at = message.pose.pose.position
            recognizer.odometry.add(stamp_of(message), at.x, at.y, at.z)
            continue
        if connection.msgtype.endswith("CameraInfo"):
            if rectifier is None:
                rectifier = Rectifier(message)
                poses.cameras[cameras[0]] = Intrinsics.of_pixels(*rectifier.focal_and_centre, rectifier.size[0])
            continue
        if waits and rectifier is None:
            continue  # as the node does: an image is not used before it can be rectified
        try:
            frame = message_to_frame(message, connection.topic)
            if rectifier is not None:
                frame = Frame(frame.stamp_ns, frame.camera, rectifier(frame.rgb))
            closures = recognizer.process(frame)
        except ImageError as error:
            print(f"pnv: skipped an image of {connection.topic}: {error}", file=sys.stderr)
            continue
        frames += 1
        if not closures:
            continue
        queries += 1
        write(f"{NODE}/candidates", recorded_ns, candidates_to_message(closures, cameras, "map"))
        accepted = [c for c in closures if c.accepted]
        closed += len(accepted)
        if accepted:
            write("/loop_closures", recorded_ns, closures_to_message(accepted, cameras))
            pose = poses.estimate(accepted[0])
            if pose is not None and pose.metric:
                write(f"{NODE}/relative_pose", recorded_ns, relative_pose_to_message(accepted[0], pose))
    if not frames:
        raise PnvError("no frame of the bag could be used" + (": no camera info came" if waits else ""))
    return frames, queries, closed


@contextmanager
def _new_bag(output: Path, storage: str) -> Iterator[Any]:
    """A function (topic, time [ns], message) that fills a bag, which takes its name when it is complete."""
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    types = get_typestore(Stores.ROS2_JAZZY)
    part = Path(tempfile.mkdtemp(prefix=".pnv_bag_", dir=output.parent))
    try:
        with Writer(part / output.name, version=9, storage_plugin=StoragePlugin[storage.upper()]) as writer:
            connections = {t: writer.add_connection(t, kind, typestore=types) for t, kind in TOPICS.items()}

            def write(topic: str, time_ns: int, message: Any) -> None:
                stored = _stored(types.types, message)
                writer.write(connections[topic], time_ns, types.serialize_cdr(stored, TOPICS[topic]))

            yield write
        os.replace(part / output.name, output)
    finally:
        shutil.rmtree(part, ignore_errors=True)


def _stored(types: Any, value: Any) -> Any:
    """A ROS message as the type of the same name that rosbags writes."""
    import numpy as np

    if hasattr(value, "get_fields_and_field_types"):
        kind = f"{type(value).__module__.partition('.')[0]}/msg/{type(value).__name__}"
        return types[kind](
            **{name: _stored(types, getattr(value, name)) for name in value.get_fields_and_field_types()}
        )
    if isinstance(value, list | tuple):
        return [_stored(types, item) for item in value]
    return np.asarray(value) if isinstance(value, array) else value
