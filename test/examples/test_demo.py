"""The demo, as a user starts it: node and publisher as processes of their own, the middleware between them."""

import csv
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import cv2
import pytest

ROOT = Path(__file__).resolve().parents[2]
pytestmark = pytest.mark.process
STRANGER = """
import time
import rclpy
from examples.listener import CLOSURES_QOS
from msg_adapters.loop_closures import closures_to_message
from pnv_core.types import ImageRef, LoopClosure
from std_msgs.msg import Float64MultiArray
rclpy.init()
publisher = rclpy.create_node("stranger").create_publisher(Float64MultiArray, "loop_closures", CLOSURES_QOS)
while True:
    closure = LoopClosure(ImageRef(9, 10**18 + 1, ""), ImageRef(1, 10**18, ""), 0.999, 0.9, 0.9, 50, True)
    publisher.publish(closures_to_message([closure], [""]))
    time.sleep(0.2)
"""


def _demo(out: Path, *flags: str, **more: str) -> subprocess.CompletedProcess:
    environment = {key: value for key, value in os.environ.items() if key != "ROS_DOMAIN_ID"} | more
    command = [sys.executable, "-m", "examples.demo", "--out", str(out), *flags]
    return subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=400)


@pytest.fixture
def stranger() -> Iterator[dict[str, str]]:
    """A node of another robot that publishes closures; the environment in which it is met."""
    shared = {"ROS_DOMAIN_ID": str(102 + os.getpid() % 100), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    process = subprocess.Popen([sys.executable, "-c", STRANGER], cwd=ROOT, env={**os.environ, **shared})
    yield shared
    process.terminate()
    process.wait(30)


def test_a_second_visit_is_found_and_reported_beside_another_robot(tmp_path: Path, stranger: dict[str, str]) -> None:
    flags = ["--world", "office", "--laps", "1.4", "--speed", "1.6", "--exclude-recent-s", "12"]
    done = _demo(tmp_path, *flags, "--playback", "3", **stranger)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "loop closure:" in done.stdout
    assert "frames dropped" in done.stdout
    assert "p95" in done.stdout
    rows = list(csv.DictReader((tmp_path / "loop_closures.csv").open()))
    told = [line for line in done.stdout.splitlines() if "loop closure:" in line]
    assert sum(line.count(" right") + line.count(" WRONG") for line in told) == len(rows)  # each one is labelled
    assert f"{sum(' right' in line for line in told)} times the camera came back" in done.stdout
    assert f"of {len(rows)} closures right" in done.stdout
    assert "starting the node and the camera" in done.stdout.splitlines()[1]
    assert "\r" not in done.stdout
    assert sum(row["right"] == "1" for row in rows) > 0.5 * len(rows)
    assert all(float(row["query_stamp"]) - float(row["match_stamp"]) >= 12 for row in rows)
    for name in ("match.png", "closures.png"):
        assert cv2.imread(str(tmp_path / name)).std() > 10


def test_input_without_a_revisit_ends_with_1_and_says_why(tmp_path: Path) -> None:
    images = tmp_path / "images"
    images.mkdir()
    from pnv_lab.worlds import loop_sequence

    sequence = loop_sequence(2, "hall", laps=1.0, fps=2.0, size=(160, 120))
    for number in range(12):
        cv2.imwrite(str(images / f"{number:03d}.png"), sequence[3 * number].rgb[..., ::-1])
    done = _demo(tmp_path / "out", "--images", str(images), "--fps", "2", "--playback", "4")
    assert done.returncode == 1, done.stdout + done.stderr
    assert "a match is at least 30 s older" in done.stderr
    assert (tmp_path / "out" / "loop_closures.csv").read_text().count("\n") == 1


def test_a_folder_that_does_not_exist_is_named(tmp_path: Path) -> None:
    done = _demo(tmp_path, "--images", str(tmp_path / "nowhere"))
    assert done.returncode == 2
    assert "nowhere" in done.stderr
