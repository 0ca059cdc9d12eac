"""Running the node: one process, ended by SIGINT, SIGTERM or its own failure."""

import contextlib
import ctypes
import gc
import re
import signal
import sys
import threading
import traceback
from queue import SimpleQueue

import rclpy
from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException
from rclpy.executors import SingleThreadedExecutor
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args

from pnv_core.errors import PnvError, one_line
from pnv_ros.node import PlaceRecognizerNode
from pnv_ros.parameters import DECLARED

UNUSABLE_INPUT = 2
_ARENA_MAX = -8  # malloc.h
_SWITCH_S = 0.0005  # both halves of the recogniser and the callbacks wait for each other's numpy calls, not 5 ms


class Spinning:
    """Callbacks in a thread of their own, so that the main thread is free to hear signals."""

    def __init__(self, node: PlaceRecognizerNode, failed: "SimpleQueue[BaseException | int]") -> None:
        self._node = node
        self._executor, self._failed, self._ended = SingleThreadedExecutor(), failed, threading.Event()
        self._executor.add_node(node)
        self._thread = threading.Thread(target=self._spin, name="callbacks", daemon=True)
        self._thread.start()

    def _spin(self) -> None:
        try:
            while not (self._ended.is_set() and self._node.idle):
                self._executor.spin_once()
        except BaseException as failure:
            self._failed.put(failure)

    def end(self) -> None:
        """Returns when the callback in hand is done and every service call answered."""
        self._ended.set()
        self._executor.create_task(lambda: None)  # ends the wait
        self._thread.join()
        self._executor.shutdown()


def help_text() -> str:
    """What --help prints: how to give parameters, and all of them."""
    lines = [f"  {s.name:<22}{_default(s.default):<22}{s.doc}" for s in DECLARED.values()]
    return "\n".join(
        [
            "usage: place_recognizer [--help] [--ros-args [-p NAME:=VALUE ...] [--params-file FILE]]\n",
            "Camera images in, loop closures out on /loop_closures. For example:",
            "  place_recognizer --ros-args -p image_topics:=\"['/camera/image_raw']\" --log-level debug\n",
            f"{'parameter':<24}{'default':<22}meaning",
            *lines,
        ]
    )


def _default(value: object) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return str(list(value)) if isinstance(value, tuple) else str(value) or "''"


def main(args: list[str] | None = None) -> int:
    """0 after SIGINT or SIGTERM, 2 for unusable settings, 1 with the traceback after a failure.

    1 too where autosave is on and the last save failed.
    """
    try:
        others = remove_ros_args(sys.argv if args is None else [sys.argv[0], *args])[1:]
    except Exception as error:  # a parameter file that is no YAML, a flag that ROS does not know
        print(f"place_recognizer: {one_line(_first_words(error))}", file=sys.stderr)
        return UNUSABLE_INPUT
    if "--help" in others or "-h" in others:
        signal.signal(signal.SIGPIPE, signal.SIG_DFL)  # for `--help | head`
        print(help_text())
        return 0
    if others:
        how = "allowed: parameters, as --ros-args -p NAME:=VALUE (--help lists them)"
        print(f"place_recognizer: {' '.join(others)}; {how}", file=sys.stderr)
        return UNUSABLE_INPUT
    _few_heaps()
    sys.setswitchinterval(_SWITCH_S)
    ending: SimpleQueue[BaseException | int] = SimpleQueue()  # its put may interrupt its get, as signal handlers do
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda number, _: ending.put(number))
    rclpy.init(args=args, signal_handler_options=SignalHandlerOptions.NO)
    try:
        try:
            node = PlaceRecognizerNode(failed=ending.put)
        except (PnvError, InvalidParameterValueException, InvalidParameterTypeException) as error:
            print(f"place_recognizer: {error}", file=sys.stderr)
            return UNUSABLE_INPUT
        if node.settings.node.autostart and not node.start():
            return UNUSABLE_INPUT
        gc.collect()
        gc.freeze()  # libraries and the model stay: no later collection walks them, which would hold callbacks up
        spinning = Spinning(node, ending)
        end = ending.get()
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, signal.SIG_DFL)  # a second one ends at once
        if isinstance(end, BaseException):
            node.report_failure(end)
            traceback.print_exception(end)
        spinning.end()
        node.stop()
        node.destroy_node()
        return 1 if isinstance(end, BaseException) or node.unsaved else 0
    finally:
        rclpy.try_shutdown()


def _few_heaps() -> None:
    """glibc: two heaps for all threads."""
    with contextlib.suppress(OSError, AttributeError):  # another C library
        libc = ctypes.CDLL(None)
        libc.mallopt(_ARENA_MAX, 2)


def _first_words(error: Exception) -> str:
    """What rcl says before it lists the places in its source."""
    return re.sub(r",? at \S+:\d+.*", "", str(error).splitlines()[0]) if str(error) else repr(error)
