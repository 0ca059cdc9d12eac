"""What happens to header stamps that repeat or go back, as in a bag played in a loop."""

import threading
from dataclasses import dataclass
from enum import Enum, auto


def in_seconds(stamp_ns: int) -> str:
    """Decimal seconds, exact to the nanosecond."""
    return f"{stamp_ns // 1_000_000_000}.{stamp_ns % 1_000_000_000:09d}"


class StampVerdict(Enum):
    """What becomes of a frame by its stamp."""

    USE = auto()
    REPEATED = auto()  # skipped
    BACK = auto()  # skipped
    ENDED_RUN = auto()  # skipped: another camera has begun a new session, this one still shows the run before
    NEW_SESSION = auto()  # used; everything before it belongs to an earlier session


@dataclass(frozen=True)
class Ruling:
    verdict: StampVerdict
    session: int
    back_ns: int = 0  # how far the stamp lies behind the camera's last one


class StampRule:
    """Stamps of one camera must rise. One that repeats is skipped always, one that goes back by `on_stamp_back`.

    A step back of less than REORDERED_NS is a late frame, not a new run, and is skipped either way. The stamp of a
    frame that turned out to be unusable does not count. When one camera begins a new session, the others join it as
    soon as their stamps lie nearer to it than to the end of the run before; until then their frames are skipped.
    Judged by the callbacks, told of unusable frames by the worker.
    """

    REORDERED_NS = 1_000_000_000
    OVERRUN_NS = 5_000_000_000  # a camera that goes on for longer after a run's end is not at its end

    def __init__(self, on_stamp_back: str) -> None:
        self._new_session = on_stamp_back == "new_session"
        self._last: dict[str, int] = {}
        self._usable: dict[str, int] = {}  # last stamp of a camera not known to be unusable, before `_last`
        self._lock = threading.Lock()
        self._session = 0
        self._outside: set[str] = set()  # cameras of the run before that have not joined the session
        self._run_end_ns = 0  # the newest stamp of the run before

    def judge(self, camera: str, stamp_ns: int) -> Ruling:
        with self._lock:
            last = self._last.get(camera)
            if self._in_ended_run(camera, stamp_ns):
                return Ruling(StampVerdict.ENDED_RUN, self._session)
            if last is None or stamp_ns > last:
                self._advance(camera, stamp_ns)
                return Ruling(StampVerdict.USE, self._session)
            if stamp_ns == last:
                return Ruling(StampVerdict.REPEATED, self._session)
            if not self._new_session or last - stamp_ns < self.REORDERED_NS:
                return Ruling(StampVerdict.BACK, self._session, last - stamp_ns)
            self._session += 1
            self._outside, self._run_end_ns = set(self._last), max(self._last.values())
            self._last.clear()
            self._usable.clear()
            self._advance(camera, stamp_ns)
            return Ruling(StampVerdict.NEW_SESSION, self._session, last - stamp_ns)

    def last(self, camera: str) -> int:
        """The newest stamp of a camera that counts; 0 where there is none."""
        with self._lock:
            return self._last.get(camera, 0)

    def unusable(self, camera: str, stamp_ns: int) -> None:
        """The frame of this stamp could not be used: its stamp must not hold back the next one."""
        with self._lock:
            if self._last.get(camera) == stamp_ns:
                del self._last[camera]
                if camera in self._usable:
                    self._last[camera] = self._usable[camera]

    def forget(self) -> None:
        """Any stamp may come next."""
        with self._lock:
            self._last.clear()
            self._usable.clear()
            self._outside.clear()

    def _in_ended_run(self, camera: str, stamp_ns: int) -> bool:
        if camera not in self._outside or not self._last or stamp_ns > self._run_end_ns + self.OVERRUN_NS:
            return False
        return abs(stamp_ns - self._run_end_ns) < abs(stamp_ns - max(self._last.values()))

    def _advance(self, camera: str, stamp_ns: int) -> None:
        self._outside.discard(camera)
        if camera in self._last:
            self._usable[camera] = self._last[camera]
        self._last[camera] = stamp_ns
