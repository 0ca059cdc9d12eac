"""The newest frame of every camera, between the subscriptions and the worker."""

import threading
from dataclasses import dataclass


@dataclass(frozen=True, eq=False)
class WaitingFrame:
    """An image message as it came over the wire, not yet unpacked."""

    camera: str
    stamp_ns: int
    session: int
    serialized: bytes
    message_type: type


class NewestFrames:
    """One place per camera: a newer frame replaces one that still waits. Never blocks the putter."""

    def __init__(self) -> None:
        self._waiting: dict[str, WaitingFrame] = {}  # in the order in which cameras began to wait
        self._changed = threading.Condition()
        self._closed = False

    def put(self, frame: WaitingFrame) -> bool:
        """Whether a frame of the same camera was replaced."""
        with self._changed:
            replaced = frame.camera in self._waiting
            self._waiting[frame.camera] = frame
            self._changed.notify()
            return replaced

    def take(self) -> WaitingFrame | None:
        """The frame of the camera that has waited longest; blocks until there is one, None once closed."""
        with self._changed:
            self._changed.wait_for(lambda: self._closed or self._waiting)
            if self._closed:
                return None
            return self._waiting.pop(next(iter(self._waiting)))

    def close(self) -> None:
        """Let go of what waits; every `take` from now on gives None."""
        with self._changed:
            self._closed = True
            self._waiting.clear()
            self._changed.notify_all()
