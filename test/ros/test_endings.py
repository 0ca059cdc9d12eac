"""The node ended by signals, at any moment and under load: its status, its last words, what it saved."""

import os
import random
import re
import signal
import sys
import time
from pathlib import Path

import pytest

from test.ros.camera import Health
from test.ros.controls import trigger
from test.ros.processes import Process, executable, publisher, ros_arguments, wait_until
from test.ros.test_faults import EAGER, noise_stamps
from test.tally import count, tally

pytestmark = pytest.mark.process
TRACES = ("Traceback", "terminate called", "Exception ignored", "Fatal Python", "core dumped", "rclpy.", "Error")
LONGEST_S = 120.0  # a node that hangs, on a machine with much other work


def unclean(node: Process, status: int, allowed: set[int]) -> str:
    """What a person would see of it; empty if nothing."""
    lines = [line for line in node.lines if any(trace in line for trace in TRACES)]
    return f"status {status}\n{node.output}" if lines or status not in allowed else ""


def test_signals_under_load_end_the_node_cleanly_with_its_map_saved(listener, tmp_path):
    rounds, seed = count(4, 50), random.Random(0)
    camera = publisher("--stamps", noise_stamps(tmp_path / "stamps.csv", 600_000, 10**9 // 5), "--rate", "60",
                       "--topic", "front,rear", "--reliable")  # fmt: skip
    keep = {"map_path": tmp_path / "map", "load_on_start": True, "autosave": True, "autosave_interval_s": 1.0}
    bad, longest, lost, known = [], 0.0, 0, 0
    for turn in range(rounds):
        topics = {"image_topics": ["front", "rear"], "memory_budget_mb": 32.0}
        node = Process(executable(), *ros_arguments(**(EAGER | keep | topics)))
        node.wait_for("publishes")
        if known and f"loaded {known} keyframes" not in node.output:
            lost += 1
        wait_until(Health(listener).working, 60, "frames")
        time.sleep(seed.uniform(0, 4))
        if turn % 3 == 0:  # a service call in hand
            wait_until(lambda: trigger(listener, "save"), 60, "a save")
        signalled = time.monotonic()
        status = node.end([signal.SIGINT, signal.SIGTERM][turn % 2], timeout=LONGEST_S)
        longest = max(longest, time.monotonic() - signalled)
        bad += [words] if (words := unclean(node, status, {0})) else []
        known = int(re.findall(r"autosaved .*: (\d+) keyframes", node.output)[-1])
    camera.child.kill()
    print(f"longest end {longest:.1f} s, {known} keyframes in the map")
    tally("12 signals under load", rounds, rounds - len(bad), lost)
    assert not bad, bad[0]
    assert not lost
    assert known > rounds


def test_a_signal_while_the_node_starts_ends_it_without_a_traceback(domain):
    rounds, seed, bad = count(6, 60), random.Random(1), []
    for turn in range(rounds):
        node = Process(executable(), *ros_arguments())
        time.sleep(seed.uniform(0.2, 3.0))
        number = [signal.SIGINT, signal.SIGTERM][turn % 2]
        status = node.end(number, timeout=LONGEST_S)
        bad += [words] if (words := unclean(node, status, {0, -number})) else []
    tally("12 signals while the node starts", rounds, rounds - len(bad), 0)
    assert not bad, bad[0]


def test_a_soak_whose_node_is_killed_leaves_its_plot_and_does_not_abort(tmp_path):
    soak = Process(sys.executable, "-m", "test.ros.soak", "--seconds", "20", "--output", str(tmp_path / "soak.png"))
    table = tmp_path / "soak.csv"
    wait_until(lambda: table.exists() and len(table.read_text().splitlines()) > 2, 120, "two samples")
    children = Path(f"/proc/{soak.child.pid}/task/{soak.child.pid}/children").read_text().split()
    for child in children:
        if "place_recognizer" in Path(f"/proc/{child}/cmdline").read_text():
            os.kill(int(child), signal.SIGKILL)
    assert soak.wait() == 1
    assert "terminate called" not in soak.output
    assert (tmp_path / "soak.png").stat().st_size > 10_000
