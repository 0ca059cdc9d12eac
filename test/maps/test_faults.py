"""Kills, full disks and damaged files: no map is lost, none is silently wrong."""

import multiprocessing
import os
import random
import shutil
import signal
import subprocess
import time
from contextlib import suppress
from pathlib import Path

import pytest

from pnv_core.database import KeyframeDatabase
from pnv_core.errors import MapError
from pnv_core.maps import Autosave, MapStore, tools
from pnv_core.maps.manifest import read_manifest
from test.maps.worlds import MODEL, contents, driven, go_on, on_disk, saved
from test.tally import count, tally


def _save_until_killed(path: Path, progress) -> None:
    """Continue the map, saving over and over, now by hand, now by itself; tell what was saved for certain."""
    store, database = MapStore(path, MODEL), driven(0, memory_budget_mb=0.3, eviction="densest")
    if store.exists():
        store.load(database)
    seed = os.getpid()
    if seed % 2:
        Autosave(database, store, 0.001, lambda report: progress.send(report.keyframes)).start()
        while True:
            seed += 1
            go_on(database, 3, seed)
            time.sleep(0.001)
    while True:
        seed += 1
        go_on(database, 10, seed)
        newest = database.last().id
        store.save(database.snapshot())
        progress.send(newest)


@pytest.mark.process
def test_a_kill_at_any_moment_leaves_the_last_saved_map_whole(tmp_path):
    rounds = count(15, 200)
    processes = multiprocessing.get_context("forkserver")
    processes.set_forkserver_preload(["test.maps.test_faults"])
    rng = random.Random(1)
    path, saves, certain = tmp_path / "map", 0, -1
    for _ in range(rounds):
        receiver, sender = processes.Pipe(duplex=False)
        process = processes.Process(target=_save_until_killed, args=(path, sender), daemon=True)
        process.start()
        sender.close()
        assert receiver.poll(60), "the saving process said nothing"
        time.sleep(rng.uniform(0, 0.1))
        os.kill(process.pid, signal.SIGKILL)
        process.join()
        try:
            while receiver.poll():
                told, saves = receiver.recv(), saves + 1
                certain = max(certain, told if process.pid % 2 == 0 else -1)
        except EOFError:
            pass
        manifest = tools.verify(path)
        assert manifest.next_id > certain
        assert manifest.keyframes > 0
    tally(f"1 kills while a map is saved ({saves} saves)", rounds, rounds)


def _damage(folder: Path, older: Path, rng: random.Random) -> str:
    """Do one thing that disks, file systems and hands do to files; say what."""
    files = sorted(path for path in folder.iterdir() if path.name != "lock")
    target = rng.choice(files)
    data = bytearray(target.read_bytes())
    kind = rng.choice(["bit", "bits", "cut", "cut short", "zeros", "noise", "longer", "gone", "older", "swapped"])
    at = rng.randrange(len(data))
    if kind in ("bit", "bits"):
        for _ in range(1 if kind == "bit" else 20):
            data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
    elif kind == "cut":
        del data[at:]
    elif kind == "cut short":
        del data[-rng.randrange(1, 9) :]
    elif kind == "zeros":
        data[at : at + 512] = bytes(len(data[at : at + 512]))
    elif kind == "noise":
        data[at : at + 64] = rng.randbytes(len(data[at : at + 64]))
    elif kind == "longer":
        data += rng.randbytes(rng.randrange(1, 100))
    elif kind == "older" and (older / target.name).exists():
        data = bytearray((older / target.name).read_bytes())
    elif kind == "swapped":
        other = rng.choice(files)
        theirs = other.read_bytes()
        other.write_bytes(data)
        data = bytearray(theirs)
    target.write_bytes(data)
    if kind == "gone":
        target.unlink()
    return f"{kind} in {target.name} at {at}"


