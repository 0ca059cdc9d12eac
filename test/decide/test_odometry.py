"""What odometry refuses."""

import math

import pytest

from pnv_core.decide.odometry import Odometry
from pnv_core.types import ImageRef

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
    assert odometry.at(0).travelled_m == 0.0
    assert not odometry.impossible(refs[19], refs[0], **GATE)
