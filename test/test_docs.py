"""The documentation's code runs: console blocks in order, python blocks, and the flags of every other `pnv` line."""

import argparse
import re
import shlex
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from pnv_cli.main import COMMANDS, main
from pnv_core.config import Config
from pnv_core.describe.describer import load_describer
from pnv_core.maps import MapStore
from pnv_core.recognizer import PlaceRecognizer
from pnv_core.settings import settings_of
from pnv_core.types import Frame
from pnv_ros.node_config import NodeConfig
from test.lab.evaluation.places import place, write

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
ELSEWHERE = (
    "make",
    "ros2",
    "git",
    "pip",
    "cd",
    "source",
    "sudo",
    "docker",
    "place_recognizer",
    "chromium",
    "python",
    "python3",
    "rerun",
)
NEEDS_NETWORK = ("pnv weights fetch", "pnv doctor")  # the doctor also needs a middleware of its own; tested elsewhere
BLOCK = re.compile(r"^```(\w+)[^\n]*\n(.*?)^```", re.M | re.S)


def blocks(page: Path) -> list[tuple[str, str]]:
    """(language, text) of every fenced block."""
    return BLOCK.findall(page.read_text())


def commands(text: str, prompt: str) -> Iterator[str]:
    """The commands of a block, continuation lines joined."""
    joined = re.sub(r"\\\n\s*", " ", text)
    for line in joined.splitlines():
        if line.startswith(prompt) and line.removeprefix(prompt).strip():
            yield line.removeprefix(prompt).split("  #")[0].strip()


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working folder with everything the documentation's examples name."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("pnv_lab.evaluation.store.default_cache", lambda: tmp_path / "cache")
    walk = [place(s % 8, shift=3 * (s > 7), width=192, height=144) for s in range(16)]
    for name in ("DIR", "images"):
        for i, rgb in enumerate(walk):
            write(tmp_path / name / f"{i:04}.png", rgb)
    rows = "".join(f"{i:04}.png,{i},{3 * (i % 8)},0,0,0\n" for i in range(16))
    (tmp_path / "poses.csv").write_text("frame,timestamp,x,y,z,yaw\n" + rows)
    (tmp_path / "times.csv").write_text("frame,timestamp\n" + "".join(f"{i:04}.png,{4 * i}\n" for i in range(16)))
    lines = ""
    for base in (tmp_path, tmp_path / "places"):
        for i in range(8):
            write(base / "Q" / f"{i}.jpg", walk[8 + i])
            write(base / "R" / f"{i}.jpg", walk[i])
        lines = "".join(f"Q/{i}.jpg,R/{i}.jpg\n" for i in range(8))
        (base / "matches.csv").write_text("query,true_refs\n" + lines)
    for name, rgb in (("A.jpg", walk[0]), ("B.jpg", walk[8])):
        write(tmp_path / name, rgb)
    return tmp_path


@pytest.mark.parametrize("page", PAGES, ids=lambda p: str(p.relative_to(ROOT)))
def test_the_code_of_a_page_runs(page: Path, folder: Path) -> None:
    names = given_names() if any(language == "python" for language, _ in blocks(page)) else {}
    for language, text in blocks(page):
        if language == "console":
            for command in commands(text, "$ "):
                run(command)
        elif language == "python":
            exec(compile(text, str(page), "exec"), names)
        elif language == "bash":
            for command in commands(text, ""):
                if command.startswith("pnv "):
                    parsed(command)


def given_names() -> dict[str, object]:
    """What the documentation's Python takes for granted."""
    frames = [(i * 40 * 10**9, np.asarray(place(i % 2))) for i in range(4)]
    describer = load_describer()
    recognizer = PlaceRecognizer(describer)
    closures = [c for stamp, rgb in frames for c in recognizer.process(Frame(stamp, "/camera/image_raw", rgb))]
    MapStore("office.map", describer.map_fingerprint).save(recognizer.database.snapshot())
    camera = {"fx": 300.0, "fy": 300.0, "cx": 80.0, "cy": 60.0, "width": 160}
    publisher = SimpleNamespace(publish=lambda message: None)
    return {
        **camera,
        "frames": frames,
        "describer": describer,
        "recognizer": recognizer,
        "closure": closures[-1],
        "depth": None,
        "publisher": publisher,
        "send": lambda pairs: None,
    }


def run(command: str) -> None:
    """A `pnv` command in this process, with exit code 0; other programs are known but not run."""
    if command.startswith(NEEDS_NETWORK):
        parsed(command)
    elif command.startswith("pnv "):
        assert main(shlex.split(command)[1:]) == 0, command
    else:
        assert command.split()[0] in ELSEWHERE, f"the documentation runs {command!r}, which this test does not know"


def parsed(command: str) -> None:
    """The command's flags exist."""
    parser = argparse.ArgumentParser(prog="pnv", allow_abbrev=False, exit_on_error=False)
    subparsers = parser.add_subparsers(required=True)
    for name in COMMANDS:
        import_module(f"pnv_cli.{name}").add_parser(subparsers)
    parser.parse_args(shlex.split(command)[1:])


@pytest.mark.parametrize("page", PAGES, ids=lambda p: str(p.relative_to(ROOT)))
def test_node_parameters_in_a_page_exist(page: Path) -> None:
    known = {"use_sim_time", *settings_of(Config), *settings_of(NodeConfig)}
    named = set(re.findall(r"-p (\w+):=", page.read_text()))
    assert named <= known, named - known


@pytest.mark.parametrize("page", PAGES, ids=lambda p: str(p.relative_to(ROOT)))
def test_links_between_pages_lead_somewhere(page: Path) -> None:
    for target in re.findall(r"\]\(([^)#\s]+)(?:#[^)]*)?\)", page.read_text()):
        if not target.startswith(("http://", "https://")):
            assert (page.parent / target).exists(), f"{page.name} links to {target}"
