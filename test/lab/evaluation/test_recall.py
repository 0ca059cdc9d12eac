"""`pnv recall`: the contract of its inputs, its last line, and its refusals."""

import json
from pathlib import Path

import pytest

from pnv_cli.main import main

from .places import place, write

FLAGS = ["--image-width", "160", "--image-height", "112", "--patch-sizes", "2,4", "--threads", "1", "--scorer", "rapid"]


@pytest.fixture
def world(tmp_path: Path) -> Path:
    for seed in range(6):
        write(tmp_path / "map" / "sub" / f"{seed}.png", place(seed))
    for seed in range(4):
        write(tmp_path / "asked" / f"{seed}.png", place(seed, shift=4, gain=0.9))
    (tmp_path / "matches.csv").write_text(
        "query,true_refs\n"
        "asked/0.png,map/sub/0.png\n"
        "asked/1.png,map/sub/5.png;map/sub/1.png\n"
        "asked/2.png,map/sub/4.png\n"  # wrong on purpose: the picture is that of map/sub/2.png
        "asked/3.png,\n"
    )
    return tmp_path


def recall(folder: Path, *more: str) -> int:
    places = {"queries": "asked", "references": "map", "matches": "matches.csv", "cache": "cache"}
    given = [word for flag, name in places.items() for word in (f"--{flag}", str(folder / name))]
    return main(["recall", *given, *FLAGS, *more])


def test_the_last_line_holds_the_figures_after_and_before_reranking(
    world: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert recall(world) == 0
    last = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert set(last) == {"recall@1", "recall@5", "recall@10", "queries", "global"}
    assert last["queries"] == 3
    assert last["recall@1"] == pytest.approx(2 / 3, abs=1e-6)
    assert last["recall@10"] == 1.0
    assert set(last["global"]) == {"recall@1", "recall@5", "recall@10"}


def test_a_second_run_reads_the_cache_and_says_the_same(world: Path, capsys: pytest.CaptureFixture[str]) -> None:
    recall(world)
    first = capsys.readouterr().out
    stamps = {p: p.stat().st_mtime_ns for p in (world / "cache").rglob("*.npz")}
    assert len(stamps) == 9  # six references and the three queries that count
    recall(world)
    assert capsys.readouterr().out == first
    assert {p: p.stat().st_mtime_ns for p in (world / "cache").rglob("*.npz")} == stamps


def test_an_image_is_never_found_by_itself(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for seed in range(3):
        write(tmp_path / "asked" / f"{seed}.png", place(seed))
        write(tmp_path / "asked" / f"again{seed}.png", place(seed, shift=4))
    rows = "".join(f"asked/{s}.png,asked/again{s}.png\n" for s in range(3))
    (tmp_path / "matches.csv").write_text(f"query,true_refs\n{rows}")
    (tmp_path / "map").symlink_to(tmp_path / "asked")
    assert recall(tmp_path) == 0
    assert json.loads(capsys.readouterr().out.splitlines()[-1])["recall@1"] == 1.0


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        ("query,true_refs\nasked/9.png,map/sub/0.png\n", "line 2: asked/9.png: no such image"),
        ("query,true_refs\nasked/0.png,map/0.png\n", "line 2: map/0.png: no such image"),
        ("query,refs\nasked/0.png,map/sub/0.png\n", "allowed: query, true_refs"),
        ("", "has the columns none"),
    ],
)
def test_a_wrong_matches_file_is_refused_in_one_line(
    world: Path, capsys: pytest.CaptureFixture[str], content: str, complaint: str
) -> None:
    (world / "matches.csv").write_text(content)
    assert recall(world) == 2
    captured = capsys.readouterr()
    assert complaint in captured.err
    assert captured.err.count("\n") == 1
    assert captured.out == ""


def test_missing_folders_are_refused_in_one_line(world: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert recall(world, "--references", str(world / "nowhere")) == 2
    assert "nowhere: no such folder of images" in capsys.readouterr().err
    assert recall(world, "--matches", str(world / "nothing.csv")) == 2
    assert "nothing.csv" in capsys.readouterr().err
