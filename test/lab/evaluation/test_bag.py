"""Evaluating a rosbag2: unpacked once, with the poses of its odometry."""

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag2 import Writer
from rosbags.typesys import Stores, get_typestore

from pnv_cli.bag_frames import unpacked
from pnv_cli.main import main
from pnv_core.errors import PnvError
from pnv_lab.evaluation.datasets import SequenceRule
from pnv_lab.evaluation.datasets.sequences import poses_csv

from .places import place

TYPES = get_typestore(Stores.ROS2_JAZZY)


def silent(items, count, what) -> Iterator:  # type: ignore[no-untyped-def]
    return iter(items)


def header(seconds: float):  # type: ignore[no-untyped-def]
    time = TYPES.types["builtin_interfaces/msg/Time"](int(seconds), round(seconds % 1 * 1e9))
    return TYPES.types["std_msgs/msg/Header"](time, "camera")


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    """Twelve images at 2 Hz there and back along a line, with poses; the last image has none."""
    types = TYPES.types
    folder = tmp_path / "walk"
    with Writer(folder, version=9) as writer:
        images = writer.add_connection("/camera", "sensor_msgs/msg/Image", typestore=TYPES)
        poses = writer.add_connection("/truth", "geometry_msgs/msg/PoseStamped", typestore=TYPES)
        for i in range(12):
            stamp = 100 + i / 2
            x = float(min(i, 10 - i)) * 3
            rgb = place(abs(int(x)))
            message = types["sensor_msgs/msg/Image"](
                header(stamp), *rgb.shape[:2], "rgb8", 0, rgb.shape[1] * 3, np.ascontiguousarray(rgb).reshape(-1)
            )
            writer.write(images, round(stamp * 1e9), TYPES.serialize_cdr(message, images.msgtype))
            if i == 11:
                continue
            at = types["geometry_msgs/msg/Point"](x, 0.0, 0.0)
            turn = types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
            held = types["geometry_msgs/msg/PoseStamped"](
                header(stamp + 0.02), types["geometry_msgs/msg/Pose"](at, turn)
            )
            writer.write(poses, round(stamp * 1e9), TYPES.serialize_cdr(held, poses.msgtype))
    return folder


def test_a_bag_becomes_a_sequence_with_the_truth_of_its_poses(bag: Path, tmp_path: Path) -> None:
    folder = unpacked(bag, tmp_path / "cache", None, None, 1.0, silent)
    dataset = poses_csv(folder, SequenceRule(radius_m=1.0, angle_deg=10.0, exclude_recent_s=2.0))
    # kept: images 0, 2, 4, 6, 8, 10 at x = 0, 6, 12, 12, 6, 0; 8 returns to 2 and 10 to 0, 6 to 4 too soon
    assert [t.tolist() for t in dataset.truth] == [[], [], [], [], [1], [0]]
    assert dataset.stamps is not None
    assert dataset.stamps.tolist() == [100, 101, 102, 103, 104, 105]
    written = (folder / "poses.csv").stat().st_mtime_ns
    assert unpacked(bag, tmp_path / "cache", "/camera", None, 1.0, silent) != folder
    assert unpacked(bag, tmp_path / "cache", None, None, 1.0, silent) == folder
    assert (folder / "poses.csv").stat().st_mtime_ns == written


def test_a_bag_without_the_topic_names_those_it_has(bag: Path, tmp_path: Path) -> None:
    with pytest.raises(PnvError, match=r"--image-topic /front; image topics in the bag: /camera"):
        unpacked(bag, tmp_path, "/front", None, 1.0, silent)
    with pytest.raises(PnvError, match="no such bag"):
        unpacked(tmp_path / "none", tmp_path, None, None, 1.0, silent)


def test_a_bag_is_evaluated_by_one_command(bag: Path, tmp_path: Path) -> None:
    small = [
        "--image-width",
        "160",
        "--image-height",
        "112",
        "--patch-sizes",
        "2",
        "--threads",
        "1",
        "--scorer",
        "rapid",
    ]
    rule = ["--radius-m", "1", "--angle-deg", "10", "--exclude-recent-s", "2", "--every-s", "1"]
    given = ["--dataset", "bag", "--root", str(bag), "--method", "patchnetvlad", "--cache", str(tmp_path / "cache")]
    assert main(["evaluate", *given, *rule, *small, "--out", str(tmp_path / "out")]) == 0
    (row,) = json.loads((tmp_path / "out" / "results.json").read_text())
    assert (row["queries"], row["recall@1"]) == (2, 1.0)
    assert "Path and best candidates" in (tmp_path / "out" / "report.html").read_text()


def test_pnv_run_reads_a_bag(bag: Path, tmp_path: Path) -> None:
    small = ["--image-width", "160", "--image-height", "112", "--patch-sizes", "2", "--min-interval-s", "0"]
    assert (
        main(["run", "--bag", str(bag), "--csv", str(tmp_path / "out.csv"), "--all", "--exclude-recent-s", "2", *small])
        == 0
    )
    assert (tmp_path / "out.csv").read_text().count("\n") > 1
