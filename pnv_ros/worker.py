"""The one thread that recognises places."""

import threading
from collections.abc import Callable

from pnv_ros.slot import NewestFrames, WaitingFrame


class Worker:
    """Takes frames from the slot one by one. A failure of `work` ends the thread and is handed to `failed`."""

    def __init__(
        self,
        frames: NewestFrames,
        work: Callable[[WaitingFrame], None],
        failed: Callable[[BaseException], None],
    ) -> None:
        self._frames, self._work, self._failed = frames, work, failed
        self._thread = threading.Thread(target=self._run, name="recognition", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def stop(self) -> None:
        """Returns when the frame in hand is done."""
        self._frames.close()
        if self._thread.is_alive() and self._thread is not threading.current_thread():
            self._thread.join()

    def _run(self) -> None:
        try:
            while (frame := self._frames.take()) is not None:
                self._work(frame)
        except BaseException as failure:
            self._failed(failure)
