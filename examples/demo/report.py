"""What the demo says in the end: table, rows, plot of query against match, picture of the best closure."""

import argparse
import sys
import time
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from examples.listener import Heard
from examples.sources import named_frames
from pnv_core import load_describer
from pnv_core.drawing import draw_match
from pnv_core.files import atomic_write
from pnv_core.types import LoopClosure
from pnv_core.verify.reranker import Reranker
from pnv_lab.worlds import Sequence

RADIUS_M, HEADING_DEG = 3.0, 40.0  # a closure is right within these,
SHARED_VIEW = 0.15  # or where each image has this share of its view in common: the least that those have
RIGHT = f"within {RADIUS_M:g} m and {HEADING_DEG:g} degrees, or {SHARED_VIEW:.0%} of the view in common"
LIGHT_AND_LINE = "the second lap has other light, another line and height"
STAGES = " p50, p95, p99 [ms]"  # how the node's diagnostics name what a stage takes


@dataclass
class Run:
    """A played sequence. `truth` is the rendered walk, None where the input is the user's own."""

    truth: Sequence | None
    heard: Heard = field(default_factory=Heard)
    names: dict[int, str] = field(default_factory=dict)  # by stamp
    sent: dict[int, float] = field(default_factory=dict)  # monotonic seconds by stamp
    first_stamp_ns: int | None = None
    _right: dict[tuple[int, int], bool] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.truth is not None:
            self.first_stamp_ns = self.truth.stamps_ns[0]

    def take(self, published: list[dict[str, Any]]) -> None:
        for line in published:
            self.names[line["stamp_ns"]] = line["name"]
            self.sent[line["stamp_ns"]] = line["sent"]
        self.first_stamp_ns = min(self.names, default=0)

    def seconds(self, stamp_ns: int) -> float:
        """Since the first frame; since the epoch while that is not known."""
        return (stamp_ns - (self.first_stamp_ns or 0)) / 1e9

    @property
    def span_s(self) -> float:
        return self.seconds(max(self.names, default=self.first_stamp_ns or 0))

    @cached_property
    def _places(self) -> tuple[dict[int, int], np.ndarray] | None:
        if self.truth is None:
            return None
        numbers = {stamp: number for number, stamp in enumerate(self.truth.stamps_ns)}
        return numbers, self.truth.places(RADIUS_M, HEADING_DEG)

    def knows(self, closure: LoopClosure) -> bool:
        """Whether a closure may be of this run: where the frames are known, only if both images are among them."""
        stamps = closure.query.stamp_ns, closure.match.stamp_ns
        return self._places is None or all(stamp in self._places[0] for stamp in stamps)

    def right(self, closure: LoopClosure) -> bool | None:
        """Whether both images show one place; None where that is not known."""
        if self._places is None:
            return None
        assert self.truth is not None
        numbers, places = self._places
        pair = numbers[closure.query.stamp_ns], numbers[closure.match.stamp_ns]
        if pair not in self._right:
            self._right[pair] = bool(places[pair]) or self.truth.shared_view(*pair) >= SHARED_VIEW
        return self._right[pair]

    def sentence(self) -> str:
        """The outcome in a line that one may repeat."""
        queries = {c.query.stamp_ns for c in self.heard.closures if self.right(c) is not False}
        waited = f", {np.median(self.latencies_ms):.0f} ms after the image" if len(self.latencies_ms) else ""
        found = f"{len(queries)} times the camera came back to a place the node knew, and it said so{waited}"
        if self.truth is None:
            return f"{found}."
        wrong = self.verdicts.count(False)
        return f"{found}: {len(self.verdicts) - wrong} of {len(self.verdicts)} closures right, {wrong or 'none'} wrong."

    @property
    def verdicts(self) -> list[bool | None]:
        return [self.right(closure) for closure in self.heard.closures]

    @property
    def latencies_ms(self) -> np.ndarray:
        """From publishing the image to its result, of every query that had one."""
        both = sorted(set(self.heard.arrived) & set(self.sent))
        return np.array([1e3 * (self.heard.arrived[stamp] - self.sent[stamp]) for stamp in both])


class Shown:
    """What is seen while it runs: every closure as it comes, and in between how far it is.

    On a terminal the last line is redrawn; elsewhere a line is printed every ten seconds.
    """

    def __init__(self, run: Run) -> None:
        self._run, self._terminal = run, sys.stdout.isatty()
        self._printed, self._drawn = time.monotonic(), ""

    def closures(self, closures: list[LoopClosure]) -> None:
        """A query with its closures, best first, each with whether it is right."""
        self.clear()
        places = [self._place(closure) for closure in closures]
        query = self._run.seconds(closures[0].query.stamp_ns)
        more = f"   also {', '.join(places[1:])}" if places[1:] else ""
        print(
            f"  loop closure: {query:7.2f} s is the place of {places[0]}   score {closures[0].score:.3f}{more}",
            flush=True,
        )

    def _place(self, closure: LoopClosure) -> str:
        verdict = {True: " right", False: " WRONG", None: ""}[self._run.right(closure)]
        return f"{self._run.seconds(closure.match.stamp_ns):6.2f} s{verdict}"

    def progress(self, sent: int, node_speaks: bool, ended: bool) -> None:
        """Called a few times a second."""
        heard = self._run.heard
        total = f" of {len(self._run.truth)}" if self._run.truth is not None else ""
        if not sent:
            words = "the camera waits for the node" if node_speaks else "starting the node and the camera"
        else:
            words = "waiting for the last results; " if ended else ""
            words += f"frame {sent}{total}, {heard.count('keyframes')} keyframes, best score of late "
            words += heard.counts.get("best score of late", "none")
        now = time.monotonic()
        if self._terminal:
            if words != self._drawn:
                self.clear()
                print(f"  {words}", end="\r", flush=True)
                self._drawn = words
        elif now - self._printed >= 10.0 or (not sent and words != self._drawn):
            print(f"  {words}", flush=True)
            self._printed, self._drawn = now, words

    def clear(self) -> None:
        """Wipe the redrawn line."""
        if self._terminal and self._drawn:
            print(" " * (len(self._drawn) + 2), end="\r", flush=True)
            self._drawn = ""


