"""What back ends take: LIO-SAM's own rules, and stamps becoming node ids."""

import itertools
import logging
import weakref

from hypothesis import given
from hypothesis import strategies as st

from msg_adapters.lio_sam import LioSamGate
from msg_adapters.loop_closures import closure_to_lio_sam
from msg_adapters.stamp_ids import StampIds
from pnv_core.types import ImageRef, LoopClosure

S = 1_000_000_000
LIMITS = 1.0, 30.0  # least interval of queries, least width


def closure(query_s, match_s, score=0.9, accepted=True, session=0):
    query, match = ImageRef(9, round(query_s * S), "camera", session), ImageRef(1, round(match_s * S), "camera")
    return LoopClosure(query, match, score, 0.5, 0.5, 50, accepted)


class LioSam:
    """The rules of LIO-SAM's external loops, from its mapOptmization: what it takes, and which key poses it joins."""

    def __init__(self, key_pose_times):
        self.times = key_pose_times
        self.loops = []

    def receive(self, data):
        if len(data) != 2:
            return
        newer, older = data
        if abs(newer - older) < 30.0:
            return
        current = len(self.times) - 1
        for i in range(len(self.times) - 1, -1, -1):
            if self.times[i] < newer:
                break
            current = i
        previous = 0
        for i, time in enumerate(self.times):
            if time > older:
                break
            previous = i
        if current != previous:
            self.loops.append((current, previous))


def test_lio_sam_takes_every_message_and_joins_the_key_poses_of_both_images():
    lio_sam, gate = LioSam([float(t) for t in range(100)]), LioSamGate()
    queries = [[closure(40 + q, q, 0.6), closure(40 + q, q + 4, 0.9)] for q in range(20)]
    for found in queries:
        best = gate.chosen(found, *LIMITS)
        if best is not None:
            lio_sam.receive(closure_to_lio_sam(best).data)
    assert lio_sam.loops == [(40 + q, q + 4) for q in range(20)]


def test_a_young_or_refused_closure_does_not_go_to_lio_sam():
    gate = LioSamGate()
    assert gate.chosen([closure(29.9, 0)], *LIMITS) is None
    assert gate.chosen([closure(60, 0, accepted=False)], *LIMITS) is None
    assert gate.chosen([closure(60, 0, session=1)], *LIMITS) is None  # a keyframe of a loaded map or an earlier run
    old, young = closure(60, 10, 0.6), closure(60, 40, 0.9)
    assert gate.chosen([young, old], *LIMITS) is old


@given(st.lists(st.floats(0.05, 3.0), max_size=40), st.floats(0.1, 5.0))
def test_lio_sam_gets_no_more_than_one_closure_per_interval(steps, interval_s):
    gate, now, sent = LioSamGate(), 100.0, []
    for step in steps:
        now += step
        best = gate.chosen([closure(now, 0)], interval_s, 30.0)
        if best is not None:
            sent.append(best.query.stamp_ns)
    assert all(b - a >= interval_s * S for a, b in itertools.pairwise(sent))
    assert bool(sent) == bool(steps)


def test_a_session_that_begins_earlier_is_not_held_back():
    gate = LioSamGate()
    assert gate.chosen([closure(1000, 0)], *LIMITS) is not None
    gate.forget()
    assert gate.chosen([closure(999.9, 0)], *LIMITS) is not None
    assert gate.chosen([closure(100, 0)], *LIMITS) is not None  # a bag in a loop


def test_a_closure_goes_to_the_nearest_nodes_as_soon_as_they_are_certain():
    ids = StampIds()
    assert ids.add_node(1, 10 * S) == []
    assert ids.add_node(2, 11 * S) == []
    assert ids.add_closure(closure(50.0, 10.3)) == []  # the query's node has not come
    assert ids.add_node(3, round(49.8 * S)) == []  # near, but a nearer one may follow
    (pair,) = ids.add_node(4, round(50.1 * S))
    assert (pair.query, pair.match) == (4, 1)
    assert (pair.query_offset_ns, pair.match_offset_ns) == (round(0.1 * S), round(-0.3 * S))
    assert ids.add_node(5, 51 * S) == []  # handed on once


def test_a_closure_without_a_node_is_dropped_with_a_warning(caplog):
    ids = StampIds(tolerance_s=0.5, wait_s=5.0)
    ids.add_node(1, 10 * S)
    with caplog.at_level(logging.WARNING):
        assert ids.add_closure(closure(50, 20)) == []
        assert ids.add_node(2, 50 * S) == []
        assert ids.dropped == 0
        assert ids.add_node(3, 56 * S) == []
    assert ids.dropped == 1
    assert "no node within 0.5 s of the match" in caplog.text


def test_a_removed_node_and_one_node_for_both_images_close_no_loop():
    ids = StampIds(tolerance_s=100)
    ids.add_node(1, 0)
    ids.add_node(2, 40 * S)
    ids.remove_node(1)
    assert ids.add_closure(closure(40, 0)) == []
    assert ids.dropped == 1


@given(st.lists(st.integers(0, 1000), min_size=1, max_size=60, unique=True), st.integers(0, 1000))
def test_the_nearest_node_is_that_of_a_plain_search(stamps, wanted):
    ids = StampIds(tolerance_s=2e-8)
    for number, stamp in enumerate(stamps):
        ids.add_node(number, stamp)
    found = ids.nearest(wanted)
    best = min(abs(s - wanted) for s in stamps)
    assert (found is not None) == (best <= 20)
    if found:
        assert abs(found[1]) == best
        assert stamps[found[0]] - wanted == found[1]


def test_what_goes_with_a_closure_comes_with_its_pair_and_is_let_go_with_a_dropped_one():
    class Carried:
        pass

    handed, dropped = Carried(), Carried()
    gone = weakref.ref(dropped)
    ids = StampIds(tolerance_s=0.5, wait_s=10.0)
    ids.add_node(1, 10 * S)
    ids.add_node(2, 50 * S)
    assert ids.add_closure(closure(50, 10), handed)[0].carried is handed
    assert ids.add_closure(closure(55, 30), dropped) == []  # no node at the match
    del dropped
    assert gone() is not None
    ids.add_node(3, 70 * S)
    assert (ids.dropped, gone()) == (1, None)
