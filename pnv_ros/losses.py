"""What the middleware loses of a camera's images, told from the stamps of those that arrive."""

import os
import sys
from collections import deque
from pathlib import Path

import numpy as np

_STAMPS = 90  # latest ones looked at: three seconds at 30 Hz
_LEAST = 45  # of them say something
_WORTH_SAYING = 0.15  # share lost
_PROFILE = "fastdds_shared_memory.xml"


class TransportLosses:
    """The share of each topic's frames that never arrive. A camera's period is told by the shorter gaps between
    stamps; where every second frame is lost without exception, stamps cannot tell."""

    def __init__(self) -> None:
        self._stamps: dict[str, deque[int]] = {}

    def arrived(self, topic: str, stamp_ns: int) -> None:
        """A frame with a stamp later than the last one."""
        stamps = self._stamps.setdefault(topic, deque(maxlen=_STAMPS))
        if stamps and stamp_ns <= stamps[-1]:
            stamps.clear()  # another run
        stamps.append(stamp_ns)

    def share(self, topic: str) -> float:
        """Lost frames as a share of those sent of late, in [0, 1); 0 while too few arrived to tell."""
        stamps = np.array(self._stamps.get(topic, ()), np.int64)
        if len(stamps) < _LEAST:
            return 0.0
        gaps = np.diff(stamps).astype(np.float64)
        shorter = np.median(np.sort(gaps)[: len(gaps) // 4])
        period = np.median(gaps[gaps < 1.5 * shorter])
        sent = np.maximum(np.rint(gaps / period), 1).sum()
        return float(1 - len(gaps) / sent)

    def forget(self, topic: str) -> None:
        """Its images come another way from now on."""
        self._stamps.pop(topic, None)

    def many(self, topic: str) -> bool:
        """Whether the loss is worth doing something about."""
        return self.share(topic) >= _WORTH_SAYING

    def sentence(self, topic: str) -> str:
        """What to do about a loss worth saying; empty where there is none."""
        share = self.share(topic)
        if not self.many(topic):
            return ""
        advice = f"set FASTRTPS_DEFAULT_PROFILES_FILE={profile()} for the camera and for this node (with Fast DDS)"
        return (
            f"the middleware loses {100 * share:.0f} % of the frames of {topic}, going by their stamps; {advice}, "
            "or send compressed images (transport: compressed)"
        )


def profile() -> Path:
    """The shared memory profile for Fast DDS, where the package is installed."""
    prefixes = [*filter(None, os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)), sys.prefix]
    installed = [Path(prefix) / "share" / "pnv_ros" / "config" / _PROFILE for prefix in prefixes]
    here = Path(__file__).parents[1] / "config" / _PROFILE  # in a checkout
    return next((path for path in (*installed, here) if path.is_file()), Path("config") / _PROFILE)