def print_table(run: Run) -> None:
    heard, verdicts = run.heard, run.verdicts
    sent = len(run.sent)
    table = {
        "frames sent": f"{sent}",
        "frames processed": f"{heard.count('frames processed')}",
        "frames dropped": f"{sent - heard.count('frames processed')}",
        "keyframes": f"{heard.count('keyframes')}",
        "closures": f"{len(verdicts)}",
    }
    if run.truth is not None:
        table["closures right"] = f"{verdicts.count(True)}   ({RIGHT})"
        table["closures wrong"] = f"{verdicts.count(False)}"
    latency = run.latencies_ms
    if len(latency):
        p50, p95 = np.percentile(latency, [50, 95])
        table["latency"] = (
            f"p50 {p50:.0f} ms, p95 {p95:.0f} ms   (image sent to result received, {len(latency)} queries)"
        )
    for name, value in heard.counts.items():
        if name.endswith(STAGES):
            table[name.removesuffix(STAGES)] = f"{value} ms   (stage: p50, p95, p99)"
    print()
    for name, value in table.items():
        print(f"  {name:<18}{value}")
    print()


def rows(run: Run) -> list[dict[str, Any]]:
    """One per closure, as `pnv run` writes them, and whether it is right."""
    return [
        {
            "query": run.names.get(c.query.stamp_ns, ""),
            "match": run.names.get(c.match.stamp_ns, ""),
            "query_stamp": _seconds(c.query.stamp_ns),
            "match_stamp": _seconds(c.match.stamp_ns),
            "score": f"{c.score:.6f}",
            "similarity": f"{c.similarity:.6f}",
            "spatial": f"{c.spatial:.6f}",
            "inliers": c.inliers,
            "accepted": int(c.accepted),
            "reason": str(c.reason),
            "right": "" if right is None else int(right),
        }
        for c, right in zip(run.heard.closures, run.verdicts, strict=True)
    ]


def _seconds(stamp_ns: int) -> str:
    return f"{stamp_ns // 10**9}.{stamp_ns % 10**9:09d}"


def plot(run: Run, path: Path) -> None:
    """Query time against match time; where the places are known, grey is where closures may lie."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(6.4, 6.0), layout="constrained")
    if run.truth is not None:
        times = [run.seconds(stamp) for stamp in run.truth.stamps_ns]
        places = np.tril(run.truth.places(RADIUS_M, HEADING_DEG))
        shade = np.ma.masked_equal(places.T.astype(float), 0)
        axes.pcolormesh(times, times, shade, cmap="Greys", vmin=0, vmax=4, shading="nearest")
    for label, wanted, colour in (
        ("right", True, "#009e73"),
        ("wrong", False, "#d55e00"),
        ("closure", None, "#0072b2"),
    ):
        chosen = [c for c, verdict in zip(run.heard.closures, run.verdicts, strict=True) if verdict is wanted]
        if chosen:
            x, y = (np.array([run.seconds(getattr(c, side).stamp_ns) for c in chosen]) for side in ("query", "match"))
            axes.scatter(x, y, 14, colour, label=f"{label} ({len(chosen)})", zorder=3)
    axes.plot([0, run.span_s], [0, run.span_s], color="0.6", linewidth=0.8)
    axes.set(xlabel="time of the query [s]", ylabel="time of the matched keyframe [s]", aspect="equal")
    if run.heard.closures:
        axes.legend(loc="upper left")
    buffer = _figure_png(figure)
    plt.close(figure)
    with atomic_write(path) as file:
        file.write(buffer)


def _figure_png(figure: Any) -> bytes:
    from io import BytesIO

    buffer = BytesIO()
    figure.savefig(buffer, format="png", dpi=110)
    return buffer.getvalue()


def write_match(run: Run, args: argparse.Namespace, path: Path) -> None:
    """The best closure: both images with their patch matches."""
    best = max(run.heard.closures, key=lambda closure: closure.score)
    wanted = {best.query.stamp_ns, best.match.stamp_ns}
    images: dict[int, np.ndarray] = {}
    if run.truth is not None:
        images = {stamp: run.truth[run.truth.stamps_ns.index(stamp)].rgb for stamp in wanted}
    else:
        for _, frame in named_frames(args):
            if frame.stamp_ns in wanted:
                images[frame.stamp_ns] = frame.rgb
            if len(images) == 2:
                break
    query, reference = images[best.query.stamp_ns], images[best.match.stamp_ns]
    describer = load_describer("default")
    result = Reranker(describer.config).score(describer.describe(query), describer.describe(reference))
    caption = f"score {best.score:.3f}"
    picture = draw_match(query, reference, result.matches, describer.image_size, caption)
    ok, png = cv2.imencode(".png", picture[..., ::-1])
    assert ok
    with atomic_write(path) as file:
        file.write(png.tobytes())
