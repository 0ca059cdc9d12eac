"""A robot's part in the fleet: real threads, a real store, stores that are slow, silent, gone and back."""

import socket
import threading
import time
from dataclasses import replace

import numpy as np
import pytest

from pnv_core.recognizer import PlaceRecognizer
from pnv_fleet.errors import FleetError
from pnv_fleet.fleet import Fleet, Options
from pnv_fleet.outbox import Outbox
from pnv_fleet.places import layouts_of, parts_of
from pnv_fleet.store import Access, PlaceStore
from test.core.small import noise_image, small_describer
from test.fleet.worlds import new_model, place
from test.ros.camera import scene
from test.ros.processes import wait_until

pytest.importorskip("pymilvus", reason="the extra `fleet` is not installed")

SECOND = 10**9
SETTINGS = {"min_interval_s": 0.0, "min_change": 0.0, "consistency": 0, "exclude_recent_s": 30.0}


class Robot:
    """A recogniser whose keyframes go to a fleet."""

    def __init__(self, tmp_path, name, uri, model="", start_s=1000, **options):
        self.describer = small_describer(**SETTINGS)
        self.recognizer = PlaceRecognizer(self.describer)
        self.model = model or new_model()
        self.answers, self.lines, self.stamp, self.seen = [], [], start_s * SECOND, 0
        self.like = self.describer.describe(noise_image(0))
        given = Options(uri, name, 5000.0, tmp_path / f"{name}.outbox", 100.0, 0.0, 1.0, False)
        self.fleet = Fleet(
            replace(given, **options), self.describer.config, self.model, self.like, None, self.answers.append,
            self.lines.append,
        )  # fmt: skip

    def see(self, *scenes: int) -> list:
        """Frames a second apart; the candidates of each, found locally."""
        found = []
        for number in scenes:
            self.stamp += SECOND
            self.seen += 1
            from pnv_core.types import Frame

            found.append(self.recognizer.process(Frame(self.stamp, "front", scene(number))))
            self.fleet.offer(self.recognizer.latest, self.recognizer.database.first().stamp_ns)
        return found

    def settled(self) -> None:
        """All that was seen is in the store; an empty outbox alone may be one that is not filled yet."""
        dealt_with = lambda: self.status.sent + self.status.covered >= max(1, self.seen)  # noqa: E731
        wait_until(lambda: dealt_with() and self.status.waiting == 0, 60, "the outbox")

    @property
    def status(self):
        return self.fleet.status()

    @property
    def accepted(self) -> list:
        return [c for answer in self.answers for c in answer if c.accepted]

    def store(self, uri) -> PlaceStore:
        return PlaceStore(uri, self.model, Access(), len(self.like.global_vector), parts_of(layouts_of(self.like)))


