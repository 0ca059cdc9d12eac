"""PlaceRecognizerNode: the managed node around the recogniser."""

import time
import traceback
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rclpy.clock import Clock, ClockType
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn

from pnv_core.database import KeyframeDatabase
from pnv_core.decide.calibration import why_conservative
from pnv_core.describe.describer import Describer, describer_from
from pnv_core.errors import ConfigError, MapError, PnvError
from pnv_core.maps import Autosave, SaveReport
from pnv_core.pose.relative_poses import RelativePoses
from pnv_core.recognizer import PlaceRecognizer
from pnv_core.rotations import mount_of
from pnv_core.threads import shared
from pnv_core.timing import StageTimer
from pnv_core.types import PlaceDescriptor
from pnv_core.verify.local_features import KEPT_BYTES
from pnv_ros.companions import Companions
from pnv_ros.diagnostics import Diagnostics
from pnv_ros.fleet import start_fleet
from pnv_ros.inputs import ImageInputs
from pnv_ros.localisation import Localisation
from pnv_ros.outputs import Outputs
from pnv_ros.parameters import Parameters, Settings
from pnv_ros.recognition import Recognition
from pnv_ros.saved_map import SavedMap
from pnv_ros.services import Services
from pnv_ros.slot import NewestFrames
from pnv_ros.stamps import StampRule
from pnv_ros.statistics import Statistics
from pnv_ros.typed_services import TypedServices
from pnv_ros.view import View, read_mask
from pnv_ros.worker import Worker

SUCCESS, FAILURE, ERROR = (
    TransitionCallbackReturn.SUCCESS,
    TransitionCallbackReturn.FAILURE,
    TransitionCallbackReturn.ERROR,
)
NOT_CONFIGURED = "the node is not configured; allowed: configure it first"


