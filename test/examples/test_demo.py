"""The demo, as a user starts it: node and publisher as processes of their own, the middleware between them."""

import csv
import os
import subprocess
import sys
from pathlib import Path

import cv2
import pytest

ROOT = Path(__file__).resolve().parents[2]
pytestmark = pytest.mark.process


def _demo(out: Path, *flags: str) -> subprocess.CompletedProcess:
    environment = {key: value for key, value in os.environ.items() if key != "ROS_DOMAIN_ID"}
    command = [sys.executable, "-m", "examples.demo", "--out", str(out), *flags]
    return subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=400)


def test_a_second_visit_is_found_and_reported(tmp_path: Path) -> None:
    flags = ["--world", "office", "--laps", "1.4", "--speed", "1.6", "--exclude-recent-s", "12"]
    done = _demo(tmp_path, *flags, "--playback", "3")
    assert done.returncode == 0, done.stdout + done.stderr
    assert "loop closure:" in done.stdout
    assert "frames dropped" in done.stdout
    assert "p95" in done.stdout
    rows = list(csv.DictReader((tmp_path / "loop_closures.csv").open()))
    assert len(rows) == done.stdout.count("loop closure:") + sum(
        int(line.split("and ")[1].split()[0]) for line in done.stdout.splitlines() if " more" in line
    )
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
