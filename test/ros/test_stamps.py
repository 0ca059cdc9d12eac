"""The rule for stamps that do not rise, by itself."""

from hypothesis import given
from hypothesis import strategies as st

from pnv_ros.slot import NewestFrames, WaitingFrame
from pnv_ros.stamps import StampRule, StampVerdict

SECOND = 10**9


def verdicts(rule, *stamps, camera="front"):
    return [rule.judge(camera, stamp).verdict.name for stamp in stamps]


def test_stamps_that_repeat_or_go_back_are_skipped_until_they_pass_the_last_one():
    rule = StampRule("skip")
    stamps = (5 * SECOND, 5 * SECOND, 2 * SECOND, 4 * SECOND, 5 * SECOND + 1)
    assert verdicts(rule, *stamps) == ["USE", "REPEATED", "BACK", "BACK", "USE"]


def test_a_looped_bag_begins_one_new_session_for_all_cameras():
    rule = StampRule("new_session")
    assert verdicts(rule, 90 * SECOND, 91 * SECOND) == ["USE", "USE"]
    assert verdicts(rule, 91 * SECOND, camera="rear") == ["USE"]
    assert verdicts(rule, 90 * SECOND + 500_000_000) == ["BACK"]  # merely late
    assert verdicts(rule, 1 * SECOND) == ["NEW_SESSION"]
    assert verdicts(rule, 1 * SECOND, camera="rear") == ["USE"]
    assert rule.judge("rear", 2 * SECOND).session == 1


@given(st.permutations("abc"), st.lists(st.sampled_from("abc"), min_size=20, max_size=60), st.integers(2, 5))
def test_cameras_that_wrap_one_after_another_share_one_session_per_run(order, schedule, runs):
    """Each camera runs through 0 to 30 s in steps of 0.1 s, at the pace of a random schedule."""
    rule, step, length = StampRule("new_session"), SECOND // 10, 300
    count, used = dict.fromkeys(order, 0), {camera: [] for camera in order}
    while min(count.values()) < runs * length:
        for camera in (*schedule, *order):
            if count[camera] - min(count.values()) < 10:  # a second apart at most
                run, frame = divmod(count[camera], length)
                ruling = rule.judge(camera, frame * step + order.index(camera))
                if ruling.verdict in (StampVerdict.USE, StampVerdict.NEW_SESSION):
                    used[camera].append((ruling.session, run))
                count[camera] += 1
    for frames in used.values():
        assert all(session == run for session, run in frames)
        assert len(frames) > 0.9 * runs * length


def test_a_second_camera_that_wraps_later_joins_the_session_of_the_first():
    rule = StampRule("new_session")
    assert verdicts(rule, 90 * SECOND) == ["USE"]
    assert verdicts(rule, 90 * SECOND, camera="rear") == ["USE"]
    assert verdicts(rule, 1 * SECOND) == ["NEW_SESSION"]
    assert verdicts(rule, 91 * SECOND, 92 * SECOND, camera="rear") == ["ENDED_RUN", "ENDED_RUN"]
    assert verdicts(rule, 2 * SECOND) == ["USE"]
    assert verdicts(rule, 1 * SECOND, 2 * SECOND, camera="rear") == ["USE", "USE"]
    assert rule.judge("rear", 3 * SECOND).session == rule.judge("front", 3 * SECOND).session == 1


def test_a_camera_that_does_not_wrap_at_all_is_heard_again():
    rule = StampRule("new_session")
    assert verdicts(rule, 90 * SECOND) == ["USE"]
    assert verdicts(rule, 90 * SECOND, camera="rear") == ["USE"]
    assert verdicts(rule, 1 * SECOND) == ["NEW_SESSION"]
    assert verdicts(rule, 94 * SECOND, 96 * SECOND, 97 * SECOND, camera="rear") == ["ENDED_RUN", "USE", "USE"]


def test_the_stamp_of_an_unusable_frame_holds_nothing_back():
    rule = StampRule("skip")
    assert verdicts(rule, 1 * SECOND, 10**18) == ["USE", "USE"]
    rule.unusable("front", 10**18)
    assert verdicts(rule, 1 * SECOND, 2 * SECOND) == ["REPEATED", "USE"]
    rule.unusable("front", 1 * SECOND)  # not the last one: nothing to take back
    assert verdicts(rule, 2 * SECOND) == ["REPEATED"]


@given(st.lists(st.tuples(st.sampled_from("ab"), st.integers(-5, 20)), max_size=40))
def test_used_stamps_of_a_camera_rise(events):
    rule, used = StampRule("skip"), {}
    for camera, seconds in events:
        if rule.judge(camera, seconds * SECOND).verdict is StampVerdict.USE:
            assert seconds > used.get(camera, -6)
            used[camera] = seconds


@given(st.lists(st.integers(0, 4), min_size=1, max_size=40))
def test_cameras_that_send_at_once_are_served_in_turns(taken_between):
    """However many frames are taken between two rounds, no camera is ahead of another by more than one."""
    slot, served = NewestFrames(), dict.fromkeys("abcd", 0)
    for number, taken in enumerate(taken_between):
        for camera in served:
            slot.put(WaitingFrame(camera, number, 0, b"", object))
        for _ in range(taken):
            served[slot.take().camera] += 1
        assert max(served.values()) - min(served.values()) <= 1


@given(st.lists(st.sampled_from("abc"), min_size=1, max_size=30))
def test_the_slot_keeps_the_newest_frame_of_each_camera_in_order_of_waiting(cameras):
    slot, expected = NewestFrames(), {}
    for number, camera in enumerate(cameras):
        replaced = slot.put(WaitingFrame(camera, number, 0, b"", object))
        assert replaced == (camera in expected)
        expected[camera] = number
    taken = [slot.take() for _ in expected]
    assert [(f.camera, f.stamp_ns) for f in taken] == list(expected.items())
    slot.close()
    assert slot.take() is None
