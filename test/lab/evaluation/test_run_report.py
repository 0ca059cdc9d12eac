"""`pnv run --report`: one page with the run, its pictures and its path."""

import re
from pathlib import Path

import pytest

from pnv_cli.main import main

from .places import place, write

SMALL = [
    "--image-width",
    "160",
    "--image-height",
    "112",
    "--patch-sizes",
    "2",
    "--threads",
    "1",
    "--min-interval-s",
    "0",
]


def run(folder: Path, *more: str) -> int:
    where = ["--images", str(folder / "images"), "--csv", str(folder / "out.csv"), "--fps", "1"]
    accepting = ["--exclude-recent-s", "3", "--accept-score", "0.1", "--consistency", "0"]
    return main(["run", *where, *accepting, *SMALL, *more])


@pytest.fixture
def walk(tmp_path: Path) -> Path:
    for i, seed in enumerate((0, 1, 2, 3, 4, 0, 1)):
        write(tmp_path / "images" / f"{i}.png", place(seed, shift=3 * (i > 4)))
    rows = "".join(
        f"{i},{x},{y},0\n" for i, (x, y) in enumerate([(0, 0), (5, 0), (5, 5), (3, 5), (0, 5), (0, 1), (5, 1)])
    )
    (tmp_path / "poses.csv").write_text("timestamp,x,y,z\n" + rows)
    return tmp_path


def test_the_report_shows_closures_pictures_and_path_without_a_network(walk: Path) -> None:
    assert run(walk, "--report", str(walk / "run.html"), "--poses", str(walk / "poses.csv")) == 0
    page = (walk / "run.html").read_text()
    assert "Path and loop closures" in page
    assert "5.png ↔ 0.png" in page
    assert "1.0 m apart" in page
    assert page.count("data:image/jpeg;base64,") >= 2
    assert not re.findall(r"https?://|<script", page)


def test_poses_without_a_report_judge_on_the_terminal(walk: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(walk, "--poses", str(walk / "poses.csv")) == 0
    assert "2 of 2 pairs with poses right, 0 wrong" in capsys.readouterr().out


def test_poses_without_positions_are_refused(walk: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (walk / "poses.csv").write_text("timestamp,lat,lon\n1,2,3\n")
    assert run(walk, "--report", str(walk / "run.html"), "--poses", str(walk / "poses.csv")) == 2
    assert "lacks the column x, y;" in capsys.readouterr().err
