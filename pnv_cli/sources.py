"""Where frames come from: a folder of images, a video, a rosbag2. Each gives (name, Frame) in order.

Readers are imported when they are used: the flags are needed by every --help.
"""

import argparse
import sys
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pnv_core.errors import ConfigError, ImageError, PnvError

if TYPE_CHECKING:
    from pnv_core.types import Frame

IMAGE_TYPES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
BAG_FILES = (".db3", ".mcap")


@dataclass(frozen=True)
class FrameSource:
    """Named frames in the order they are to be processed; `count` is how many, 0 if unknown."""

    count: int
    frames: "Iterator[tuple[str, Frame]]"


def add_source_flags(parser: argparse.ArgumentParser) -> None:
    """The path or flags that `source_of` reads."""
    source = parser.add_mutually_exclusive_group(required=True)
    source.add_argument(
        "path", nargs="?", metavar="PATH", help="folder of images, video, bag folder, .mcap or .db3; or one of:"
    )
    add_file_flags(parser, source)


def add_file_flags(parser: argparse.ArgumentParser, source: "argparse._MutuallyExclusiveGroup") -> None:
    """The kinds of file into the group of which one is chosen, and what goes with them."""
    source.add_argument("--images", metavar="DIR", help="images in name order")
    source.add_argument("--video", metavar="FILE", help="a video, stamped by its own frame times")
    source.add_argument("--bag", metavar="DIR", help="rosbag2, sqlite3 or mcap, stamped by the image headers")
    parser.add_argument("--topic", help="image topic of the bag; default all image topics")
    parser.add_argument("--fps", type=float, default=10.0, help="stamps of a folder of images; default 10")
    parser.add_argument("--timestamps", metavar="CSV", help="stamps of images: columns frame,timestamp (seconds)")


def source_of(args: argparse.Namespace) -> FrameSource:
    """The source that the flags name. Raises PnvError for one that cannot be read."""
    if not 0.001 <= args.fps <= 10000:
        raise ConfigError(f"--fps {args.fps}; allowed: 0.001 to 10000")
    if args.timestamps and not (args.images or (args.path and Path(args.path).is_dir())):
        raise ConfigError("--timestamps stamps a folder of images; videos and bags have their own stamps")
    kind, path = named_source(args)
    if kind == "images":
        return image_folder(path, args.fps, args.timestamps)
    return video(path) if kind == "video" else bag(path, args.topic)


def named_source(args: argparse.Namespace) -> tuple[str, str]:
    """("images" | "video" | "bag", path) that the flags or the plain PATH name."""
    for kind in ("images", "video", "bag"):
        if getattr(args, kind):
            return kind, getattr(args, kind)
    path = Path(args.path)
    if not path.exists():
        raise PnvError(f"{path}: no such folder or file")
    if path.is_dir():
        held = [p for suffix in BAG_FILES for p in path.glob(f"*{suffix}")]
        return "bag" if held or (path / "metadata.yaml").is_file() else "images", args.path
    return "bag" if path.suffix in BAG_FILES else "video", args.path


def image_folder(folder: str, fps: float, timestamps: str | None) -> FrameSource:
    """The images of a folder in name order, stamped by `fps` or by a CSV of frame,timestamp (seconds)."""
    from pnv_core.images import list_images, read_image
    from pnv_core.types import Frame

    paths = list_images(folder)
    stamps = (
        _read_timestamps(timestamps, [p.name for p in paths])
        if timestamps
        else [round(i * 1e9 / fps) for i in range(len(paths))]
    )

    def frames() -> "Iterator[tuple[str, Frame]]":
        for path, stamp in zip(paths, stamps, strict=True):
            try:
                yield path.name, Frame(stamp, "camera", read_image(path))
            except ImageError as error:
                print(f"pnv: skipped: {error}", file=sys.stderr)

    return FrameSource(len(paths), frames())


