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
        self._turns: dict[str, int] = {}  # camera: when it was last served, counted in frames
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
        """A frame of the camera that was served longest ago; blocks until there is one, None once closed.

        Not of the one that began to wait first: of cameras that send at once the first would always come before the
        others.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._closed or self._waiting)
            if self._closed:
                return None
            camera = min(self._waiting, key=lambda waiting: self._turns.get(waiting, 0))
            self._turns[camera] = 1 + max(self._turns.values(), default=0)
            return self._waiting.pop(camera)

    def close(self) -> None:
        """Let go of what waits; every `take` from now on gives None."""
        with self._changed:
            self._closed = True
            self._waiting.clear()
            self._changed.notify_all()
