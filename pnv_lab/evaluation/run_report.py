"""The report of a sequence: what the recogniser said of every frame, with pictures and, given poses, the path."""

import html
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from pnv_core.drawing import draw_match
from pnv_core.images import read_image
from pnv_core.types import Frame, LoopClosure
from pnv_lab.evaluation.datasets.tables import number, rows
from pnv_lab.evaluation.report import (
    PICTURE_SIZE,
    RIGHT,
    SHOWN,
    WRONG,
    about_lines,
    data_uri,
    fitted,
    flattened,
    page,
    spread,
)
from pnv_lab.evaluation.svg import Axis, Series, histogram, path_map, scatter

_GREY = "#8a94a0"
_BINS = 24
_FAR_S = 0.1  # between a frame and its pose


class RunRecorder:
    """Collects a run for its report; small pictures of the frames wait on the disk until `html` is called."""

    def __init__(self, image_size: tuple[int, int]) -> None:
        self.image_size = image_size
        self.frames = 0
        self.best: list[LoopClosure] = []
        self._refused: list[LoopClosure] = []  # with their matches, for the pictures
        self._names: dict[int, str] = {}
        self._folder = tempfile.TemporaryDirectory(prefix="pnv_run_")

    def add(self, name: str, frame: Frame, closures: Sequence[LoopClosure]) -> None:
        """A processed frame with its candidates, best first."""
        self.frames += 1
        self._names[frame.stamp_ns] = name
        small = cv2.resize(frame.rgb, PICTURE_SIZE, interpolation=cv2.INTER_AREA)
        cv2.imwrite(str(self._picture(frame.stamp_ns)), cv2.cvtColor(small, cv2.COLOR_RGB2BGR))
        accepted = [c for c in closures if c.accepted]
        if accepted:
            self.best.append(accepted[0])
        elif closures:
            self.best.append(replace(closures[0], matches=()))
            self._refused = sorted([*self._refused, closures[0]], key=lambda c: -c.score)[:SHOWN]

    def html(self, about: Sequence[tuple[str, str]], poses: Mapping[int, NDArray[np.float64]] | None = None) -> str:
        """The report; `poses` gives positions (3,) in metres by stamp."""
        accepted = [c for c in self.best if c.accepted]
        refused = [c for c in self.best if not c.accepted]
        facts = f"{self.frames} frames, {len(self.best)} queries with a candidate, {len(accepted)} loop closures."
        charts = [self._timeline(accepted, refused), self._scores(accepted, refused)]
        if poses:
            charts.append(self._path(accepted, poses))
        by_score = sorted(accepted, key=lambda c: -c.score)
        groups = (
            ("Accepted: from the most to the least certain", spread(by_score), RIGHT),
            ("Refused: the highest scores", self._refused, WRONG),
        )
        body = ["<h1>Loop closures of a sequence</h1>", about_lines(about), f"<p>{facts}</p>"]
        body.append(f'<div class="charts">{"".join(charts)}</div>')
        for title, closures, colour in groups:
            pictures = "".join(self._figure(c, colour, poses) for c in closures)
            body.append(f'<h3>{title}</h3><div class="gallery">{pictures or "<p>None.</p>"}</div>')
        return page("Loop closures of a sequence", "".join(body))

    def close(self) -> None:
        """Remove the pictures."""
        self._folder.cleanup()

    def _picture(self, stamp_ns: int) -> Path:
        return Path(self._folder.name) / f"{stamp_ns}.jpg"

    def _timeline(self, accepted: Sequence[LoopClosure], refused: Sequence[LoopClosure]) -> str:
        """Time of the match against time of the query, for every best candidate."""
        start = min(self._names, default=0) / 1e9
        last = max(max(self._names, default=0) / 1e9 - start, 1e-3)
        series = [
            Series(name, [(c.query.stamp_ns / 1e9 - start, c.match.stamp_ns / 1e9 - start) for c in closures])
            for name, closures in (("refused", refused), ("accepted", accepted))
        ]
        axes = Axis("time of the query, s", 0, last), Axis("time of the match, s", 0, last)
        return f"<div><h3>Which time came back when</h3>{scatter(series, *axes, (_GREY, RIGHT), 3)}</div>"

    def _scores(self, accepted: Sequence[LoopClosure], refused: Sequence[LoopClosure]) -> str:
        edges = np.linspace(0, 1, _BINS + 1)
        groups = [
            (name, np.histogram([c.score for c in closures], edges)[0].tolist())
            for name, closures in (("accepted", accepted), ("refused", refused))
        ]
        chart = histogram(groups, Axis("score of the best candidate", 0, 1), (RIGHT, _GREY))
        return f"<div><h3>Scores</h3>{chart}</div>"

    def _path(self, accepted: Sequence[LoopClosure], poses: Mapping[int, NDArray[np.float64]]) -> str:
        stamps = sorted(poses)
        row = {stamp: i for i, stamp in enumerate(stamps)}
        flat = flattened(np.array([poses[s] for s in stamps]))
        links = [
            (row[c.query.stamp_ns], row[c.match.stamp_ns], RIGHT)
            for c in accepted
            if c.query.stamp_ns in row and c.match.stamp_ns in row
        ]
        return f"<div><h3>Path and loop closures</h3>{path_map(flat, links)}</div>"

    def _figure(self, closure: LoopClosure, colour: str, poses: Mapping[int, NDArray[np.float64]] | None) -> str:
        stamps = closure.query.stamp_ns, closure.match.stamp_ns
        images = []
        for stamp in stamps:
            if not self._picture(stamp).is_file():
                return ""  # a keyframe of a loaded map: its picture is not part of this run
            images.append(read_image(self._picture(stamp)))
        drawn = draw_match(images[0], images[1], closure.matches, self.image_size, f"score {closure.score:.3f}")
        words = " ↔ ".join(html.escape(self._names.get(s, str(s))) for s in stamps)
        if closure.reason:
            words += f" ({closure.reason})"
        if poses and all(s in poses for s in stamps):
            words += f", {np.linalg.norm(poses[stamps[0]] - poses[stamps[1]]):.1f} m apart"
        image = f'<img loading="lazy" alt="{words}" src="{data_uri(fitted(drawn))}">'
        return f'<figure style="border-left-color:{colour}">{image}<figcaption>{words}</figcaption></figure>'


def read_positions(path: Path, stamps: Sequence[int]) -> dict[int, NDArray[np.float64]]:
    """Positions (3,) nearest in time to each stamp, from a csv of timestamp,x,y,z in seconds and metres.

    Stamps without a position within 0.1 s are left out. Raises PnvError for another file.
    """
    table = rows(path, ("timestamp", "x", "y", "z"))
    times = np.array([number(path, row, "timestamp") for row in table])
    at = np.array([[number(path, row, axis) for axis in "xyz"] for row in table])
    found = {}
    for stamp in stamps if len(times) else ():
        nearest = int(np.abs(times - stamp / 1e9).argmin())
        if abs(times[nearest] - stamp / 1e9) <= _FAR_S:
            found[stamp] = at[nearest]
    return found
