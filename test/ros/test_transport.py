"""Ways in: JPEG where raw images are lost, and several cameras at once; cameras are processes of their own."""

import sys
from contextlib import contextmanager

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus

from test.ros.camera import EPOCH_S, Health
from test.ros.processes import Process, running_node, wait_until

pytestmark = pytest.mark.process
RAW = "camera/image_raw"


@contextmanager
def cameras(tmp_path, *arguments, kept=1.0, rate=30, seconds=600):
    """A process that publishes until it is no longer needed; a share `kept` of its frames leaves it at all."""
    numbers = np.flatnonzero(np.random.default_rng(0).random(rate * seconds) < kept)
    stamps = tmp_path / f"{rate}_{kept}.csv"
    stamps.write_text("".join(f"{EPOCH_S * 10**9 + int(n) * 10**9 // rate},\n" for n in numbers))
    command = [sys.executable, "-m", "test.ros.publish", "--stamps", str(stamps), "--same"]
    process = Process(*command, "--rate", str(rate * kept), *arguments)
    try:
        yield process
    finally:
        process.child.kill()
        process.child.wait()


def test_where_raw_images_are_lost_the_node_asks_for_jpegs_by_itself(domain, listener, tmp_path):
    health = Health(listener)
    with running_node() as node, cameras(tmp_path, "--topic", RAW, kept=0.5):
        said = node.wait_for("or send compressed images")  # nobody does
        assert "fastdds_shared_memory.xml" in said
        assert health.fresh().level == DiagnosticStatus.WARN
        with cameras(tmp_path, "--topic", f"{RAW}/compressed", "--encoding", "jpeg"):
            said = node.wait_for("now listening to /camera/image_raw/compressed (CompressedImage")
            assert "fastdds_shared_memory.xml" in said
            wait_until(lambda: float(health.values()["frames in [1/s]"]) > 20, 60, "the JPEGs")
            wait_until(lambda: health.values()[f"lost on the way, {RAW} [%]"] == "0", 60, "no loss")


def test_four_cameras_have_equal_shares(domain, listener, tmp_path):
    topics = ["front", "left", "rear", "right"]
    health = Health(listener)
    with (
        running_node(image_topics=topics, min_interval_s=0.0, min_change=0.0, threads=1) as node,
        cameras(tmp_path, "--topic", ",".join(topics), "--encoding", "jpeg", rate=10),
    ):
        wait_until(lambda: health.count("frames processed") >= 20, 300, "frames of every camera")
        seen, before = [], health.count("frames processed")
        while health.count("frames processed") < before + 60:  # one status of a slow machine is of a few frames
            values = health.fresh() and health.values()
            seen.append([int(values[f"share of what is processed, {topic} [%]"]) for topic in topics])
        shares = np.mean(seen, axis=0)
        assert sum(shares) == pytest.approx(100, abs=2)
        assert min(shares) >= 20
        assert max(shares) <= 30
        assert "Traceback" not in node.output