def test_a_robot_recognises_where_another_one_was(server, tmp_path):
    alpha = Robot(tmp_path, "alpha", server.uri)
    alpha.see(*range(8))
    alpha.settled()
    assert alpha.accepted == []
    beta = Robot(tmp_path, "beta", server.uri, alpha.model, start_s=5000)
    beta.see(100, 5, 101, 2)
    beta.settled()
    closures = {(c.query.stamp_ns // SECOND, c.match.stamp_ns // SECOND) for c in beta.accepted}
    assert closures == {(5002, 1006), (5004, 1003)}
    assert {(c.query.robot, c.match.robot) for c in beta.accepted} == {("beta", "alpha")}
    assert beta.status.robots == {"alpha": 2}
    assert beta.store(server.uri).count() == 12
    assert beta.status.bytes_sent > 0
    for robot in (alpha, beta):
        robot.fleet.close()


def test_a_robot_finds_its_own_earlier_days_but_not_what_it_knows_itself(server, tmp_path):
    day = Robot(tmp_path, "alpha", server.uri)
    day.see(1, 2, 3, 1)
    day.settled()
    assert day.accepted == []
    day.fleet.close()
    next_day = Robot(tmp_path, "alpha", server.uri, day.model, start_s=90_000)
    next_day.see(3)
    next_day.settled()
    assert [c.match.stamp_ns // SECOND for c in next_day.accepted] == [1003]
    next_day.fleet.close()


def test_a_store_that_is_away_loses_nothing_and_its_answers_come_late(server, tmp_path):
    away = socket.create_server(("127.0.0.1", 0))
    port = away.getsockname()[1]
    away.close()
    alpha = Robot(tmp_path, "alpha", server.uri)
    alpha.see(*range(4))
    alpha.settled()
    alpha.fleet.close()
    beta = Robot(tmp_path, "beta", f"http://127.0.0.1:{port}", alpha.model, start_s=5000, budget_ms=300.0)
    local = beta.see(2, 50, 3)  # does not wait for what cannot be sent
    wait_until(lambda: beta.status.problem and beta.status.waiting == 3, 60, "a problem")
    assert "cannot be reached" in beta.status.sentence()
    assert "since" in beta.status.sentence()
    beta.fleet.close()
    alone = Robot(tmp_path, "alone", f"http://127.0.0.1:{port}", start_s=5000)
    assert [[(c.match, c.score) for c in one] for one in alone.see(2, 50, 3)] == [
        [(c.match, c.score) for c in one] for one in local
    ]
    alone.fleet.close()
    back = Robot(tmp_path, "beta", server.uri, alpha.model, start_s=9000)  # the same outbox: nothing was lost
    back.settled()
    assert {(c.query.stamp_ns // SECOND, c.match.stamp_ns // SECOND) for c in back.accepted} == {
        (5001, 1003), (5003, 1004),
    }  # fmt: skip
    assert back.status.late == 3
    assert back.store(server.uri).count() == 7
    back.fleet.close()


def test_a_store_that_answers_but_has_no_room_is_one_line(server, tmp_path, monkeypatch):
    alpha = Robot(tmp_path, "alpha", server.uri)
    alpha.see(1, 2, 3)
    alpha.settled()
    full = True
    put = PlaceStore.put

    def refuse(store, places):
        if full:
            raise FleetError(f"{store.uri}: the store has no room")
        put(store, places)

    monkeypatch.setattr(PlaceStore, "put", refuse)
    alpha.lines.clear()
    for number in range(10, 14):
        alpha.see(number)
        wait_until(lambda n=number: alpha.status.asked + alpha.status.late >= n - 6, 60, "an answer")
        wait_until(lambda: "no room" in alpha.status.sentence(), 60, "a problem")
        time.sleep(0.5)
    assert alpha.lines == [f"fleet: {server.uri}: the store has no room"]
    full = False
    alpha.settled()
    wait_until(lambda: not alpha.status.problem, 60, "an end of it")
    assert alpha.lines[1].startswith("fleet: well again after")
    assert len(alpha.lines) == 2
    alpha.fleet.close()


def test_a_store_that_goes_and_comes_back_is_said_once_each(server, tmp_path, monkeypatch):
    away = True

    def opened(uri, *more):
        if away:
            raise FleetError(f"{uri}: the store cannot be reached")
        return PlaceStore(uri, *more)

    monkeypatch.setattr("pnv_fleet.fleet.PlaceStore", opened)
    alpha = Robot(tmp_path, "alpha", server.uri)
    alpha.see(1, 2)
    wait_until(lambda: len(alpha.fleet._troubles) == 2, 60, "both, who asks and who sends, to fail")
    away = False
    alpha.settled()
    wait_until(lambda: not alpha.status.problem, 60, "an end of it")
    told = [" ".join(line.split()[1:3]) for line in alpha.lines if "cannot be reached" in line]
    assert told == [f"{server.uri}: the", "well again"]
    alpha.fleet.close()


@pytest.mark.parametrize("kind", ["served", "file"])
def test_a_failing_upload_leaves_the_query_in_hand_alone(server, tmp_path, monkeypatch, kind):
    uri = server.uri if kind == "served" else str(tmp_path / "places.db")
    alpha = Robot(tmp_path, "alpha", uri)
    alpha.see(1, 2, 3)
    alpha.settled()
    alpha.fleet.close()
    asking, closed = threading.Event(), threading.Event()
    search, put, close = PlaceStore.search, PlaceStore.put, PlaceStore.close

    def slow(store, vector, *more):
        if beta.seen > 1:
            asking.set()
            assert closed.wait(60)  # the failed upload has given its store up
        return search(store, vector, *more)

    def refuse_once(store, places):
        if not closed.is_set():
            assert asking.wait(60)
            raise FleetError(f"{store.uri}: the store has no room")
        put(store, places)

    def noted(store):
        close(store)
        closed.set()

    beta = Robot(tmp_path, "beta", uri, alpha.model, start_s=5000, budget_ms=60_000.0)
    for name, act in (("search", slow), ("put", refuse_once), ("close", noted)):
        monkeypatch.setattr(PlaceStore, name, act)
    beta.see(50)
    wait_until(lambda: beta.status.asked == 1, 60, "the first answer")
    beta.see(2)
    wait_until(lambda: beta.status.asked == 2, 60, "the second answer")
    assert [c.match.stamp_ns // SECOND for c in beta.accepted] == [1002]
    assert beta.status.late == 0
    beta.settled()
    assert any("no room" in line for line in beta.lines)
    beta.fleet.close()


@pytest.mark.parametrize("uri", ["http://robot:secret@127.0.0.1:1", "places.sqlite"])
def test_an_address_that_is_none_is_refused_at_once(tmp_path, uri):
    with pytest.raises(FleetError, match="allowed") as refusal:
        Robot(tmp_path, "alpha", uri)
    assert "secret" not in str(refusal.value)


def test_the_recogniser_never_waits_for_a_store_that_never_answers(tmp_path):
    with socket.create_server(("127.0.0.1", 0)) as silent:
        robot = Robot(tmp_path, "alpha", f"http://127.0.0.1:{silent.getsockname()[1]}")
        robot.see(*range(3))
        query = robot.recognizer.latest
        for _ in range(50):
            robot.fleet.offer(query, 0)
        assert not robot.status.problem  # handed over before the first call to the store ended, after 20 s
        wait_until(lambda: robot.status.waiting >= 3, 60, "the outbox")
        robot.fleet.close()


def test_what_the_fleet_has_is_not_sent_again(server, tmp_path):
    alpha = Robot(tmp_path, "alpha", server.uri)
    alpha.see(*range(4))
    alpha.settled()
    beta = Robot(tmp_path, "beta", server.uri, alpha.model, start_s=5000, coverage=0.95)
    beta.see(1, 60, 2)
    beta.settled()
    wait_until(lambda: beta.status.covered == 2, 60, "two covered")
    assert beta.store(server.uri).count() == 5
    for robot in (alpha, beta):
        robot.fleet.close()


def test_places_of_long_ago_are_forgotten_but_not_those_of_others(server, tmp_path):
    old = Robot(tmp_path, "alpha", server.uri)
    old.see(1, 2, 3)
    old.settled()
    old.fleet.close()
    other = Robot(tmp_path, "beta", server.uri, old.model)
    other.see(4, 5)
    other.settled()
    later = Robot(tmp_path, "alpha", server.uri, old.model, start_s=90_000, keep_days=1.0)  # 89,000 s later
    later.see(6)
    wait_until(lambda: later.status.expired == 3, 60, "the old places to be forgotten")
    later.settled()
    assert sorted(p.robot for p in later.store(server.uri).scan()) == ["alpha", "beta", "beta"]
    assert any("forgot 3 places older than 1 days" in line for line in later.lines)
    for robot in (other, later):
        robot.fleet.close()


def test_a_keyframe_of_other_patches_in_the_outbox_does_not_stop_the_others(server, tmp_path):
    before = Outbox(tmp_path / "alpha.outbox", 100.0)
    before.add(
        replace(
            place(7),
            vector=np.eye(1, len(small_describer(**SETTINGS).describe(noise_image(0)).global_vector), dtype=np.float32)[
                0
            ],
        ),
        1.0,
    )
    before.close()
    alpha = Robot(tmp_path, "alpha", server.uri)
    alpha.see(1, 2)
    alpha.settled()
    assert (alpha.status.sent, alpha.status.dropped) == (2, 1)
    assert any("another shape" in line for line in alpha.lines)
    alpha.fleet.close()


def test_no_more_is_sent_than_the_limit_allows(server, tmp_path):
    robot = Robot(tmp_path, "alpha", server.uri, kb_s=100.0)
    start = time.monotonic()
    robot.see(*range(12))
    robot.settled()
    took, one = time.monotonic() - start, robot.status.bytes_sent / 12
    assert robot.status.bytes_sent <= 100e3 * took + 16 * one  # the first batch is not waited for
    robot.fleet.close()


def test_what_is_received_keeps_to_the_limit_as_well(server, tmp_path):
    alpha = Robot(tmp_path, "alpha", server.uri)
    alpha.see(*range(24))
    alpha.settled()
    one = alpha.status.bytes_sent / 24
    beta = Robot(tmp_path, "beta", server.uri, alpha.model, start_s=5000, kb_s=one / 500)  # two a second
    start, most = time.monotonic(), 0.0
    beta.see(*range(100, 106))
    while beta.status.waiting and time.monotonic() - start < 60:
        status = beta.status
        most = max(most, status.bytes_sent + status.bytes_received - 2 * one * (time.monotonic() - start))
        time.sleep(0.01)
    beta.settled()
    assert beta.status.asked == 6
    assert beta.status.bytes_received > 15 * one
    assert most <= (beta.describer.config.candidates + 3) * one * 1.1  # of one query and of a batch
    for robot in (alpha, beta):
        robot.fleet.close()


def test_a_query_that_is_no_keyframe_is_asked_and_not_stored(server, tmp_path):
    alpha = Robot(tmp_path, "alpha", server.uri)
    alpha.see(*range(3))
    alpha.settled()
    beta = Robot(tmp_path, "beta", server.uri, alpha.model, start_s=5000)
    beta.recognizer.database.read_only = True
    from pnv_core.types import Frame

    beta.recognizer.process(Frame(5000 * SECOND, "front", scene(1)))
    beta.fleet.offer(beta.recognizer.latest, 5000 * SECOND)
    wait_until(lambda: beta.accepted, 60, "a closure")
    assert beta.accepted[0].query.id == -1
    assert (beta.status.waiting, beta.store(server.uri).count()) == (0, 3)
    for robot in (alpha, beta):
        robot.fleet.close()


def test_pictures_travel_only_where_they_are_asked_for(server, tmp_path):
    for pictures in (False, True):
        robot = Robot(tmp_path, f"r{pictures}", server.uri, pictures=pictures)
        robot.see(1)
        robot.settled()
        (place,) = robot.store(server.uri).scan(views=True)
        assert (b"\xff\xd8\xff" in place.view) == pictures
        assert b"PNVX" in place.view  # the features travel either way
        robot.fleet.close()


def test_places_of_other_models_are_told(server, tmp_path):
    Robot(tmp_path, "alpha", server.uri).see(1)
    other = Robot(tmp_path, "other", server.uri)
    other.see(1)
    other.settled()
    assert any("other models" in line for line in other.lines)
    other.fleet.close()


def test_a_second_node_of_the_same_name_is_refused(tmp_path):
    first = Robot(tmp_path, "alpha", "http://127.0.0.1:1")
    with pytest.raises(FleetError, match="held by another process"):
        Robot(tmp_path, "alpha", "http://127.0.0.1:1")
    first.fleet.close()


def test_vectors_are_kept_as_they_were(server, tmp_path):
    robot = Robot(tmp_path, "alpha", server.uri)
    robot.see(4)
    vector = robot.recognizer.latest.descriptor.global_vector
    robot.settled()
    (place,) = robot.store(server.uri).scan(views=True)
    np.testing.assert_allclose(place.vector, vector, atol=1e-6)
    robot.fleet.close()
