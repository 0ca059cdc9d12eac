"""Saving, loading and live settings do not hold each other or the callbacks up."""

import threading
import time
from contextlib import contextmanager, nullcontext
from pathlib import Path

import pytest
import rclpy
from std_srvs.srv import Trigger

from pnv_core.database import KeyframeDatabase
from pnv_core.errors import ConfigError, MapError
from pnv_ros.node_config import NodeConfig
from pnv_ros.saved_map import SavedMap
from pnv_ros.services import Services
from test.maps.worlds import MODEL, contents, driven, go_on, on_disk
from test.ros.processes import wait_until
from test.tally import tally


class SlowStore:
    """A store whose save takes until it is told to end."""

    path = Path("map")

    def __init__(self):
        self.writing, self.end = threading.Event(), threading.Event()

    def save(self, _snapshot):
        self.writing.set()
        assert self.end.wait(30)
        return "report"

    def read(self, _database):
        return None, None

    def put(self, *_):
        pass


@pytest.fixture
def slow_map(tmp_path):
    saved_map, store = SavedMap(KeyframeDatabase(dim=4, memory_budget_mb=1.0), "f" * 64), SlowStore()
    saved_map.path = str(tmp_path / "map")
    saved_map._store = store
    thread = threading.Thread(target=saved_map.save)
    thread.start()
    assert store.writing.wait(30)
    yield saved_map, store
    store.end.set()
    thread.join()


def test_a_path_can_be_set_while_a_map_is_written(slow_map, tmp_path):
    saved_map, _ = slow_map
    for path in (saved_map.path, str(tmp_path / "another")):
        saved_map.path = path
        assert saved_map.path == path


def test_recognition_is_not_held_still_while_a_load_waits_for_a_save(slow_map):
    saved_map, store = slow_map
    entered = threading.Event()

    @contextmanager
    def still():
        entered.set()
        yield

    loading = threading.Thread(target=saved_map.load, args=(still(), lambda: None))
    loading.start()
    assert not entered.wait(0.2)
    store.end.set()
    loading.join(30)
    assert entered.is_set()


def test_a_path_that_was_left_and_taken_again_is_saved_to_and_loaded_from(tmp_path):
    database = driven(10)
    saved_map = SavedMap(database, MODEL)
    for number, name in enumerate(["a", "b", "a", "a/", "b", "a"]):
        saved_map.path = str(tmp_path) + "/" + name
        go_on(database, 1, number)
        saved_map.save()
        assert on_disk(tmp_path / name) == contents(database)
    before = contents(database)
    saved_map.path = str(tmp_path / "b")
    assert saved_map.load(nullcontext(), lambda: None) == 15
    saved_map.path = str(tmp_path / "a")
    saved_map.save()  # of the map loaded from b: that of a is kept
    assert on_disk(tmp_path / "a.before-1") == before
    tally("1b saves to paths that were left and taken again", 7, 7)


def test_frames_go_on_while_a_map_is_read(tmp_path):
    database = driven(5)
    saved_map = SavedMap(database, MODEL)
    saved_map.path = str(tmp_path / "map")
    saved_map.save()
    seen = []

    @contextmanager
    def still():
        seen.append(len(database))
        yield
        seen.append(len(database))

    go_on(database, 2, 1)
    saved_map.load(still(), lambda: None)
    assert seen == [7, 5]


class SlowControls:
    """Controls whose save takes until it is told to end; load fails."""

    def __init__(self):
        self.end = threading.Event()

    def save(self):
        assert self.end.wait(30)
        return "saved"

    def load(self):
        raise MapError("no map; allowed: one")

    def reset(self):
        return "forgot"

    def pause(self, on):
        return str(on)


def test_callbacks_are_served_while_a_map_is_saved_and_the_answer_comes_then(domain, listener):
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=domain)
    node = rclpy.create_node("place_recognizer", context=context)
    executor = rclpy.executors.SingleThreadedExecutor(context=context)
    executor.add_node(node)
    controls, ticks, ended = SlowControls(), [], threading.Event()
    services = Services(node, controls)
    node.create_timer(0.02, lambda: ticks.append(services.idle))

    def spin():
        while not (ended.is_set() and services.idle):
            executor.spin_once()

    thread = threading.Thread(target=spin)
    thread.start()
    try:
        client = listener.node.create_client(Trigger, "/place_recognizer/save")
        assert client.wait_for_service(30)
        answer = client.call_async(Trigger.Request())
        wait_until(lambda: ticks.count(False) > 10, 60, "callbacks beside a save")
        assert not answer.done()
        ended.set()  # the process is to end: the call in hand is answered first
        time.sleep(0.1)
        assert thread.is_alive()
        controls.end.set()
        wait_until(answer.done, 60, "the answer")
        assert (answer.result().success, answer.result().message) == (True, "saved")
    finally:
        controls.end.set()
        ended.set()
        thread.join(30)
        executor.shutdown()
        node.destroy_node()
        rclpy.shutdown(context=context)


@pytest.mark.parametrize("topic", ["bad topic", "a//b", "a/", "1a", "a{b}", "é", ""])
@pytest.mark.parametrize("name", ["image_topics", "camera_info_topics", "odometry_topic", "pose_topic"])
def test_a_name_that_no_topic_can_have_is_refused_with_the_value_and_what_is_allowed(name, topic):
    value = (topic,) if name.endswith("topics") else topic
    if value == "":
        assert getattr(NodeConfig(**{name: value}), name) == ""  # none
        return
    with pytest.raises(ConfigError, match=name) as raised:
        NodeConfig(**{name: value})
    assert "allowed: " in str(raised.value)
    assert "\n" not in str(raised.value)


def test_relative_absolute_and_private_topic_names_are_taken():
    assert NodeConfig(image_topics=("camera/image_raw", "/a/b_2", "~/c", "{node}/d"))
