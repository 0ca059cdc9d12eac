"""Two robots that share places against one robot that drives both their laps: python -m benchmarks.fleet robots.

Every other lap is another robot's. What each robot's images show is known; the fleet is a served Milvus Lite, asked
and filled through the threads, outbox and store of the node, and waited for after each keyframe.
"""

import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.closure_sets import FALSE, IGNORE, NARROW, TRUE, TruthSequence, sequence
from benchmarks.closures import RememberedDescriber, small_motion
from benchmarks.fleet import served
from pnv_core.describe.describer import Describer, load_describer
from pnv_core.recognizer import PlaceRecognizer
from pnv_core.types import Frame, LoopClosure
from pnv_fleet.fleet import Fleet, Options
from pnv_lab.worlds import loop_sequence

SETS = ("donkey", "world_corridor", "world_hall", "world_street", "world_office")
_LAP_S = 14.6  # of donkey_desks_laps
_ANSWER_S = 60.0


@dataclass
class Counts:
    """Accepted closures by truth, and which of the queries were closed rightly. Q = queries with a true keyframe."""

    right: int = 0
    wrong: int = 0
    right_across: int = 0  # of these, with the other robot's laps
    wrong_across: int = 0
    found: list[bool] = field(default_factory=list)  # Q long
    found_across: list[bool] = field(default_factory=list)  # by a match of the other robot's laps

    def add(self, label: int, across: bool) -> None:
        """An accepted closure."""
        self.right += label == TRUE
        self.wrong += label == FALSE
        self.right_across += across and label == TRUE
        self.wrong_across += across and label == FALSE

    @property
    def precision(self) -> float:
        return self.right / max(self.right + self.wrong, 1)

    @property
    def precision_across(self) -> float:
        return self.right_across / max(self.right_across + self.wrong_across, 1)


def robots(names: list[str], shared: Path) -> int:
    """0 where closures between two robots are as right as those of one, and as many revisits found but for 5 points."""
    print("                                  all closures              with the other's laps")
    print("set             robots   queries  right  wrong  precision  recall  right  wrong  precision  recall")
    describer, good = load_describer("default"), True
    for name in names:
        images, laps = _laps(name, shared)
        one = _one(images, laps, describer)
        with served() as server:
            two = _two(server.uri, images, laps, describer)
        for words, counts in (("one", one), ("two", two)):
            found, across = (float(np.mean(c)) if c else float("nan") for c in (counts.found, counts.found_across))
            print(f"{name:<16}{words:<9}{len(counts.found):>7}{counts.right:>7}{counts.wrong:>7}"
                  f"{counts.precision:>11.3f}{found:>8.3f}{counts.right_across:>7}{counts.wrong_across:>7}"
                  f"{counts.precision_across:>11.3f}{across:>8.3f}", flush=True)  # fmt: skip
        good = good and two.precision_across >= one.precision_across
        good = good and np.mean(two.found_across) >= np.mean(one.found_across) - 0.05
    return int(not good)


