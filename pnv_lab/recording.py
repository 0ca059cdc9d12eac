"""A run as a recording for the rerun viewer (extra `rerun`): images, scores, path and closures over time.

The page of `pnv_view` watches a robot with nothing but a browser; this keeps a run, to be gone through frame by frame.
"""

import os
from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from pnv_core.types import Frame, ImageRef, LoopClosure

_TIMELINE = "time"  # seconds since the first frame
_WIDTH = 640  # of pictures, in pixels
_BLUE, _ORANGE, _GREY = (0, 114, 178), (213, 94, 0), (138, 148, 160)

Point = NDArray[np.float64]  # (3,) in metres


class Recording:
    """Writes beside `path` while the run goes on; `close` renames it."""

    def __init__(self, path: Path, accept_score: float) -> None:
        self._path, self._part = path, path.with_name(f".{path.name}.part")
        self._stream = rr.RecordingStream("pnv_run")
        self._stream.save(self._part, default_blueprint=_layout())
        self._bar, self._first_ns = accept_score, 0
        self._started = False
        for entity, name, colour in (
            ("score/best", "best candidate", _BLUE),
            ("score/bar", "accepted from", _ORANGE),
            ("similarity/best", "similarity", _BLUE),
        ):
            self._stream.log(entity, rr.SeriesLines(colors=colour, names=name), static=True)

    def add(self, frame: Frame, closures: Sequence[LoopClosure], pair: NDArray[np.uint8] | None) -> None:
        """A processed frame with its candidates, best first; `pair` is the picture (BGR) of the best one."""
        if not self._started:
            self._first_ns, self._started = frame.stamp_ns, True
        self._at(frame.stamp_ns)
        self._picture("image", cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2BGR).astype(np.uint8))
        if closures:
            best = closures[0]
            self._stream.log("score/best", rr.Scalars(best.score))
            self._stream.log("score/bar", rr.Scalars(self._bar))
            self._stream.log("similarity/best", rr.Scalars(best.similarity))
        if pair is not None:
            self._picture("match", pair)

    def path(
        self,
        way: Sequence[tuple[int, Point]],
        closures: Sequence[LoopClosure],
        place_of: Callable[[ImageRef], Point | None],
    ) -> None:
        """The way as (stamp, position in metres), and the accepted closures between places."""
        self._stream.log("path", rr.LineStrips3D([[p for _, p in way]], colors=_GREY), static=True)
        for stamp_ns, position in way:
            self._at(stamp_ns)
            self._stream.log("path/camera", rr.Points3D([position], colors=_ORANGE, radii=rr.Radius.ui_points(5)))
        by_stamp: dict[int, list[list[Point]]] = {}
        for closure in closures:
            ends = [place_of(ref) for ref in (closure.query, closure.match)]
            if ends[0] is not None and ends[1] is not None:
                by_stamp.setdefault(closure.query.stamp_ns, []).append([ends[0], ends[1]])
        for stamp_ns, lines in by_stamp.items():
            self._at(stamp_ns)
            self._stream.log("path/closures", rr.LineStrips3D(lines, colors=_BLUE))

    def close(self) -> None:
        """Finish the file."""
        self._stream.disconnect()
        os.replace(self._part, self._path)

    def _at(self, stamp_ns: int) -> None:
        self._stream.set_time(_TIMELINE, duration=(stamp_ns - self._first_ns) / 1e9)

    def _picture(self, entity: str, bgr: NDArray[np.uint8]) -> None:
        scale = min(1.0, _WIDTH / bgr.shape[1])
        small = cv2.resize(bgr, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        held = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, 80])[1].tobytes()
        self._stream.log(entity, rr.EncodedImage(contents=held, media_type="image/jpeg"))


def _layout() -> rrb.Blueprint:
    so_far = rrb.VisibleTimeRange(
        _TIMELINE, start=rrb.TimeRangeBoundary.infinite(), end=rrb.TimeRangeBoundary.cursor_relative()
    )
    return rrb.Blueprint(
        rrb.Vertical(
            rrb.Horizontal(
                rrb.Spatial2DView(origin="image", name="image"),
                rrb.Spatial2DView(origin="match", name="image and best candidate"),
                column_shares=[1, 2],
            ),
            rrb.Horizontal(
                rrb.Spatial3DView(
                    origin="path",
                    contents=["$origin", "$origin/camera", "$origin/closures"],
                    name="path and closures so far",
                    overrides={"path/closures": [rrb.VisibleTimeRanges([so_far])]},
                ),
                rrb.Vertical(
                    rrb.TimeSeriesView(origin="score", name="score against the bar"),
                    rrb.TimeSeriesView(origin="similarity", name="similarity of the best candidate"),
                ),
            ),
            row_shares=[1, 1],
        ),
        collapse_panels=True,
    )
