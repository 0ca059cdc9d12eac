"""Which frames become keyframes: far enough in time and different enough, so that a still robot adds nothing."""

import numpy as np
from numpy.typing import NDArray

from pnv_core.config import Config
from pnv_core.types import Frame, PlaceDescriptor


class KeyframeSelector:
    """Remembers the last keyframe of each camera."""

    def __init__(self, config: Config) -> None:
        self.config = config
        self._last: dict[str, tuple[int, NDArray[np.float32]]] = {}
        self._still: set[str] = set()  # cameras whose last frame that was due did not differ

    def due(self, frame: Frame) -> bool:
        """Whether `min_interval_s` has passed since the camera's last keyframe. A stamp that goes back is not due."""
        last = self._last.get(frame.camera)
        return last is None or (
            frame.stamp_ns > last[0] and frame.stamp_ns - last[0] >= self.config.min_interval_s * 1e9
        )

    def changing(self, frame: Frame) -> bool:
        """Whether a frame that is due will probably differ, as the one before did."""
        return frame.camera not in self._still

    def differs(self, frame: Frame, descriptor: PlaceDescriptor) -> bool:
        """Whether 1 - cosine to the camera's last keyframe is at least `min_change`."""
        least = self.config.min_change
        if frame.camera in self._last and least > 0.0 and 1.0 - self.similarity(frame, descriptor) < least:
            self._still.add(frame.camera)
            return False
        self._still.discard(frame.camera)
        return True

    def similarity(self, frame: Frame, descriptor: PlaceDescriptor) -> float:
        """Cosine to the camera's last keyframe; 1 before the first."""
        last = self._last.get(frame.camera)
        return 1.0 if last is None else float(last[1] @ descriptor.global_vector)

    def take(self, frame: Frame, descriptor: PlaceDescriptor) -> None:
        self._last[frame.camera] = frame.stamp_ns, descriptor.global_vector

    def forget(self) -> None:
        """Start anew, as after a reset or in a new session."""
        self._last.clear()
        self._still.clear()