def _laps(name: str, shared: Path) -> tuple[TruthSequence, NDArray[np.int64]]:
    """A sequence of known truth and the lap (n,) of each of its images."""
    if name == "donkey":
        images = sequence(name, shared)
        return images, (images.stamps // _LAP_S).astype(np.int64)
    walk = loop_sequence(7, name.removeprefix("world_"), laps=2.0, fps=0.8, light_change=0.6)
    near, far = walk.places(2.0, 30.0), walk.places(6.0, 60.0)
    stamps = np.array(walk.stamps_ns) / 1e9 - walk.stamps_ns[0] / 1e9
    truth = np.where(near, TRUE, np.where(far, IGNORE, FALSE))
    keys = [f"{name}/two laps/{i}" for i in range(len(walk))]
    images = TruthSequence(name, keys, stamps, lambda q, c: int(truth[q, c]), 15.0, read=lambda i: walk[i].rgb)
    return images, (np.arange(len(walk)) * 2 // len(walk)).astype(np.int64)


def _remembered(images: TruthSequence, describer: Describer) -> RememberedDescriber:
    remembered = RememberedDescriber(describer, images, Path(tempfile.gettempdir()) / "pnv_closures")
    remembered.config = describer.config.replace(exclude_recent_s=images.exclude_recent_s)
    return remembered


class _Marks:
    """Closures of queries by the truth of the images, once both images' numbers are known. Keyed by (robot, stamp)."""

    def __init__(self, images: TruthSequence, laps: NDArray[np.int64]) -> None:
        self._images, self._laps = images, laps
        self._number = {round(s * 1e9): i for i, s in enumerate(images.stamps)}
        self._seen: list[int] = []
        self.counts = Counts()

    def _label(self, i: int, j: int) -> int:
        images = self._images
        label = images.truth(i, j)
        known = label != FALSE or images.name not in NARROW or not small_motion(images.read(i), images.read(j))
        return label if known else IGNORE  # as `benchmarks.closures judge` counts

    def count(self, i: int, closures: list[LoopClosure]) -> None:
        """Closures of image i, which is a keyframe from now on."""
        images, laps = self._images, self._laps
        old = [j for j in self._seen if images.stamps[j] <= images.stamps[i] - images.exclude_recent_s]
        self._seen.append(i)
        if images.queries is not None and not images.queries[i]:
            return
        matches = [self._number[c.match.stamp_ns] for c in closures if c.accepted]
        labels = {j: self._label(i, j) for j in matches if j in old}  # recent ones show the same by being near in time
        for j, label in labels.items():
            self.counts.add(label, _other(laps, i, j))
        if any(images.truth(i, j) == TRUE for j in old if _other(laps, i, j)):
            true = [j for j, label in labels.items() if label == TRUE]
            self.counts.found.append(bool(true))
            self.counts.found_across.append(any(_other(laps, i, j) for j in true))


def _other(laps: NDArray[np.int64], i: int, j: int) -> bool:
    """Whether two images are of different robots."""
    return bool(laps[i] % 2 != laps[j] % 2)


def _one(images: TruthSequence, laps: NDArray[np.int64], describer: Describer) -> Counts:
    remembered = _remembered(images, describer)
    recognizer = PlaceRecognizer(remembered)  # type: ignore[arg-type]
    marks = _Marks(images, laps)
    for i, frame in enumerate(images.frames()):
        remembered.at = i
        closures = recognizer.process(frame)
        if recognizer.latest is not None:
            marks.count(i, closures)
    remembered.save()
    return marks.counts


def _two(uri: str, images: TruthSequence, laps: NDArray[np.int64], describer: Describer) -> Counts:
    remembered = _remembered(images, describer)
    marks = _Marks(images, laps)
    with tempfile.TemporaryDirectory(prefix="pnv_fleet_") as folder:
        pair = [_Robot(f"{images.name}_{n}", uri, Path(folder), describer, remembered) for n in range(2)]
        for i, frame in enumerate(images.frames()):
            remembered.at = i
            marked = pair[laps[i] % 2].see(frame)
            if marked is not None:
                marks.count(i, marked)
        for robot in pair:
            robot.fleet.close()
    return marks.counts


class _Robot:
    """A recogniser with a fleet, waited for."""

    def __init__(
        self, name: str, uri: str, folder: Path, describer: Describer, remembered: RememberedDescriber
    ) -> None:
        self._recognizer = PlaceRecognizer(remembered)  # type: ignore[arg-type]
        self._heard: list[LoopClosure] = []
        self._asked = 0
        like = describer.describe(np.zeros((*describer.image_size[::-1], 3), np.uint8))
        options = Options(uri, name, 1e6, folder / name, 1000.0, 0.0, 1.0, False)
        self.fleet = Fleet(
            options, remembered.config, describer.map_fingerprint, like, describer.model.info.calibration,
            self._heard.extend, lambda line: None,
        )  # fmt: skip

    def see(self, frame: Frame) -> list[LoopClosure] | None:
        """Closures with the own map and with the other robot's; None where the frame is no keyframe."""
        closures = self._recognizer.process(frame)
        query, first = self._recognizer.latest, self._recognizer.database.first()
        if query is None or first is None:
            return None
        self._heard.clear()
        self._asked += 1
        self.fleet.offer(query, first.stamp_ns)
        _until(lambda: (s := self.fleet.status()).asked >= self._asked and s.waiting == 0 and s.sent >= self._asked)
        return closures + self._heard


def _until(condition: Callable[[], bool]) -> None:
    end = time.monotonic() + _ANSWER_S
    while not condition():
        if time.monotonic() > end:
            raise RuntimeError(f"the fleet did not answer within {_ANSWER_S:.0f} s")
        time.sleep(0.005)
