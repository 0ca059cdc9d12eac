"""What happened since the last look, for diagnostics and logs. Written by callbacks and worker, read by a timer."""

import threading
from collections import Counter, deque
from dataclasses import dataclass
from enum import StrEnum


class Drop(StrEnum):
    """Why a received frame was not processed."""

    BUSY = "busy"  # a newer frame came while the worker was busy
    STAMP_REPEATED = "stamp_repeated"
    STAMP_BACK = "stamp_back"
    UNUSABLE = "unusable"  # the message cannot be decoded, or is no image
    NO_CAMERA_INFO = "no_camera_info"
    PAUSED = "paused"


_KEPT_SCORES = 20


class Statistics:
    """Counts since the start. All methods are safe from any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self.received: Counter[str] = Counter()  # by camera
        self._dropped: Counter[tuple[str, Drop]] = Counter()  # by camera and reason
        self._processed: Counter[str] = Counter()  # by camera
        self.closures = 0
        self.last_closure = ""
        self.autosave_failure = ""  # of the last autosave; empty where it succeeded
        self.best_scores: deque[float] = deque(maxlen=_KEPT_SCORES)  # of the latest queries with candidates

    def receive(self, camera: str) -> None:
        with self._lock:
            self.received[camera] += 1

    def drop(self, camera: str, why: Drop) -> int:
        """How many of a camera were dropped for this reason so far, this one included."""
        with self._lock:
            self._dropped[camera, why] += 1
            return self._dropped[camera, why]

    def process(self, camera: str, best_score: float | None, accepted: int, closure: str) -> None:
        """One frame went through the recogniser."""
        with self._lock:
            self._processed[camera] += 1
            self.closures += accepted
            if best_score is not None:
                self.best_scores.append(best_score)
            if accepted:
                self.last_closure = closure

    def counts(self) -> "Counts":
        """Everything counted so far."""
        with self._lock:
            return Counts(Counter(self.received), Counter(self._processed), Counter(self._dropped))


@dataclass(frozen=True)
class Counts:
    """Frames by camera: received, processed, and dropped by reason."""

    received: Counter[str]
    processed: Counter[str]
    dropped: Counter[tuple[str, Drop]]

    def since(self, earlier: "Counts") -> "Counts":
        return Counts(
            self.received - earlier.received, self.processed - earlier.processed, self.dropped - earlier.dropped
        )

    def of(self, why: Drop) -> int:
        """Dropped for a reason, over all cameras."""
        return sum(n for (_, reason), n in self.dropped.items() if reason is why)

    def starved(self) -> tuple[str, Drop, int] | None:
        """A camera of which frames came and none was processed, the reason, and of how many; None if there is none.

        One that waits for the worker is not starved.
        """
        for camera, received in self.received.items():
            reasons = [(n, why) for (c, why), n in self.dropped.items() if c == camera and why is not Drop.BUSY]
            if reasons and not self.processed[camera]:
                return camera, max(reasons)[1], received
        return None
