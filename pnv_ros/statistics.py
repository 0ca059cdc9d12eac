"""What happened since the last look, for diagnostics and logs. Written by callbacks and worker, read by a timer."""

import threading
from collections import Counter, deque
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
        self.dropped: Counter[str] = Counter()  # by Drop
        self.processed = 0
        self.closures = 0
        self.last_closure = ""
        self.autosave_failure = ""  # of the last autosave; empty where it succeeded
        self.best_scores: deque[float] = deque(maxlen=_KEPT_SCORES)  # of the latest queries with candidates

    def receive(self, camera: str) -> None:
        with self._lock:
            self.received[camera] += 1

    def drop(self, why: Drop) -> int:
        """How many were dropped for this reason so far, this one included."""
        with self._lock:
            self.dropped[why] += 1
            return self.dropped[why]

    def process(self, best_score: float | None, accepted: int, closure: str) -> None:
        """One frame went through the recogniser."""
        with self._lock:
            self.processed += 1
            self.closures += accepted
            if best_score is not None:
                self.best_scores.append(best_score)
            if accepted:
                self.last_closure = closure

    def totals(self) -> tuple[int, int, dict[str, int]]:
        """Frames received and processed, and dropped by reason."""
        with self._lock:
            return sum(self.received.values()), self.processed, dict(self.dropped)
