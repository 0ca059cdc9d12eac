"""The outbox: what it keeps through kills, full disks and its own limit."""

import os
import signal
import sqlite3
import subprocess
import sys

import pytest

from pnv_fleet.errors import FleetError
from pnv_fleet.outbox import Outbox
from pnv_fleet.places import to_bytes
from test.fleet.worlds import place
from test.ros.processes import ROOT

ONE = len(to_bytes(place(0)))


def ids(outbox: Outbox) -> list[int]:
    return [w.place.keyframe for w in outbox.oldest(1000, 10**9)]


def add_all(outbox: Outbox, numbers: range) -> None:
    for number in numbers:
        outbox.add(place(number), 1.0)


def test_keyframes_wait_in_order_and_only_once(tmp_path):
    outbox = Outbox(tmp_path / "box", 1.0)
    for number in (3, 1, 2, 1):
        outbox.add(place(number), 0.5)
    assert ids(outbox) == [3, 1, 2]
    assert (len(outbox), outbox.nbytes) == (3, 3 * ONE)
    outbox.answered(place(1).key)
    assert [w.asked for w in outbox.oldest(10, 10**9)] == [False, True, False]
    outbox.remove([w.number for w in outbox.oldest(2, 10**9)])
    assert ids(outbox) == [2]
    outbox.close()


def test_what_is_asked_for_is_bounded_and_may_leave_some_out(tmp_path):
    outbox = Outbox(tmp_path / "box", 1.0)
    for number in range(10):
        outbox.add(place(number), 1.0)
    assert [w.place.keyframe for w in outbox.oldest(3, 10**9)] == [0, 1, 2]
    assert len(outbox.oldest(10, 2 * ONE)) == 2
    assert len(outbox.oldest(10, 1)) == 1  # one at least, or it would never go
    assert [w.place.keyframe for w in outbox.oldest(2, 10**9, {place(0).key, place(2).key})] == [1, 3]
    outbox.close()


def test_when_full_the_oldest_goes_and_is_counted(tmp_path):
    outbox = Outbox(tmp_path / "box", 5.5 * ONE / 1e6)
    for number in range(12):
        outbox.add(place(number), 1.0)
    assert ids(outbox) == [7, 8, 9, 10, 11]
    assert outbox.dropped == 7
    assert outbox.nbytes <= 5.5 * ONE
    outbox.close()


def test_it_goes_on_where_it_ended(tmp_path):
    outbox = Outbox(tmp_path / "box", 1.0)
    outbox.add(place(1), 0.25)
    outbox.close()
    again = Outbox(tmp_path / "box", 1.0)
    (waiting,) = again.oldest(10, 10**9)
    assert (waiting.place.keyframe, waiting.predecessor, again.nbytes) == (1, 0.25, ONE)
    again.close()


WRITER = """
import sys
from pnv_fleet.outbox import Outbox
from test.fleet.worlds import place
outbox = Outbox(sys.argv[1], 10.0)
for number in range(len(outbox), 100000):
    outbox.add(place(number), 1.0)
    print(number, flush=True)
"""


def test_what_was_added_outlasts_kills_at_any_moment(tmp_path):
    path = str(tmp_path / "box")
    for _ in range(2):
        child = subprocess.Popen([sys.executable, "-c", WRITER, path], cwd=ROOT, stdout=subprocess.PIPE, text=True)
        for last in child.stdout:
            if int(last) % 37 == 36:
                break
        child.send_signal(signal.SIGKILL)
        last = (child.stdout.read().split() or [last])[-1]
        child.wait()
        outbox = Outbox(path, 10.0)
        found = ids(outbox)
        assert found == list(range(len(found)))
        assert len(found) >= int(last)  # the last line may be cut, the one before was whole
        outbox.close()


def test_one_process_at_a_time(tmp_path):
    outbox = Outbox(tmp_path / "box", 1.0)
    with pytest.raises(FleetError, match="held by another process"):
        Outbox(tmp_path / "box", 1.0)
    outbox.close()
    Outbox(tmp_path / "box", 1.0).close()


def test_a_file_that_is_no_outbox_is_refused_and_left_alone(tmp_path):
    path = tmp_path / "box"
    path.write_bytes(b"something else" * 100)
    with pytest.raises(FleetError, match="box"):
        Outbox(path, 1.0)
    assert path.read_bytes() == b"something else" * 100


def test_an_outbox_of_another_version_is_refused(tmp_path):
    Outbox(tmp_path / "box", 1.0).close()
    file = sqlite3.connect(tmp_path / "box")
    file.execute("PRAGMA user_version=9")
    file.close()
    with pytest.raises(FleetError, match="version 9; allowed: 1"):
        Outbox(tmp_path / "box", 1.0)


def flipped(data):
    return data[:-20] + bytes([data[-20] ^ 1]) + data[-19:]


@pytest.mark.parametrize("damaged", [lambda _: b"\0\xff\xee", flipped], ids=["rubbish", "a flipped bit in patches"])
def test_a_damaged_entry_is_dropped_and_the_others_go_on(tmp_path, damaged):
    outbox = Outbox(tmp_path / "box", 1.0)
    for number in range(3):
        outbox.add(place(number), 1.0)
    outbox.close()
    file = sqlite3.connect(tmp_path / "box")
    (data,) = file.execute("SELECT place FROM places WHERE number = 2").fetchone()
    file.execute("UPDATE places SET place = ? WHERE number = 2", (damaged(data),))
    file.commit()
    file.close()
    again = Outbox(tmp_path / "box", 1.0)
    assert ids(again) == [0, 2]
    assert (again.dropped, len(again)) == (1, 2)
    again.close()


def test_a_full_disk_is_said_and_what_was_kept_stays(tmp_path):
    outbox = Outbox(tmp_path / "box", 10.0)
    outbox.add(place(0), 1.0)
    outbox._file.execute("PRAGMA max_page_count=1")  # SQLite's own "database or disk is full"
    with pytest.raises(FleetError, match="full"):
        add_all(outbox, range(1, 200))
    kept = ids(outbox)
    assert kept == list(range(len(kept)))
    assert len(outbox) == len(kept)
    outbox._file.execute("PRAGMA max_page_count=1000000")
    outbox.add(place(500), 1.0)
    assert ids(outbox)[-1] == 500
    outbox.close()


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_a_folder_that_cannot_be_written_is_refused(tmp_path):
    tmp_path.chmod(0o500)
    with pytest.raises(FleetError, match="writable"):
        Outbox(tmp_path / "sub" / "box", 1.0)
