"""The report in a real browser: laid out without sideways scrolling on a phone and on a desk, nothing fetched."""

import re
import shutil
import subprocess
from pathlib import Path

import cv2
import pytest

from pnv_cli.main import main

from .places import place, write

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
FLAGS = [
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--disable-quic",
    "--hide-scrollbars",
    "--allow-file-access-from-files",
]

# A frame of the wished width stands for the phone: a headless window has a least width.
WRAPPER = """<!doctype html><body style="margin:0">
<iframe id="f" src="{page}" style="width:{width}px;height:9000px;border:0"></iframe><pre id="out"></pre><script>
document.getElementById("f").onload = () => {{
  const d = document.getElementById("f").contentDocument;
  const broken = [...d.images].filter(i => i.loading !== "lazy" && !i.naturalWidth).length;
  const fetched = document.getElementById("f").contentWindow.performance.getEntriesByType("resource")
    .filter(e => !e.name.startsWith("data:")).length;
  document.getElementById("out").textContent =
    "scroll " + d.documentElement.scrollWidth + " images " + d.images.length
    + " broken " + broken + " fetched " + fetched;
}};</script></body>"""


def chromium(tmp_path: Path, *more: str) -> str:
    command = [CHROMIUM or "", *FLAGS, f"--user-data-dir={tmp_path / 'profile'}", *more]
    return subprocess.run(command, capture_output=True, text=True, timeout=120).stdout


@pytest.mark.process
@pytest.mark.skipif(CHROMIUM is None, reason="no chromium on this machine")
def test_the_report_fits_a_phone_and_a_desk(tmp_path: Path) -> None:
    rows = ""
    for seed in range(4):
        write(tmp_path / "map" / f"{seed}.png", place(seed))
        write(tmp_path / "asked" / f"{seed}.png", place(seed, shift=4))
        rows += f"asked/{seed}.png,map/{(seed + 1) % 4 if seed == 3 else seed}.png\n"
    (tmp_path / "matches.csv").write_text(f"query,true_refs\n{rows}")
    small = [
        "--image-width",
        "160",
        "--image-height",
        "112",
        "--patch-sizes",
        "2,3",
        "--cache",
        str(tmp_path / "cache"),
    ]
    given = ["--root", str(tmp_path), "--method", "netvlad,multi-rapid,multi-rapid:16"]
    assert main(["evaluate", *given, *small, "--report", str(tmp_path / "report.html")]) == 0
    for width in (390, 1280):
        (tmp_path / "wrapper.html").write_text(WRAPPER.format(page="report.html", width=width))
        page = f"file://{tmp_path / 'wrapper.html'}"
        dom = chromium(tmp_path, "--virtual-time-budget=5000", "--dump-dom", page)
        measured = re.search(r"scroll (\d+) images (\d+) broken (\d+) fetched (\d+)", dom)
        assert measured is not None, dom[-500:]
        scroll, images, broken, fetched = (int(v) for v in measured.groups())
        assert scroll <= width
        assert images >= 5
        assert (broken, fetched) == (0, 0)
    chromium(
        tmp_path, "--window-size=800,1200", f"--screenshot={tmp_path / 's.png'}", f"file://{tmp_path / 'report.html'}"
    )
    shot = cv2.imread(str(tmp_path / "s.png"))
    assert shot is not None
    assert shot.std() > 10  # not a blank page
