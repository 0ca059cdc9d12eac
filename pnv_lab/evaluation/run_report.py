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
from pnv_lab.evaluation.plots import Axis, Series, histogram, path_map, scatter
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
from pnv_lab.poses import PoseTruth

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

    def pair(self, closure: LoopClosure, verdict: str = "") -> NDArray[np.uint8] | None:
        """The picture of a closure with verdict and score burned in, as BGR; None where an image is not kept."""
        query, match = (self._image(ref) for ref in (closure.query, closure.match))
        if query is None or match is None:
            return None
        words = f"{verdict or closure.reason or 'accepted'}, score {closure.score:.3f}"
        return fitted(draw_match(query, match, closure.matches, self.image_size, words))

    def html(self, about: Sequence[tuple[str, str]], truth: PoseTruth | None = None) -> str:
        """The report; `about` are names and values for its head."""
        accepted = [c for c in self.best if c.accepted]
        refused = [c for c in self.best if not c.accepted]
        charts = [self._timeline(accepted, refused), self._scores(accepted, refused)]
        if truth:
            charts.append(self._path(accepted, truth))
        by_score = sorted(accepted, key=lambda c: -c.score)
        wrong = [c for c in by_score if truth and truth.right(*self.frames(c)) is False]
        good = [c for c in by_score if c not in wrong]
        groups = (
            (
                f"Accepted, but wrong by the poses ({truth.rule if truth else ''}): the most certain first",
                wrong[:SHOWN],
            ),
            ("Accepted: the best closure of a query, from the most to the least certain", spread(good)),
            ("Refused: the highest scores", self._refused),
        )
        body = ["<h1>Loop closures of a sequence</h1>", about_lines(about)]
        body.append(f'<div class="charts">{"".join(charts)}</div>')
        for title, closures in groups[0 if wrong else 1 :]:
            pictures = "".join(self._figure(c, truth) for c in closures)
            body.append(f'<h3>{title}</h3><div class="gallery">{pictures or "<p>None.</p>"}</div>')
        return page("Loop closures of a sequence", "".join(body))

    def frames(self, closure: LoopClosure) -> tuple[tuple[str, int], tuple[str, int]]:
        """(name, stamp) of both images."""
        query, match = ((self._name(ref), ref.stamp_ns) for ref in (closure.query, closure.match))
        return query, match

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

    def _path(self, accepted: Sequence[LoopClosure], truth: PoseTruth) -> str:
        """The way of the frames, metres to scale, and every query's best closure coloured by its score."""
        frames = sorted(((n, s) for (_, s), n in self._names.items() if (n, s) in truth.rows), key=lambda f: f[1])
        place = {frame: i for i, frame in enumerate(frames)}
        flat, axes = flattened(truth.poses.positions[[truth.rows[frame] for frame in frames]])
        links, scores = [], []
        for c in accepted:
            ends = [place.get(frame) for frame in self.frames(c)]
            if ends[0] is not None and ends[1] is not None:
                links.append((ends[0], ends[1]))
                scores.append(c.score)
        return f"<div><h3>Path and loop closures</h3>{path_map(flat, links, scores, axes)}</div>"

    def _figure(self, closure: LoopClosure, truth: PoseTruth | None) -> str:
        frames = self.frames(closure)
        right = truth.right(*frames) if truth else None
        verdict = {True: "right", False: "wrong", None: ""}[right]
        drawn = self.pair(closure, verdict)
        if drawn is None:
            return ""
        words = " ↔ ".join(html.escape(name) for name, _ in frames)
        if closure.reason:
            words += f" ({closure.reason})"
        if truth and (apart := truth.apart_m(*frames)) is not None:
            words += f", {apart:.1f} m apart"
        colour = _GREY if right is None else RIGHT if right else WRONG
        image = f'<img loading="lazy" alt="{words}" src="{data_uri(drawn)}">'
        caption = f"{verdict}{', ' * bool(verdict)}score {closure.score:.3f}, {words}"
        return f'<figure style="border-left-color:{colour}">{image}<figcaption>{caption}</figcaption></figure>'
