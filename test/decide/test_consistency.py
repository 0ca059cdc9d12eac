"""Which closures agreement in time confirms, on sequences made by hand."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pnv_core.config import Config
from pnv_core.database import KeyframeDatabase
from pnv_core.decide.consistency import SequenceMemory, confirmed, window_of
from pnv_core.decide.gates import decided
from pnv_core.types import ImageRef, LoopClosure, Reason
from test.database.synthetic import drive

WANTED = 3


def closure(query, match, score=0.9, session=0, camera="front"):
    here, there = ImageRef(query, query * 10**9, "front", session), ImageRef(match, match * 10**9, camera)
    return LoopClosure(here, there, score, 0.5, 0.5, 50, False)


def confirmations(found, wanted=WANTED):
    """found: per query keyframe a list of (match, score). Which queries have a confirmed best closure."""
    memory, verdicts = SequenceMemory(), []
    for query, matches in enumerate(found, start=1000):
        closures = [closure(query, m, s) for m, s in matches]
        memory.remember("front", closures, window_of(wanted))
        verdicts.append(bool(closures) and confirmed(memory.path(closures[0], window_of(wanted)), wanted))
    return verdicts


def single(*matches):
    return [[] if m is None else [(m, 0.9)] for m in matches]


def test_a_way_taken_again_is_confirmed_from_the_third_keyframe_on():
    assert confirmations(single(10, 11, 12, 13, 14)) == [False, False, True, True, True]


def test_a_way_taken_backwards_is_confirmed():
    assert confirmations(single(30, 28, 27, 25)) == [False, False, True, True]


def test_a_slower_and_a_faster_robot_are_confirmed():
    assert confirmations(single(10, 10, 11, 11, 12))[-1]
    assert confirmations(single(10, 15, 20, 26))[-1]


def test_one_query_without_a_match_does_not_break_the_way():
    assert confirmations(single(10, 11, None, 13, 14))[-2:] == [True, True]


def test_a_lonely_match_and_scattered_matches_are_not_confirmed():
    assert not any(confirmations(single(10, None, None, None, 40)))
    assert not any(confirmations(single(10, 80, 30, 170, 55, 120)))


def test_matches_that_go_to_and_fro_are_not_confirmed():
    assert not any(confirmations(single(10, 16, 11, 17, 12), wanted=4))


def test_the_same_keyframe_again_and_again_is_one_witness():
    assert not any(confirmations(single(*[10] * 50)))


def test_a_second_place_on_the_way_is_found_behind_a_better_looking_one():
    found = [[(10, 0.5)], [(90, 0.9), (11, 0.5)], [(12, 0.5), (40, 0.4)]]
    assert confirmations(found)[-1]


def test_weak_candidates_support_nothing():
    assert not any(confirmations([[(10, 0.01)], [(11, 0.01)], [(12, 0.9)]]))


def test_matches_of_another_session_or_camera_do_not_support():
    memory = SequenceMemory()
    for query, (match, camera) in enumerate([(10, "rear"), (11, "rear"), (12, "front")], start=100):
        memory.remember("front", [closure(query, match, camera=camera)], window_of(WANTED))
    assert memory.path(closure(102, 12), window_of(WANTED)).length == 1


@pytest.mark.parametrize("wanted", [0, 1])
def test_nothing_is_wanted_where_consistency_is_off(wanted):
    assert confirmations(single(10, 80), wanted) == [True, True]


@given(st.lists(st.lists(st.tuples(st.integers(0, 400), st.floats(0, 1)), max_size=5), max_size=30), st.integers(2, 6))
def test_a_path_is_never_longer_than_its_window_and_never_counts_a_query_twice(found, wanted):
    memory = SequenceMemory()
    for query, matches in enumerate(found, start=1000):
        closures = [closure(query, m, s) for m, s in matches]
        memory.remember("front", closures, window_of(wanted))
        for c in closures:
            path = memory.path(c, window_of(wanted))
            assert 1 <= path.length <= window_of(wanted)
            assert 0 <= path.belief <= 1


def test_chance_matches_are_hardly_ever_confirmed():
    """A thousand queries with a random match each among 1000 keyframes: the share confirmed stays under 1 %."""
    rng = np.random.default_rng(0)
    assert np.mean(confirmations(single(*rng.integers(0, 1000, 1000)))) < 0.01


def confirmed_in(database, visited, wanted=WANTED):
    """visited: per query of the front camera the keyframe it matched; the verdict on each."""
    memory, verdicts = SequenceMemory(database.steps), []
    for number, match in enumerate(visited, start=10_000):
        found = LoopClosure(ImageRef(number, number * 10**9, "front"), match, 0.9, 0.5, 0.5, 50, False)
        memory.remember("front", [found], window_of(wanted))
        verdicts.append(confirmed(memory.path(found, window_of(wanted)), wanted))
    return verdicts


def database_of(cameras, places):
    database = KeyframeDatabase(16)
    for i, descriptor in enumerate(drive(np.random.default_rng(1), places * len(cameras), 0.1)):
        database.add(i * 10**8, cameras[i % len(cameras)], descriptor)
    return database


@pytest.mark.parametrize("cameras", [1, 4, 8])
@pytest.mark.parametrize("speed", [1, 2, -2])
def test_a_way_is_confirmed_with_any_number_of_cameras_and_at_twice_the_speed(cameras, speed):
    database = database_of([f"camera {c}" for c in range(cameras)], 12)
    front = [ref for ref in database.refs() if ref.camera == "camera 0"]
    assert confirmed_in(database, front[::speed])[2:] == [True] * (len(front[::speed]) - 2)


@pytest.mark.parametrize("gap", [2, 7, 12])
def test_a_way_is_confirmed_in_a_thinned_map(gap):
    database = database_of(["front"], 5 * gap)
    snapshot = database.snapshot()
    kept = snapshot.keyframes[::gap]
    thinned = database.prepared(kept, len(kept), snapshot.next_id, snapshot.next_session)
    assert all(confirmed_in(thinned, thinned.refs())[2:])


def test_far_leaps_in_the_sequence_of_a_camera_confirm_nothing():
    database = database_of(["front", "rear"], 60)
    front = [ref for ref in database.refs() if ref.camera == "front"]
    assert not any(confirmed_in(database, front[::7]))


def test_elsewhere_is_counted_in_the_sequence_of_a_camera():
    """Eight cameras: five places on is still here, twenty are not; of another camera by when it was taken."""
    database = database_of([f"camera {c}" for c in range(8)], 40)
    refs = database.refs()
    assert database.steps(refs[0], refs[5 * 8]) == 5
    assert database.steps(refs[0], refs[5 * 8 + 3]) in (5, 6)
    assert database.steps(refs[20 * 8], refs[0]) == -20


def test_weak_evidence_that_agrees_becomes_belief_and_alone_it_does_not():
    window = window_of(5)
    alone, agreed = ([[(10 + i, 0.4)] if i in frames else [] for i in range(7)] for frames in ({6}, {2, 3, 4, 5, 6}))
    beliefs = []
    for found in (alone, agreed):
        memory = SequenceMemory()
        for query, matches in enumerate(found, start=1000):
            closures = [closure(query, m, s) for m, s in matches]
            memory.remember("front", closures, window)
        beliefs.append(memory.path(closures[0], window).belief)
    assert beliefs[0] == pytest.approx(0.4)  # what the frame says by itself
    assert beliefs[1] > 0.9


@given(st.lists(st.floats(0.06, 0.94), min_size=5, max_size=5), st.integers(0, 4))
def test_a_better_score_anywhere_on_a_way_never_lowers_the_belief(scores, better):
    beliefs = []
    for raised in (0.0, 0.05):
        memory = SequenceMemory()
        for i, score in enumerate(scores):
            last = closure(1000 + i, 10 + i, score + (raised if i == better else 0.0))
            memory.remember("front", [last], window_of(5))
        beliefs.append(memory.path(last, window_of(5)).belief)
    assert beliefs[1] >= beliefs[0]


def test_without_consistency_a_closure_of_any_accepted_score_stands_alone():
    ref = ImageRef(0, 0, "front")
    sequence = SequenceMemory()
    weak = LoopClosure(ImageRef(1, 10**11, "front"), ref, 0.02, 0.5, 0.1, 5, False)
    for wanted in (0, 1):
        config = Config(accept_score=0.01, consistency=wanted, verify=0)
        assert decided(weak, config, sequence).accepted
    assert decided(weak, Config(accept_score=0.01, consistency=3, verify=0), sequence).reason is Reason.UNCONFIRMED
