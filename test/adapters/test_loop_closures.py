"""LoopClosure lists to and from the messages other programs read."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from std_msgs.msg import Float64MultiArray

from msg_adapters.loop_closures import (
    candidates_to_message,
    closure_to_lio_sam,
    closures_from_message,
    closures_to_message,
)
from pnv_core.errors import PnvError
from pnv_core.types import ImageRef, LoopClosure, Reason
from test.ros.tables import rows_of

CAMERAS = ("front", "rear")
stamps = st.one_of(st.integers(0, (2**31 - 1) * 10**9 + 999_999_999),
                   st.integers(0, 2**31 - 1).map(lambda s: s * 10**9 + 999_999_999))  # fmt: skip
unit = st.floats(0, 1)
refs = st.builds(ImageRef, id=st.integers(-1, 2**53), stamp_ns=stamps, camera=st.sampled_from(CAMERAS))
closures = st.builds(
    LoopClosure,
    query=refs, match=refs, score=unit, similarity=st.floats(-1, 1), spatial=unit, inliers=st.integers(0, 10**6),
    accepted=st.just(True),
)  # fmt: skip


def closure(
    accepted=True, reason=Reason.ACCEPTED, query_ns=1_700_000_100_000_000_001, match_ns=1_700_000_000_999_999_999
):
    return LoopClosure(ImageRef(41, query_ns, "rear"), ImageRef(7, match_ns, "front"), 0.75, 0.5, 0.25, 60, accepted,
                       reason)  # fmt: skip


def test_the_message_is_the_published_contract():
    message = closures_to_message([closure(), closure()], CAMERAS)
    first, second = message.layout.dim
    assert (first.label, first.size, first.stride) == ("closures", 2, 24)
    assert second.label == ("query_stamp,match_stamp,score,query_id,match_id,query_nsec,match_nsec,"
                            "similarity,spatial,inliers,query_camera,match_camera")  # fmt: skip
    assert (second.size, second.stride) == (12, 12)
    assert list(message.data[2:12]) == [0.75, 41, 7, 1, 999_999_999, 0.5, 0.25, 60, 1, 0]
    assert math.floor(message.data[0]) == 1_700_000_100
    assert math.floor(message.data[1]) == 1_700_000_000


@given(st.lists(closures, max_size=4))
def test_closures_survive_the_message(given_closures):
    assert closures_from_message(closures_to_message(given_closures, CAMERAS), CAMERAS) == given_closures


def test_closures_between_robots_carry_two_columns_more_and_the_names():
    ours, theirs = ImageRef(41, 10**9, "rear", 0, "alpha"), ImageRef(7, 2 * 10**9, "front", 0, "ns/beta-2")
    between = LoopClosure(ours, theirs, 0.75, 0.5, 0.25, 60, True)
    message = closures_to_message([between], CAMERAS)
    columns = message.layout.dim[1]
    assert columns.label.endswith(",query_camera,match_camera,query_robot,match_robot|alpha|ns/beta-2")
    assert (columns.size, message.layout.dim[0].stride, list(message.data[12:])) == (14, 14, [0, 1])
    assert closures_from_message(message, CAMERAS) == [between]
    table = candidates_to_message([between], CAMERAS)
    assert [f.name for f in table.fields][-2:] == ["query_robot", "match_robot|alpha|ns/beta-2"]
    values = {f.name: int.from_bytes(bytes(table.data[f.offset : f.offset + 4]), "little") for f in table.fields[-2:]}
    assert list(values.values()) == [0, 1]
    assert table.point_step % 8 == 0


def test_a_robot_index_beyond_the_names_names_nobody():
    between = LoopClosure(ImageRef(1, 1, "rear", 0, "a"), ImageRef(2, 2, "rear", 0, "b"), 0.75, 0.5, 0.25, 60, True)
    message = closures_to_message([between], CAMERAS)
    message.data[13] = 1e6
    assert closures_from_message(message, CAMERAS)[0].match.robot == ""


@given(closures)
def test_the_floor_of_the_first_two_columns_is_the_header_second(one):
    data = closures_to_message([one], CAMERAS).data
    assert math.floor(data[0]) == one.query.stamp_ns // 10**9
    assert math.floor(data[1]) == one.match.stamp_ns // 10**9
    assert abs(data[0] - one.query.stamp_ns / 1e9) < 1e-6


def test_columns_appended_later_are_ignored():
    message = closures_to_message([closure()], CAMERAS)
    message.layout.dim[1].label += ",novel"
    message.layout.dim[1].size += 1
    message.data = [*message.data, 5.0]
    assert closures_from_message(message, CAMERAS) == [closure()]


def test_a_message_of_another_layout_is_refused():
    with pytest.raises(PnvError, match="allowed: closures"):
        closures_from_message(Float64MultiArray(data=[1.0, 2.0]))
    short = closures_to_message([closure()], CAMERAS)
    short.data = list(short.data)[:-1]
    with pytest.raises(PnvError, match="has 11 values; allowed: 1 x 12"):
        closures_from_message(short)


def test_lio_sam_gets_exactly_two_doubles():
    assert [round(v, 6) for v in closure_to_lio_sam(closure()).data] == [1_700_000_100.0, 1_700_000_001.0]


def test_candidates_are_a_table_that_point_cloud_readers_understand():
    refused = closure(accepted=False, reason=Reason.LOW_TEXTURE)
    message = candidates_to_message([closure(), refused], CAMERAS)
    assert (message.width, message.height, message.row_step) == (2, 1, 2 * message.point_step)
    assert (message.header.stamp.sec, message.header.stamp.nanosec) == (1_700_000_100, 1)
    rows = rows_of(message)
    assert rows[1] == {
        "query_sec": 1_700_000_100, "query_nsec": 1, "match_sec": 1_700_000_000, "match_nsec": 999_999_999,
        "query_id": 41, "match_id": 7, "query_camera": 1, "match_camera": 0, "score": 0.75, "similarity": 0.5,
        "spatial": 0.25, "inliers": 60, "accepted": 0, "reason": 2,
    }  # fmt: skip
    assert (rows[0]["accepted"], rows[0]["reason"]) == (1, 0)


def test_reason_codes_on_the_wire_never_change():
    codes = [rows_of(candidates_to_message([closure(False, r)], CAMERAS))[0]["reason"] for r in Reason]
    assert codes == list(range(len(Reason)))
    assert [r.value for r in Reason][:6] == [
        "", "low_score", "low_texture", "unconfirmed", "odometry", "not_reranked",
    ]  # fmt: skip