def _read_timestamps(path: str, names: list[str]) -> list[int]:
    """Nanoseconds per image name; they must grow. Raises PnvError naming the first row that is wrong."""
    from pnv_lab.evaluation.datasets.tables import rows

    stamps: dict[str, int] = {}
    for line, row in enumerate(rows(Path(path), ("frame", "timestamp")), start=2):
        try:
            seconds, _, fraction = row["timestamp"].strip().partition(".")
            if len(seconds) > 11:  # 2**63 ns are 9,223,372,036 s
                raise ValueError
            stamp = int(seconds) * 10**9 + int((fraction + "0" * 9)[:9])
            if not -(2**63) <= stamp < 2**63:
                raise ValueError
            stamps[row["frame"].strip()] = stamp
        except (ValueError, AttributeError):
            allowed = "seconds, below 9223372036"
            raise PnvError(f"{path} line {line}: timestamp {row['timestamp']!r}; allowed: {allowed}") from None
    by_stem = {Path(name).stem: stamp for name, stamp in stamps.items()}
    found = [stamps.get(name, by_stem.get(Path(name).stem)) for name in names]
    if None in found:
        raise PnvError(f"{path}: no timestamp for {names[found.index(None)]}")
    for i in range(1, len(found)):
        if found[i] <= found[i - 1]:  # type: ignore[operator]
            raise PnvError(f"{path}: the timestamp of {names[i]} is not later than that of {names[i - 1]}")
    return found  # type: ignore[return-value]


def video(path: str) -> FrameSource:
    """The frames of a video file, stamped by its own frame times; by its rate where the file has none."""
    import cv2

    from pnv_core.types import Frame

    if not Path(path).is_file():
        raise PnvError(f"{path}: no such video file")
    capture = cv2.VideoCapture(path)
    if not capture.isOpened():
        raise PnvError(f"{path}: cannot be opened as a video")
    fps = capture.get(cv2.CAP_PROP_FPS) or 30.0

    def frames() -> "Iterator[tuple[str, Frame]]":
        number = 0
        try:
            while True:
                ok, bgr = capture.read()
                if not ok:
                    return
                stamp = round(capture.get(cv2.CAP_PROP_POS_MSEC) * 1e6) or round(number * 1e9 / fps)
                yield str(number), Frame(stamp, "camera", cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB))
                number += 1
        finally:
            capture.release()

    return FrameSource(max(0, int(capture.get(cv2.CAP_PROP_FRAME_COUNT))), frames())


def open_bag(path: str | Path) -> Any:
    """An opened rosbags reader; whoever opens it closes it. Raises PnvError for a path that is no rosbag2."""
    from rosbags.highlevel import AnyReader, AnyReaderError
    from rosbags.typesys import Stores, get_typestore

    if not Path(path).exists():
        raise PnvError(f"{path}: no such bag")
    try:
        reader = AnyReader([Path(path)], default_typestore=get_typestore(Stores.ROS2_JAZZY))
        reader.open()
    except (AnyReaderError, OSError, ValueError) as error:
        raise PnvError(f"{path}: cannot be read as a rosbag2 ({error})") from None
    return reader


def bag(folder: str, topic: str | None) -> FrameSource:
    """The images of a rosbag2 (sqlite3 or mcap), stamped by their headers; all image topics, or the one named."""
    from msg_adapters.images import message_to_frame

    reader = open_bag(folder)
    offered = [c for c in reader.connections if c.msgtype in IMAGE_TYPES]
    chosen = [c for c in offered if topic is None or c.topic == topic]
    if not chosen:
        topics = ", ".join(sorted({c.topic for c in offered})) or "none"
        reader.close()
        raise PnvError(f"{folder}: no images on {topic or 'any topic'}; image topics in the bag: {topics}")

    def frames() -> "Iterator[tuple[str, Frame]]":
        with closing(reader):
            for number, (connection, _, raw) in enumerate(reader.messages(chosen)):
                try:
                    yield str(number), message_to_frame(reader.deserialize(raw, connection.msgtype), connection.topic)
                except ImageError as error:
                    print(f"pnv: skipped image {number} of {connection.topic}: {error}", file=sys.stderr)

    return FrameSource(sum(c.msgcount for c in chosen), frames())