class PlaceRecognizerNode(LifecycleNode):
    """configure loads the model, activate listens, deactivate keeps the map, clean-up frees everything.

    A failure of the worker is handed to `failed`. Raises ConfigError for parameters that are not allowed.
    """

    def __init__(self, failed: Callable[[BaseException], None]) -> None:
        super().__init__("place_recognizer")
        self._failed = failed
        self._recognition: Recognition | None = None
        self._diagnostics: Diagnostics | None = None
        self._inputs: ImageInputs | None = None
        self._worker: Worker | None = None
        self._map: SavedMap | None = None
        self._companions: Companions | None = None
        self._autosave: Autosave | None = None
        self.unsaved = False  # whether the last save of an autosaving node failed
        self._statistics = Statistics()
        self._declared = Parameters(self, lambda: self._recognition is not None, self._settings_changed)
        self._own_services = Services(self, self)
        TypedServices(self._own_services, self._map_and_recognition)
        # steady: a paused simulation or bag stops neither diagnostics nor the warning that no image comes
        self._second = self.create_timer(1.0, self._every_second, clock=Clock(clock_type=ClockType.STEADY_TIME))
        self._service_change_state.callback = self._changing_state(self._service_change_state.callback)

    @property
    def settings(self) -> Settings:
        return self._declared.settings

    @property
    def idle(self) -> bool:
        """Whether every service call was answered."""
        return self._own_services.idle

    def start(self) -> bool:
        """Configure and activate; whether both succeeded."""
        return self.trigger_configure() == SUCCESS and self.trigger_activate() == SUCCESS

    # Life cycle

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        try:
            self._configure()
        except (PnvError, OSError, MemoryError) as error:
            self.get_logger().error(f"cannot be configured: {error}")
            self._free()
            return FAILURE
        except Exception:
            self.get_logger().error(f"cannot be configured:\n{traceback.format_exc()}")
            self._free()
            return ERROR
        return SUCCESS

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        try:
            self._activate()
        except Exception:
            self.get_logger().error(f"cannot be activated:\n{traceback.format_exc()}")
            self._stop()
            return FAILURE
        return SUCCESS

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        self._stop()
        self.get_logger().info("inactive; the map is kept")
        return SUCCESS

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        self._save_at_end()
        self._free()
        self.get_logger().info("cleaned up; the map is freed")
        return SUCCESS

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        self.stop()
        return SUCCESS

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        self.stop()
        return SUCCESS

    def stop(self) -> None:
        """Finish the frame in hand, save if asked to, free everything. May be called twice."""
        self._stop()
        self._save_at_end()
        self._free()

    def report_failure(self, failure: BaseException) -> None:
        """The last word on /diagnostics."""
        if self._diagnostics is not None:
            self._diagnostics.publish(b"\x02", f"ended by {type(failure).__name__}: {failure}")

    # Services

    def save(self) -> str:
        saved_map = self._map
        if saved_map is None:
            raise PnvError(NOT_CONFIGURED)
        return f"saved {saved_map.save()}"

    def load(self) -> str:
        saved_map, recognition = self._map, self._recognition
        if saved_map is None or recognition is None:
            raise PnvError(NOT_CONFIGURED)
        path = saved_map.path
        count = saved_map.load(recognition.still(), recognition.map_was_replaced)
        missing = recognition.without_picture()
        rest = f"; {missing}" if missing else ""
        return f"loaded {count} keyframes from {path}; a new session begins{rest}"

    def reset(self) -> str:
        recognition = self._recognition
        if recognition is None:
            raise PnvError(NOT_CONFIGURED)
        count = recognition.reset()
        saved = self._map.path if self._map is not None and self._map.path and self._map.exists() else ""
        kept = f"; the map at {saved} is kept beside, as {saved}.before-N, when it is saved next" if saved else ""
        return f"forgot {count} keyframes{kept}"

    def pause(self, on: bool) -> str:
        if self._inputs is None:
            raise PnvError("the node is not active; allowed: activate it first")
        self._inputs.paused = on
        return "paused: images are dropped, the map is kept" if on else "running"

    def relocalize(self) -> str:
        if self._recognition is None:
            raise PnvError(NOT_CONFIGURED)
        if self._recognition.localisation is None:
            raise PnvError("localization is false; allowed: true, with a map")
        return self._recognition.localisation.publish_initial()

    def _map_and_recognition(self) -> tuple[SavedMap, Recognition]:
        if self._map is None or self._recognition is None:
            raise PnvError(NOT_CONFIGURED)
        return self._map, self._recognition

    # Parts

    def _configure(self) -> None:
        config, start = self.settings.node, time.monotonic()
        views = self._views()
        describer = describer_from(self.settings.recogniser)
        database = KeyframeDatabase.for_describer(describer, read_only=config.localization)
        recognizer = PlaceRecognizer(describer, database, timer=StageTimer(time.perf_counter))
        like = _warm_up(describer)
        per_keyframe = database.bytes_per_keyframe(like) + (KEPT_BYTES if self.settings.recogniser.verify else 0)
        if per_keyframe > database.bytes_budget:
            raise ConfigError(
                f"memory_budget_mb = {self.settings.recogniser.memory_budget_mb:g} holds no keyframe; "
                f"allowed: at least {per_keyframe / 1e6:.3g}, better a hundred times as much"
            )
        self._stamps = StampRule(config.on_stamp_back)
        poses = RelativePoses(recognizer)
        outputs = Outputs(self, config, describer.image_size, poses)
        self._recognition = Recognition(
            recognizer, views, outputs, self._statistics, self._stamps, self.get_logger(), self._failed
        )
        self._diagnostics = Diagnostics(self, self._recognition, self._statistics)
        poses.mounts = dict(zip(config.image_topics, _mounts(config.camera_in_base), strict=False))
        self._companions = Companions(self, config, views, poses, recognizer.odometry, outputs.markers.placing)
        self._recognition.depths = self._companions.depths
        if config.localization:
            self._recognition.localisation = Localisation(self, config, poses)
        if why := why_conservative(describer.model.info.calibration, describer.config):
            self.get_logger().warning(why)
        self._map = SavedMap(database, describer.map_fingerprint)
        self._map.path = config.map_path
        if config.autosave and not config.load_on_start and self._map.exists():
            raise ConfigError(
                f"autosave is true, but {config.map_path} holds a map that is not loaded and would not be overwritten; "
                "allowed: load_on_start: true to go on with it, another map_path, or autosave: false"
            )
        if config.load_on_start:
            self.get_logger().info(self.load() if self._map.exists() else f"no map at {config.map_path} yet")
        if config.autosave:
            self._autosave = self._map.autosave(config.autosave_interval_s, self._report_autosave)
            self._autosave.start()
        if config.fleet_uri:
            self._recognition.fleet = start_fleet(self, config, recognizer, like, outputs)
        self.get_logger().info(
            self._summary(describer, per_keyframe) + f"\n  configured   in {time.monotonic() - start:.1f} s"
        )

    def _activate(self) -> None:
        assert self._recognition is not None
        assert self._diagnostics is not None
        frames = NewestFrames()
        self._diagnostics.forget()
        timer = self._recognition.recognizer.timer
        self._inputs = ImageInputs(self, self.settings.node, frames, self._statistics, self._stamps, timer)
        self._worker = Worker(frames, self._recognition.work, self._failed)
        self._worker.start()
        topics = "\n".join(f"  listens to   {self._inputs.describe(t)}" for t in self.settings.node.image_topics)
        self.get_logger().info(f"active\n{topics}\n  publishes    {self.resolve_topic_name('loop_closures')}")

    def _summary(self, describer: Describer, per_keyframe: int) -> str:
        config, info = describer.config, describer.model.info
        budget = config.memory_budget_mb * 1e6
        network, _ = shared(config.threads, bool(config.verify))
        return "\n".join(
            [
                "place recogniser",
                f"  model        {config.weights} ({info.trunk}, K = {describer.model.clusters}, "
                f"D = {describer.model.global_dim}, {describer.fingerprint[:12]})",
                f"  network      {describer.backend}, {config.trunk_precision}, {network} thread{'s' * (network > 1)}",
                f"  preset       {config.preset}: {config.image_width}x{config.image_height} px, patches "
                f"{', '.join(map(str, config.patch_sizes))}, {config.scorer}, accepted from {config.accept_score:g}",
                f"  memory       {per_keyframe / 1e6:.2f} MB per keyframe, {config.memory_budget_mb:g} MB for about "
                f"{int(budget // per_keyframe)} keyframes",
            ]
        )

    def _views(self) -> dict[str, View]:
        config = self.settings.node
        masks: list[NDArray[np.uint8] | None] = [read_mask(path) for path in config.masks]
        if len(masks) < 2:
            masks = (masks or [None]) * len(config.image_topics)
        views = {t: View(m, config.crop) for t, m in zip(config.image_topics, masks, strict=True)}
        for view in views.values():
            view.needs_info = bool(config.camera_info_topics)
        return views

    def _settings_changed(self, settings: Settings) -> None:
        if self._recognition is not None:
            self._recognition.change(settings)
        if self._map is not None:
            self._map.path = settings.node.map_path

    def _every_second(self) -> None:
        recognition, inputs, diagnostics = self._recognition, self._inputs, self._diagnostics
        companions = self._companions
        if recognition is None or inputs is None or diagnostics is None or companions is None:
            return
        inputs.follow_types()
        inputs.report_mismatches()
        companions.report_mismatches()
        diagnostics.look(self.settings, inputs, companions)
        recognition.outputs.markers.publish(recognition.recognizer.database.refs, self.settings.node)

    def _stop(self) -> None:
        if self._inputs is not None:
            self._inputs.close()
            self._inputs = None
        if self._worker is not None:
            self._worker.stop()
            self._worker = None
        if self._recognition is not None:
            with self._recognition.still():
                pass  # the frame in hand is finished

    def _report_autosave(self, done: SaveReport | MapError) -> None:
        self._statistics.autosave_failure = str(done) if isinstance(done, MapError) else ""
        if isinstance(done, MapError):
            self.get_logger().error(f"autosave: {done}")
        else:
            self.get_logger().info(f"autosaved {done}")

    def _save_at_end(self) -> None:
        if self._autosave is not None:
            self._autosave.stop()
            self._autosave = None
            self.unsaved = bool(self._statistics.autosave_failure)

    def _free(self) -> None:
        if self._recognition is not None:
            self._recognition.close()
            if self._recognition.fleet is not None:
                self._recognition.fleet.close()
            self._recognition.outputs.close()
            if self._recognition.localisation is not None:
                self._recognition.localisation.close()
        if self._companions is not None:
            self._companions.close()
        if self._diagnostics is not None:
            self._diagnostics.close()
        self._recognition = self._companions = self._diagnostics = self._map = None

    def _changing_state(self, change: Callable[..., Any]) -> Callable[..., Any]:
        """A transition that the present state does not allow is answered with false, where rclpy raises."""

        def answer(request: Any, response: Any) -> Any:
            try:
                return change(request, response)
            except rclpy_implementation.RCLError as error:
                self.get_logger().error(f"no such transition from here: {error}")
                response.success = False
                return response

        return answer


def _warm_up(describer: Describer) -> PlaceDescriptor:
    """Describe noise, so that the first real frame takes no longer than the others."""
    width, height = describer.image_size
    return describer.describe(np.random.default_rng(0).integers(0, 256, (height, width, 3), dtype=np.uint8))


def _mounts(values: Sequence[float]) -> list[NDArray[np.float64]]:
    return [mount_of(values[i : i + 6]) for i in range(0, len(values), 6)]
