"""The report of a sequence: what the recogniser said of every frame, with pictures and, given poses, the path."""

import html
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from pnv_core.drawing import draw_match
from pnv_core.images import decode_image, read_image
from pnv_core.types import Frame, ImageRef, LoopClosure
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
from pnv_lab.evaluation.svg import Axis, Series, histogram, legend, path_map, scatter, score_colour
from pnv_lab.poses import Poses

_GREY = "#8a94a0"
_BINS = 24

Key = tuple[str, int]  # camera and stamp of a frame


class RunRecorder:
    """Collects a run for its report; small pictures of the frames wait on the disk until `html` is called."""

    def __init__(self, image_size: tuple[int, int], session: int, kept_picture: Callable[[ImageRef], bytes]) -> None:
        self.image_size = image_size
        self.best: list[LoopClosure] = []
        self._session, self._kept_picture = session, kept_picture  # for keyframes of a loaded map
        self._refused: list[LoopClosure] = []  # with their matches, for the pictures
        self._names: dict[Key, str] = {}
        self._folder = tempfile.TemporaryDirectory(prefix="pnv_run_")

    def add(self, name: str, frame: Frame, closures: Sequence[LoopClosure]) -> None:
        """A processed frame with its candidates, best first."""
        self._names[frame.camera, frame.stamp_ns] = name
        small = cv2.resize(frame.rgb, PICTURE_SIZE, interpolation=cv2.INTER_AREA)
        cv2.imwrite(str(self._picture(name)), cv2.cvtColor(small, cv2.COLOR_RGB2BGR))
        accepted = [c for c in closures if c.accepted]
        if accepted:
            self.best.append(accepted[0])
        elif closures:
            self.best.append(replace(closures[0], matches=()))
            self._refused = sorted([*self._refused, closures[0]], key=lambda c: -c.score)[:SHOWN]

    def html(self, about: Sequence[tuple[str, str]], poses: Poses | None = None) -> str:
        """The report; `about` are names and values for its head. Raises PnvError for poses of no frame."""
        accepted = [c for c in self.best if c.accepted]
        refused = [c for c in self.best if not c.accepted]
        rows = poses.of_frames((name, stamp) for (_, stamp), name in self._names.items()) if poses else {}
        charts = [self._timeline(accepted, refused), self._scores(accepted, refused)]
        if poses:
            charts.append(self._path(accepted, poses, rows))
        by_score = sorted(accepted, key=lambda c: -c.score)
        groups = (
            ("Accepted: the best closure of a query, from the most to the least certain", spread(by_score), RIGHT),
            ("Refused: the highest scores", self._refused, WRONG),
        )
        body = ["<h1>Loop closures of a sequence</h1>", about_lines(about)]
        body.append(f'<div class="charts">{"".join(charts)}</div>')
        for title, closures, colour in groups:
            pictures = "".join(self._figure(c, colour, poses, rows) for c in closures)
            body.append(f'<h3>{title}</h3><div class="gallery">{pictures or "<p>None.</p>"}</div>')
        return page("Loop closures of a sequence", "".join(body))

    def close(self) -> None:
        """Remove the pictures."""
        self._folder.cleanup()

    def _picture(self, name: str) -> Path:
        return Path(self._folder.name) / f"{name.replace('/', '_')}.jpg"

    def _name(self, ref: ImageRef) -> str:
        known = self._names.get((ref.camera, ref.stamp_ns)) if ref.session == self._session else None
        return known or f"map:{ref.session}:{ref.stamp_ns / 1e9:.3f}"

    def _image(self, ref: ImageRef) -> NDArray[np.uint8] | None:
        """The small picture of a frame of this run, or what a loaded map keeps of a keyframe."""
        if ref.session == self._session:
            return read_image(self._picture(self._name(ref)))
        kept = self._kept_picture(ref)
        return decode_image(kept, self._name(ref)) if kept else None

    def _timeline(self, accepted: Sequence[LoopClosure], refused: Sequence[LoopClosure]) -> str:
        """Time of the match against time of the query, for every best candidate."""
        stamps = [s for _, s in self._names] + [c.match.stamp_ns for c in (*accepted, *refused)]
        start = min(stamps, default=0) / 1e9
        last = max(max(stamps, default=0) / 1e9 - start, 1e-3)
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

    def _path(self, accepted: Sequence[LoopClosure], poses: Poses, rows: dict[tuple[str, int], int]) -> str:
        """The way of the frames, metres to scale, and every query's best closure coloured by its score."""
        frames = [(key, row) for (_, s), n in sorted(self._names.items(), key=lambda item: item[0][1])
                  if (row := rows.get(key := (n, s))) is not None]  # fmt: skip
        place = {key: i for i, (key, _) in enumerate(frames)}
        flat, axes = flattened(poses.positions[[row for _, row in frames]])
        links = []
        for c in accepted:
            ends = [place.get((self._name(ref), ref.stamp_ns)) for ref in (c.query, c.match)]
            if ends[0] is not None and ends[1] is not None:
                links.append((ends[0], ends[1], score_colour(c.score)))
        scores = ", ".join(f"score {score}" for score in ("0.5", "0.75", "1"))
        colours = legend(scores.split(", "), [score_colour(score) for score in (0.5, 0.75, 1.0)])
        return f"<div><h3>Path and loop closures</h3>{path_map(flat, links, axes, colours)}</div>"

    def _figure(self, closure: LoopClosure, colour: str, poses: Poses | None, rows: dict[tuple[str, int], int]) -> str:
        refs = closure.query, closure.match
        query, match = (self._image(ref) for ref in refs)
        if query is None or match is None:
            return ""
        drawn = draw_match(query, match, closure.matches, self.image_size, f"score {closure.score:.3f}")
        words = " ↔ ".join(html.escape(self._name(ref)) for ref in refs)
        if closure.reason:
            words += f" ({closure.reason})"
        taken = [rows.get((self._name(ref), ref.stamp_ns)) for ref in refs]
        if poses and taken[0] is not None and taken[1] is not None:
            words += f", {np.linalg.norm(poses.positions[taken[0]] - poses.positions[taken[1]]):.1f} m apart"
        image = f'<img loading="lazy" alt="{words}" src="{data_uri(fitted(drawn))}">'
        caption = f"score {closure.score:.3f}, {words}"
        return f'<figure style="border-left-color:{colour}">{image}<figcaption>{caption}</figcaption></figure>'
