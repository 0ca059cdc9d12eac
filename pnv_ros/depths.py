"""Depth images that belong to colour images, by their stamps."""

import threading
from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rclpy.node import Node

from msg_adapters.depth import depth_of
from msg_adapters.images import stamp_of
from pnv_core.errors import ImageError

_KEPT = 10
_APART_NS = 20_000_000  # depth and colour of one moment; drivers that align them give both one stamp
_WAIT_S = 0.1  # aligned depth comes a little after its colour image


class Depths:
    """The latest depth images by camera. `receive` is for the callbacks, `at` for the worker."""

    def __init__(self, node: Node) -> None:
        self._log = node.get_logger()
        self._messages: dict[str, deque[tuple[int, Any]]] = {}
        self._came = threading.Condition()

    def receive(self, camera: str) -> Callable[[Any], None]:
        """The callback of a camera's depth topic."""
        kept = self._messages.setdefault(camera, deque(maxlen=_KEPT))

        def receive(message: Any) -> None:
            with self._came:
                kept.append((stamp_of(message), message))
                self._came.notify_all()

        return receive

    def at(self, camera: str, stamp_ns: int, size: tuple[int, int]) -> NDArray[np.float32] | None:
        """(H, W) metres of the moment of a colour image of `size` (W, H); None where there are none.

        Waits a moment for a topic whose depth images come; one that is silent is not waited for.
        """
        with self._came:
            kept = self._messages.get(camera)
            if not kept:
                return None
            alive = abs(kept[-1][0] - stamp_ns) < 1_000_000_000
            if alive and kept[-1][0] < stamp_ns - _APART_NS:
                self._came.wait_for(lambda: kept[-1][0] >= stamp_ns - _APART_NS, _WAIT_S)
            apart, message = min(((abs(at - stamp_ns), m) for at, m in kept), key=lambda found: found[0])
        if apart > _APART_NS:
            return None
        try:
            if (message.width, message.height) != size:
                raise ImageError(f"depth image is {message.width}x{message.height}; allowed: aligned to the "
                                 f"{size[0]}x{size[1]} image")  # fmt: skip
            return depth_of(message)
        except ImageError as error:
            self._log.warning(f"depth of {camera}: {error}", throttle_duration_sec=10.0)
            return None
