"""`pnv bag`: another program reads what it writes, and finds what `pnv run` finds."""

import csv
from pathlib import Path

import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import Writer
from rosbags.typesys import Stores, get_typestore

from msg_adapters.loop_closures import CANDIDATE_FIELDS, closures_from_message
from pnv_cli.main import main
from pnv_core.describe.model_files import save_model
from test.core.small import small_model
from test.lab.evaluation.places import place

TYPES = get_typestore(Stores.ROS2_JAZZY)
LATE_NS = 7_000_000  # between an image and its recording
SETTINGS = ["--threads", "1", "--min-interval-s", "0", "--min-change", "0", "--exclude-recent-s", "3",
            "--accept-score", "0", "--consistency", "0"]  # fmt: skip


@pytest.fixture
def walk(tmp_path: Path) -> Path:
    """Seven images at 1 Hz; the last two show the places of the first two."""
    types = TYPES.types
    with Writer(tmp_path / "walk", version=9) as writer:
        images = writer.add_connection("/camera", "sensor_msgs/msg/Image", typestore=TYPES)
        for i, seed in enumerate((0, 1, 2, 3, 4, 0, 1)):
            rgb = place(seed, shift=3 * (i > 4))
            header = types["std_msgs/msg/Header"](types["builtin_interfaces/msg/Time"](100 + i, 5), "camera")
            size = rgb.shape[:2]
            pixels = np.ascontiguousarray(rgb).reshape(-1)
            message = types["sensor_msgs/msg/Image"](header, *size, "rgb8", 0, size[1] * 3, pixels)
            writer.write(images, (100 + i) * 10**9 + 5 + LATE_NS, TYPES.serialize_cdr(message, images.msgtype))
    save_model(small_model(), tmp_path / "small.safetensors")
    return tmp_path


def messages(bag: Path) -> list[tuple[str, int, bytes]]:
    with AnyReader([bag]) as reader:
        return [(connection.topic, time, bytes(raw)) for connection, time, raw in reader.messages()]


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_the_bag_holds_the_closures_of_a_run_at_the_times_of_their_images(walk: Path, storage: str) -> None:
    model = ["--weights", str(walk / "small.safetensors"), *SETTINGS]
    for name in ("a", "b"):
        assert main(["bag", str(walk / "walk"), "-o", str(walk / name), "--storage", storage, *model]) == 0
    assert main(["run", str(walk / "walk"), "--csv", str(walk / "c.csv"), *model]) == 0
    assert messages(walk / "a") == messages(walk / "b")  # the same input, the same bag
    found, examined = [], {}
    with AnyReader([walk / "a"]) as reader:
        for connection, time, raw in reader.messages():
            message = reader.deserialize(raw, connection.msgtype)
            if connection.topic == "/loop_closures":
                closures = closures_from_message(message, ["/camera"])
                assert {c.query.stamp_ns + LATE_NS for c in closures} == {time}
                found += [(c.query.stamp_ns, c.match.stamp_ns, c.query.camera) for c in closures]
            elif connection.topic == "/place_recognizer/candidates":
                assert [field.name for field in message.fields] == list(CANDIDATE_FIELDS)
                examined[time] = message.width
    rows = csv.DictReader((walk / "c.csv").open())
    seconds = [(row["query_stamp"].split("."), row["match_stamp"].split(".")) for row in rows]
    expected = [(int(q[0]) * 10**9 + int(q[1]), int(m[0]) * 10**9 + int(m[1]), "/camera") for q, m in seconds]
    assert found == expected
    assert list(examined.values()) == [1, 2, 3, 4]  # frames 3 to 6 have so many at least 3 s older


def test_wrong_topics_and_places_are_refused_and_leave_nothing(walk: Path, capsys: pytest.CaptureFixture[str]) -> None:
    given = ["bag", str(walk / "walk"), "-o", str(walk / "new")]
    for flags, words in {
        ("--topic", "/front"): "no image on /front; image topics in the bag: /camera",
        ("--camera-info", "/info"): "no camera info on /info; camera info topics in the bag: none",
    }.items():
        assert main([*given, *flags]) == 2
        assert words in capsys.readouterr().err
    assert main(["bag", str(walk / "walk"), "-o", str(walk / "walk")]) == 2
    assert "exists; allowed: a new folder" in capsys.readouterr().err
    assert sorted(p.name for p in walk.iterdir()) == ["small.safetensors", "walk"]
