"""The worker's task: one waiting frame through the recogniser."""

import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

from rclpy.serialization import deserialize_message

from msg_adapters.images import message_to_frame
from pnv_core.config import live_settings
from pnv_core.errors import ImageError, PnvError
from pnv_core.recognizer import PlaceRecognizer, Seen
from pnv_core.threads import workers
from pnv_core.types import Frame, LoopClosure
from pnv_fleet.fleet import Fleet
from pnv_ros.depths import Depths
from pnv_ros.localisation import Localisation
from pnv_ros.outputs import Outputs
from pnv_ros.parameters import Settings
from pnv_ros.slot import WaitingFrame
from pnv_ros.stamps import StampRule, in_seconds
from pnv_ros.statistics import Drop, Statistics
from pnv_ros.view import View

_REPEAT_S = 10.0  # the same complaint is not made more often
_TELL_S = 5.0  # between two lines about closed loops


class Recognition:
    """Recogniser, views and outputs of a configured node. Between two frames, services may hold it `still`.

    What a frame shows is looked up and published in a second thread, while the first is at the next frame: each half of
    the recogniser has the frames in their order. With one thread for everything there is no second one.
    """

    def __init__(
        self,
        recognizer: PlaceRecognizer,
        views: dict[str, View],
        outputs: Outputs,
        statistics: Statistics,
        stamps: StampRule,
        log: Any,
        failed: Callable[[BaseException], None],
    ) -> None:
        """A failure of the second thread is handed to `failed`."""
        self.recognizer, self.views, self.outputs = recognizer, views, outputs
        self._statistics, self._stamps, self._log = statistics, stamps, log
        self.fleet: Fleet | None = None
        self.depths: Depths | None = None
        self.localisation: Localisation | None = None
        self._session = 0
        self._wanted: Settings | None = None  # None: as configured
        self._taken: Settings | None = None
        self._shown: Settings | None = None  # what the second thread has taken
        self._failed = failed
        self._looking, self._finishing = threading.Lock(), threading.Lock()
        alone = workers(recognizer.config.threads).threads == 1
        self._second = None if alone else ThreadPoolExecutor(1, thread_name_prefix="recognition")
        self._sizes: dict[str, tuple[int, int]] = {}
        self._complained: dict[str, float] = {}
        self._told, self._untold = -_TELL_S, 0

    @contextmanager
    def still(self) -> Iterator[None]:
        """No frame is processed while this is held; those begun are finished."""
        with self._looking, self._finishing:
            yield

    def close(self) -> None:
        """Finish the frame in hand."""
        if self._second is not None:
            self._second.shutdown()

    def change(self, settings: Settings) -> None:
        """New live settings, all at once, from the next frame on. Never waits."""
        self._wanted = settings

    def reset(self) -> int:
        """Forget every keyframe and stamp; how many keyframes there were."""
        with self.still():
            count = len(self.recognizer.database)
            self.recognizer.reset()
            self._stamps.forget()
            self.outputs.markers.forget()
            return count

    def map_was_replaced(self) -> None:
        """A map was loaded, which began a session. To be called while still."""
        self.recognizer.forget_the_past()
        if self.fleet is not None:
            self.fleet.sessions(self.recognizer.database.refs())
        self.outputs.new_session()
        self.outputs.markers.forget()
        if self.localisation is not None:
            self.localisation.forget()

    def without_picture(self) -> str:
        """How many keyframes local features cannot examine although they should, in words; empty if none."""
        stats = self.recognizer.database.stats()
        if not self.recognizer.config.verify or not stats.without_picture:
            return ""
        return (
            f"{stats.without_picture} of {stats.keyframes} keyframes have no picture (saved with verify: 0); "
            "patches alone decide on them"
        )

    def where_is(self, image: Any, camera: str) -> list[LoopClosure]:
        """The places of a sensor_msgs/Image, best first; nothing is added. `camera` is an image topic, '' the first.

        Raises PnvError for another camera, one without its camera info, or an unusable image.
        """
        camera = camera or next(iter(self.views))
        view = self.views.get(camera)
        if view is None:
            raise PnvError(f"camera {camera!r} given; allowed: {', '.join(self.views)}, or none for the first")
        if view.needs_info and view.rectifier is None:
            raise PnvError(f"{camera} has no camera info yet; allowed: once it came")
        frame = view(message_to_frame(image, camera))
        with self.still():
            return self.recognizer.look_up(frame)

    def work(self, waiting: WaitingFrame) -> None:
        """Look at a frame; what it shows is finished later. An unusable one is skipped with a throttled warning."""
        with self._looking:
            wanted = self._wanted
            if wanted is not None and wanted is not self._taken:
                self._taken = wanted
                self.recognizer.change(**live_settings(wanted.recogniser))
            if waiting.session < self._session:  # waited here while another camera began a new session
                self._statistics.drop(waiting.camera, Drop.STAMP_BACK)
                return
            if waiting.session > self._session:
                self._session = waiting.session
                with self._finishing:
                    self._new_session()
            view = self.views[waiting.camera]
            if view.needs_info and view.rectifier is None:
                self._statistics.drop(waiting.camera, Drop.NO_CAMERA_INFO)
                self._complain(f"{waiting.camera} info", f"frames of {waiting.camera} wait for its camera info")
                return
            try:
                frame = self._unpacked(waiting)
                seen = self.recognizer.look(frame)
            except ImageError as error:
                self._stamps.unusable(waiting.camera, waiting.stamp_ns)
                count = self._statistics.drop(waiting.camera, Drop.UNUSABLE)
                self._complain(waiting.camera, f"{waiting.camera}: {error} ({count} frames skipped so far)")
                return
            if seen is None:
                self._statistics.process(waiting.camera, None, 0, "")
            elif self._second is None:
                self._finish(seen, self._taken)
            else:
                self._finishing.acquire()
                self._second.submit(self._finish_and_release, seen, self._taken)

    def _new_session(self) -> None:
        self.recognizer.new_session()
        self.outputs.new_session()
        if self.localisation is not None:
            self.localisation.forget()

    def _finish_and_release(self, seen: Seen, settings: Settings | None) -> None:
        try:
            self._finish(seen, settings)
        except BaseException as failure:
            self._failed(failure)
        finally:
            self._finishing.release()

    def _finish(self, seen: Seen, settings: Settings | None) -> None:
        """Look up what a frame shows, and publish what was found."""
        if settings is not None and settings is not self._shown:
            self._shown = settings
            self.outputs.config = settings.node
            if self.fleet is not None:
                self.fleet.change(seen.config)
        frame = seen.frame
        closures = self.recognizer.recognise(seen)
        self._share()
        if closures:
            with self.recognizer.timer.stage("publish"):
                self.outputs.publish(frame, closures, self._picture_of)
        if self.localisation is not None:
            with self.recognizer.timer.stage("localise"):
                self.localisation.look(frame.stamp_ns, closures)
        accepted = sum(c.accepted for c in closures)
        self._statistics.process(frame.camera, closures[0].score if closures else None, accepted, _in_words(closures))
        self._tell(closures, accepted)

    def _share(self) -> None:
        """Hand a keyframe, or the query of a map that takes none, to the fleet."""
        query = self.recognizer.latest
        if self.fleet is not None and query is not None:
            first = self.recognizer.database.first()
            oldest_ns = query.ref.stamp_ns if first is None else first.stamp_ns
            self.fleet.offer(query, oldest_ns, self.outputs.markers.placing.position(query.ref.stamp_ns))

    def _picture_of(self, keyframe: int) -> bytes:
        return self.recognizer.database.picture(keyframe)

    def _unpacked(self, waiting: WaitingFrame) -> Frame:
        with self.recognizer.timer.stage("decode"):
            message = deserialize_message(waiting.serialized, waiting.message_type)
            view = self.views[waiting.camera]
            frame = message_to_frame(message, waiting.camera, self.recognizer.enough if view.scalable else None)
            size = frame.rgb.shape[1], frame.rgb.shape[0]
            known = self._sizes.setdefault(waiting.camera, size)
            if size != known:
                self._sizes[waiting.camera] = size
                self._complain(
                    f"{waiting.camera} size",
                    f"images of {waiting.camera} changed from {known[0]}x{known[1]} to {size[0]}x{size[1]}; "
                    "both are resized to the model's input, but one topic should carry one camera",
                )
            if self.depths is not None:
                frame = replace(frame, depth=self.depths.at(waiting.camera, frame.stamp_ns, size))
            return view(frame)

    def _tell(self, closures: list[LoopClosure], accepted: int) -> None:
        """A line per closed loop, at most one in some seconds; with --log-level debug why the best was refused."""
        if closures and not accepted:
            self._log.debug(f"refused as {closures[0].reason}: {_in_words(closures)}")
        self._untold += accepted
        now = time.monotonic()
        if accepted and now - self._told >= _TELL_S:
            more = f"; {self._untold} closures since the last line" if self._untold > accepted else ""
            self._log.info(f"loop closed: {_in_words(closures)}{more}")
            self._told, self._untold = now, 0

    def _complain(self, about: str, text: str) -> None:
        now = time.monotonic()
        if now - self._complained.get(about, -_REPEAT_S) >= _REPEAT_S:
            self._complained[about] = now
            self._log.warning(text)


def _in_words(closures: list[LoopClosure]) -> str:
    if not closures:
        return ""
    best = closures[0]
    return (
        f"{in_seconds(best.query.stamp_ns)} ({best.query.camera}) matches {in_seconds(best.match.stamp_ns)} "
        f"({best.match.camera}), score {best.score:.3f}"
    )