def test_a_damaged_map_is_refused_by_name_or_loads_unchanged_and_recovers_what_is_whole(tmp_path):
    rng = random.Random(2)
    whole, older = tmp_path / "whole", tmp_path / "older"
    saved(older, 30, 30)
    database = saved(whole, 30, 30, 20)
    truth = contents(database)
    refused = recovered = 0
    for number in range(count(60, 200)):
        folder = tmp_path / str(number)
        shutil.copytree(whole, folder)
        what = _damage(folder, older, rng)
        loaded = KeyframeDatabase(16, 1)
        try:
            MapStore(folder, MODEL).load(loaded)
            assert contents(loaded) == truth or on_disk(folder) == on_disk(older), what
        except MapError as error:
            refused += 1
            assert str(folder) in str(error), what
            assert "\n" not in str(error), what
            assert len(loaded) == 0
            recovered += _recovered(folder, tmp_path / f"{number}-out", truth, what)
        shutil.rmtree(folder)
    tried = count(60, 200)
    tally("1 damaged maps", tried, tried)
    held = refused * len(truth)
    tally("1 keyframes of damaged maps; lost: what the damage destroyed", held, recovered, held - recovered)
    assert refused > 0


def _recovered(folder: Path, output: Path, truth: list, what: str) -> int:
    try:
        tools.recover(folder, output)
    except MapError:
        return 0
    found = on_disk(output)
    assert all(keyframe in truth for keyframe in found), what
    shutil.rmtree(output)
    return len(found)


def test_one_bad_keyframe_costs_one_keyframe(tmp_path):
    truth = contents(saved(tmp_path / "map", 50))
    segment = next((tmp_path / "map").glob("segment-*"))
    data = bytearray(segment.read_bytes())
    data[len(data) // 2] ^= 1
    segment.write_bytes(data)
    recovery = tools.recover(tmp_path / "map", tmp_path / "out")
    assert (recovery.keyframes, recovery.lost) == (49, 1)
    found = on_disk(tmp_path / "out")
    assert len(found) == 49
    assert all(keyframe in truth for keyframe in found)
    tools.verify(tmp_path / "out")


def test_without_its_manifest_a_map_is_recovered_from_its_segments(tmp_path):
    truth = contents(saved(tmp_path / "map", 20, 30))
    (tmp_path / "map" / "map.json").unlink()
    assert tools.recover(tmp_path / "map", tmp_path / "out").lost is None
    assert on_disk(tmp_path / "out") == truth
    with pytest.raises(MapError, match="no whole keyframe found"):
        tools.recover(tmp_path, tmp_path / "other")


@pytest.fixture
def small_disk(tmp_path):
    """A file system of 300 KB."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=300k", "tmpfs", str(folder)]
    if os.geteuid() != 0 or subprocess.run(mount, capture_output=True).returncode != 0:
        pytest.skip("mounting a small tmpfs needs root")
    yield folder
    subprocess.run(["umount", "-l", str(folder)], check=True)


def test_a_full_disk_is_reported_recognition_goes_on_and_the_old_map_is_whole(small_disk):
    database, store = driven(100), MapStore(small_disk / "map", MODEL)
    store.save(database.snapshot())
    before = on_disk(small_disk / "map")
    files = sorted(path.name for path in (small_disk / "map").iterdir())
    (small_disk / "log").write_bytes(bytes(180_000))
    go_on(database, 1000, seed=1)
    for _ in range(3):
        with pytest.raises(MapError, match="No space left on device; what was saved before is whole"):
            store.save(database.snapshot())
        assert on_disk(small_disk / "map") == before
        assert sorted(path.name for path in (small_disk / "map").iterdir()) == files
        go_on(database, 5, seed=2)
    tally("1 saves on a full disk", 3, 3)
    (small_disk / "log").unlink()
    tools.prune(small_disk / "map", small_disk / "less", keep=10)  # there is room again
    database.clear()
    go_on(database, 50, seed=3)
    store.save(database.snapshot())
    assert on_disk(small_disk / "map") == contents(database)


def test_not_a_byte_of_room_leaves_the_old_map_whole(small_disk):
    database, store = driven(100), MapStore(small_disk / "map", MODEL)
    store.save(database.snapshot())
    before = on_disk(small_disk / "map")
    with open(small_disk / "log", "wb", buffering=0) as log, suppress(OSError):
        while log.write(bytes(512)):
            pass
    go_on(database, 1, seed=1)
    with pytest.raises(MapError, match="No space left on device"):
        store.save(database.snapshot())
    assert on_disk(small_disk / "map") == before
    assert read_manifest(small_disk / "map").generation == 1
