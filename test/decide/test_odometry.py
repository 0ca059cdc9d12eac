"""What odometry refuses."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pnv_core.config import Config
from pnv_core.decide.odometry import Odometry, Refusal
from pnv_core.types import ImageRef
from test.tally import count, tally

S = 1_000_000_000


def walked(points):
    """Odometry of one sample per second, and a keyframe at each."""
    odometry = Odometry()
    refs = []
    for second, (x, y) in enumerate(points):
        odometry.add(second * S, x, y, 0.0)
        ref = ImageRef(second, second * S, "front")
        odometry.remember(ref)
        refs.append(ref)
    return odometry, refs


def square(side):
    return (
        [(float(i), 0.0) for i in range(side)] + [(float(side), float(i)) for i in range(side)]
        + [(float(side - i), float(side)) for i in range(side)] + [(0.0, float(side - i)) for i in range(side)]
        + [(0.0, 0.0)]
    )  # fmt: skip


GATE = {"drift": 0.1, "slack_m": 2.0, "least_way_m": 1.0}


def test_back_at_the_start_of_a_square_is_possible_and_half_way_round_is_not():
    odometry, refs = walked(square(20))
    assert not odometry.impossible(refs[80], refs[0], **GATE)
    assert odometry.impossible(refs[40], refs[0], **GATE)  # 28 m off after 40 m: beyond 2 + 4
    assert not odometry.impossible(refs[40], refs[0], drift=0.7, slack_m=2.0, least_way_m=1.0)


def test_a_robot_that_never_left_has_not_come_back():
    odometry, refs = walked([(0.0, 0.0)] * 100)
    assert odometry.impossible(refs[99], refs[0], **GATE)


def test_where_a_position_is_unknown_nothing_is_refused():
    odometry, refs = walked([(0.0, 0.0), (50.0, 0.0)])
    stranger = ImageRef(77, 500 * S, "front")
    odometry.remember(stranger)
    assert not odometry.impossible(stranger, refs[0], **GATE)
    assert not odometry.impossible(refs[1], ImageRef(0, 0, "front", session=3), **GATE)
    assert odometry.at(10 * S) is None


def test_samples_that_are_no_numbers_or_late_are_passed_over():
    odometry, _ = walked([(0.0, 0.0), (1.0, 0.0)])
    odometry.add(2 * S, math.nan, 0.0, 0.0)
    odometry.add(1 * S - 1, 100.0, 0.0, 0.0)
    odometry.add(2 * S, 2.0, 0.0, 0.0)
    assert odometry.at(2 * S).travelled_m == pytest.approx(2.0)


def test_a_step_back_in_time_begins_another_run():
    odometry, refs = walked([(float(i), 0.0) for i in range(20)])
    odometry.add(0, 100.0, 0.0, 0.0)
    assert odometry.at(19 * S).travelled_m == pytest.approx(19.0)  # one stray stamp begins nothing
    odometry.add(1 * S, 101.0, 0.0, 0.0)
    odometry.add(2 * S, 102.0, 0.0, 0.0)
    assert odometry.at(0).travelled_m == 0.0
    assert odometry.at(2 * S).travelled_m == pytest.approx(2.0)
    assert not odometry.impossible(refs[19], refs[0], **GATE)


@given(seed=st.integers(0, 10**6), rate=st.sampled_from([10, 50, 200]))
@settings(max_examples=count(5, 200), deadline=None, database=None)
def test_a_robot_that_trembles_while_it_stands_has_gone_no_way(seed, rate):
    """5 mm of noise in each direction, two minutes; then the same noise on a drive of 100 m."""
    noise = np.random.default_rng(seed).normal(0, 0.005, (120 * rate, 3))
    standing, driving = Odometry(), Odometry()
    first, last = ImageRef(0, 0, "front"), ImageRef(1, 119 * S, "front")
    for i, (x, y, z) in enumerate(noise):
        standing.add(i * S // rate, x, y, z)
        if i == 0:
            standing.remember(first)
        driving.add(i * S // rate, x + 100 * i / len(noise), y, z)
    assert standing.at(119 * S).travelled_m == 0.0
    assert driving.at(119 * S).travelled_m == pytest.approx(100 * 119 / 120, abs=0.5)
    standing.remember(last)
    assert standing.impossible(last, first, drift=0.1, slack_m=10.0, least_way_m=1.0)
    tally("3 robots that tremble where they stand", 1, 1)


WILD = st.floats() | st.sampled_from([1500.0, 1e308, -1e308, math.nan, math.inf, 1e7])
STRAY = st.tuples(st.integers(1, 119), st.tuples(WILD, WILD, WILD),
                  st.integers(-(2**62), 2**62) | st.integers(-5 * S, 5 * S))  # fmt: skip


@given(st.lists(STRAY, min_size=1, max_size=20, unique_by=lambda s: s[0]))
@settings(max_examples=count(60, 5000), deadline=None, database=None)
def test_single_samples_from_elsewhere_change_nothing(strays):
    """Whatever one sample says, in place or in time, the gate stays as it was, and the way is finite."""
    plain, struck = Odometry(), Odometry()
    at = {second: (xyz, off) for second, xyz, off in strays}
    for second in range(120):
        place = second * 1.0, 0.0, 0.0
        plain.add(second * S, *place)
        struck.add(second * S, *place)
        if second in at and (second - 1) not in at:  # one after the other is a jump, not a stray
            xyz, off = at[second]
            if math.dist(xyz, place) < 610 and -S < off < 3 * S:
                continue  # where a robot may be
            struck.add(second * S + off, *xyz)
    mine, theirs = plain.at(119 * S), struck.at(119 * S)
    assert theirs.xyz == mine.xyz
    assert theirs.travelled_m == pytest.approx(mine.travelled_m, abs=0.5) or theirs.travelled_m < mine.travelled_m
    assert math.isfinite(theirs.travelled_m)
    tally("3 odometries with single samples from elsewhere", 1, 1)


def test_odometry_that_is_initialised_elsewhere_starts_anew_and_says_what_it_refused():
    odometry, refs = walked([(float(i), 0.0) for i in range(20)])
    told = [odometry.add((20 + i) * S, 5000.0 + i, 0.0, 0.0) for i in range(4)]
    assert told == [Refusal.JUMP, Refusal.JUMP, None, None]
    assert odometry.refused == 2
    assert odometry.at(23 * S).travelled_m == pytest.approx(3.0)
    assert not odometry.impossible(ImageRef(50, 23 * S, "front"), refs[0], **GATE)
    assert odometry.add(24 * S, math.nan, 0.0, 0.0) is Refusal.NOT_FINITE
    assert odometry.add(24 * S, 5004.0, 0.0, 0.0, (0.0, 0.0, 0.0, 0.0)) is Refusal.NOT_FINITE
    assert odometry.add(23 * S, 5004.0, 0.0, 0.0) is Refusal.LATE


def test_a_camera_in_front_of_the_robot_moves_when_the_robot_turns():
    odometry = Odometry()
    odometry.add(0, 0.0, 0.0, 0.0)
    odometry.add(S, 0.0, 0.0, 0.0, (0.0, 0.0, math.sqrt(0.5), math.sqrt(0.5)))  # a quarter to the left
    assert odometry.at(0).of((0.5, 0.1, 0.2)) == pytest.approx((0.5, 0.1, 0.2))
    assert odometry.at(S).of((0.5, 0.1, 0.2)) == pytest.approx((-0.1, 0.5, 0.2))


def tower(storey):
    """Odometry of twelve metres of corridor a floor and stairs of 8 s to the next; a keyframe at one spot of each."""
    odometry, floors = Odometry(), []
    for floor in range(6):
        for step in range(20):
            stair = max(step - 12, 0) / 8
            second = 20 * floor + step
            x = float(step) if step <= 12 else 12.0 * (1 - stair)
            odometry.add(second * S, x, 0.0, storey * (floor + stair))
            ref = ImageRef(second, second * S, "front")
            odometry.remember(ref)
            if step == 6:
                floors.append(ref)
    return odometry, floors


def test_height_tells_the_floors_of_a_tower_apart_and_nothing_does_where_odometry_is_flat():
    (high, floors), (flat, _) = tower(3.5), tower(0.0)
    pairs = [(later, earlier) for i, later in enumerate(floors) for earlier in floors[:i]]
    default = Config()
    gate = default.odometry_drift, default.odometry_slack_m, default.min_travelled_m
    assert all(high.impossible(*pair, *gate) for pair in pairs)
    assert not any(flat.impossible(*pair, *gate) for pair in pairs)


def test_a_place_seen_from_a_little_higher_or_after_a_long_way_that_height_drifted_on_is_possible():
    default = Config()
    gate = default.odometry_drift, default.odometry_slack_m, default.min_travelled_m
    for way, up, impossible in ((100, 1.9, False), (100, 5.0, True), (400, 5.0, False)):
        odometry, refs = Odometry(), []
        for second in range(way + 1):
            out = min(second, way - second)
            odometry.add(second * S, float(out), 0.0, up * second / way)
            refs.append(ImageRef(second, second * S, "front"))
            odometry.remember(refs[-1])
        assert odometry.impossible(refs[-1], refs[0], *gate) is impossible
