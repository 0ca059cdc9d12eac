"""Maps in hostile hands: nothing that was saved is lost, nothing that a file says is believed.

PNV_FULL_TESTS=1 runs the full counts.
"""

import json
import os
import shutil
import socket
import struct
import threading
import zlib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule, run_state_machine_as_test

from benchmarks.database import stalled
from pnv_cli.main import main
from pnv_core.database import KeyframeDatabase
from pnv_core.errors import ConfigError, MapError, PnvError
from pnv_core.maps import MapStore, tools
from pnv_core.maps.manifest import NAME, _digest, read_manifest
from pnv_core.maps.store import segment_files
from test.edited_json import edited
from test.maps.faulty import Crash, faults
from test.maps.worlds import MODEL, contents, driven, go_on, on_disk, saved
from test.tally import count, tally

GENERATED = {"deadline": None, "database": None, "suppress_health_check": list(HealthCheck)}
ERRORS = st.sampled_from([OSError(28, "No space left on device"), OSError(5, "Input/output error")])


def refused_in_one_line(error: Exception) -> bool:
    return "\n" not in str(error) and len(str(error)) <= 1000


# Several savers, readers and paths


def test_a_map_is_read_whole_while_another_process_saves_it(tmp_path):
    path, wanted = tmp_path / "map", count(40, 400)
    database = driven(0, memory_budget_mb=0.1)
    store = MapStore(path, MODEL)
    go_on(database, 10, 0)
    store.save(database.snapshot())
    loads, saves, done = 0, 0, threading.Event()

    def read():
        nonlocal loads
        try:
            while loads < wanted:
                MapStore(path, MODEL).load(KeyframeDatabase(16, 1))
                loads += 1
        finally:
            done.set()

    reader = threading.Thread(target=read)
    reader.start()
    while not done.is_set():
        go_on(database, 7, saves)
        store.save(database.snapshot())
        saves += 1
    reader.join()
    tally("1a a map is loaded while it is saved", wanted, loads, wanted - loads)
    assert loads == wanted, f"load {loads + 1} was refused after {saves} saves"


class Life(RuleBasedStateMachine):
    """A robot that maps, saves, resets, loads and changes its path, on a disk that fails or a machine that crashes.

    What a save acknowledged stays readable: at its path, or kept beside once another map took its place.
    """

    steps = 0

    @initialize()
    def begin(self):
        self.folder = Path(os.environ["PNV_LIFE"]) / str(np.random.default_rng().integers(2**60))
        self.folder.mkdir(parents=True)
        self.acknowledged: dict[str, list] = {}
        self.allowed: dict[str, list[list]] = {}  # what may lie at a path: the last acknowledged, or one in the making
        self.start()

    def start(self):
        self.database = driven(0)
        self.stores = {name: MapStore(self.folder / name, MODEL) for name in "ab"}
        self.mine: set[str] = set()
        self.seed = 0

    @rule(frames=st.integers(1, 5))
    def go_on(self, frames):
        Life.steps += 1
        self.seed += 1
        go_on(self.database, frames, self.seed)

    @rule(name=st.sampled_from("ab"))
    def save(self, name):
        Life.steps += 1
        wanted = contents(self.database)
        try:
            self.stores[name].save(self.database.snapshot())
        except MapError as error:
            assert "was not loaded" in str(error)
            assert name not in self.mine, "what this run wrote is refused"
            return
        self.settle(name, wanted)

    def settle(self, name, wanted):
        self.acknowledged[name], self.allowed[name] = wanted, [wanted]
        self.mine.add(name)

    @rule(name=st.sampled_from("ab"), at=st.integers(0, 40), error=ERRORS, times=st.integers(1, 60))
    def save_on_a_failing_disk(self, name, at, error, times):
        Life.steps += 1
        wanted = contents(self.database)
        try:
            with faults(at, error, times):
                self.stores[name].save(self.database.snapshot())
        except MapError as refused:
            assert refused_in_one_line(refused)
            # the rename may have taken effect although the folder could not be flushed after it
            self.allowed.setdefault(name, [[]]).append(wanted)
        else:
            self.settle(name, wanted)

    @rule(name=st.sampled_from("ab"), at=st.integers(0, 40))
    def crash_while_saving(self, name, at):
        Life.steps += 1
        wanted = contents(self.database)
        try:
            with faults(at, Crash()):
                self.stores[name].save(self.database.snapshot())
        except Crash:
            self.allowed.setdefault(name, [[]]).append(wanted)
        except MapError:
            pass
        else:
            self.settle(name, wanted)
        self.start()

    @rule()
    def reset(self):
        Life.steps += 1
        self.database.clear()

    @rule(name=st.sampled_from("ab"))
    def load(self, name):
        Life.steps += 1
        if self.stores[name].exists():
            self.stores[name].load(self.database)
            assert contents(self.database) == on_disk(self.folder / name)
            self.mine.add(name)

    @rule(name=st.sampled_from("ab"), at=st.integers(0, 40), error=ERRORS)
    def load_from_a_failing_disk(self, name, at, error):
        Life.steps += 1
        if not self.stores[name].exists():
            return
        before = contents(self.database)
        try:
            with faults(at, error):
                self.stores[name].load(self.database)
        except MapError as refused:
            assert refused_in_one_line(refused)
            assert contents(self.database) == before
        else:
            self.mine.add(name)

    @invariant()
    def nothing_is_lost(self):
        for name, allowed in self.allowed.items():
            if (self.folder / name / NAME).exists():
                assert on_disk(self.folder / name) in allowed
            else:
                assert [] in allowed


def test_whatever_a_robot_does_on_whatever_disk_what_was_saved_is_there(tmp_path, monkeypatch):
    monkeypatch.setenv("PNV_LIFE", str(tmp_path))
    Life.steps = 0
    run_state_machine_as_test(
        Life,
        settings=settings(
            max_examples=count(25, 1000), stateful_step_count=count(12, 25), phases=[Phase.generate, Phase.shrink],
            **GENERATED,
        ),
    )  # fmt: skip
    tally("1 steps of a mapping robot on failing disks", Life.steps, Life.steps)


@pytest.mark.parametrize("index", ["exact", "pq", "auto"])
def test_a_load_that_fails_anywhere_leaves_the_database_as_it_was(tmp_path, index):
    saved(tmp_path / "map", 60)
    database = driven(20, index=index, seed=7)
    before, tried = contents(database), 0
    for at in range(0, 500, count(23, 1)):
        try:
            with faults(at, OSError(5, "Input/output error")):
                MapStore(tmp_path / "map", MODEL).load(database)
            break
        except MapError:
            tried += 1
            assert contents(database) == before
    assert tried > 5
    small = driven(20, index=index, seed=7, memory_budget_mb=0.06)
    before = contents(small)
    with pytest.raises(PnvError, match=r"memory_budget_mb = 0\.06"):
        MapStore(tmp_path / "map", MODEL).load(small)
    assert contents(small) == before
    tally(f"1c loads that fail, index {index}", tried + 1, tried + 1)


def test_a_map_that_was_reset_is_kept_beside_the_one_saved_after(tmp_path):
    database, store = driven(30), MapStore(tmp_path / "map", MODEL)
    store.save(database.snapshot())
    before = contents(database)
    database.clear()
    report = store.save(database.snapshot())
    assert on_disk(tmp_path / "map") == []
    assert report.kept == tmp_path / "map.before-1"
    assert on_disk(report.kept) == before
    assert str(report.kept) in str(report)
    go_on(database, 3, seed=1)
    assert store.save(database.snapshot()).kept is None
    database.clear()
    assert store.save(database.snapshot()).kept == tmp_path / "map.before-2"
    other = MapStore(report.kept, MODEL)
    other.load(database)
    assert contents(database) == before
    go_on(database, 3, seed=2)
    other.save(database.snapshot())  # second names of one file: neither map changes the other
    assert on_disk(tmp_path / "map") == []
    tally("1d maps of a run that was reset, kept beside", 2, 2)


def test_a_folder_that_cannot_be_flushed_after_the_manifest_was_replaced_costs_nothing(tmp_path):
    database, store = driven(10), MapStore(tmp_path / "map", MODEL)
    store.save(database.snapshot())
    refused = 0
    for at in range(30):
        go_on(database, 2, at)
        wanted = [on_disk(tmp_path / "map"), contents(database)]
        try:
            with faults(at, OSError(5, "Input/output error")):
                store.save(database.snapshot())
        except MapError:
            refused += 1
        assert on_disk(tmp_path / "map") in wanted
        store.save(database.snapshot())  # this run goes on with the map, whichever of the two it is
        assert on_disk(tmp_path / "map") == wanted[1]
    assert refused > 5
    tally("1 saves whose folder cannot be flushed", 30, 30)


# A manifest with the right checksum


def write_signed(folder: Path, body) -> None:
    """As map.json, with the checksum that belongs to it."""
    text = json.dumps(body | {"sha256": _digest(body)}) if isinstance(body, dict) else json.dumps(body)
    (folder / NAME).write_text(text)


def test_a_manifest_with_a_right_checksum_and_wrong_content_is_refused_or_changes_nothing(tmp_path):
    folder, victim = tmp_path / "map", tmp_path / "victim"
    truth = contents(saved(folder, 9, 6, 7))
    saved(victim, 22, seed=5)
    body = json.loads((folder / NAME).read_text())
    del body["sha256"]
    outcome = {"refused": 0, "same": 0}

    @settings(max_examples=count(300, 20_000), phases=[Phase.generate], **GENERATED)
    @given(edited(body))
    def load(changed):
        write_signed(folder, changed)
        database = driven(3)
        before = contents(database)
        try:
            manifest = MapStore(folder, MODEL).load(database)
        except MapError as error:
            assert refused_in_one_line(error)
            assert contents(database) == before
            outcome["refused"] += 1
            return
        assert set(contents(database)) <= set(truth), "something else was loaded"
        assert manifest.next_id >= max((kf[0].id for kf in contents(database)), default=-1) + 1
        go_on(database, 2, 1)
        MapStore(tmp_path / "copy", MODEL, replace=True).save(database.snapshot())
        outcome["same"] += 1

    load()
    tried = sum(outcome.values())
    tally("1e manifests with a right checksum and other content", tried, tried)
    assert outcome["refused"] > 10 * outcome["same"]


def test_what_a_manifest_may_not_say_is_named(tmp_path):
    folder = tmp_path / "map"
    saved(folder, 9, 6)
    body = json.loads((folder / NAME).read_text())
    del body["sha256"]
    first = body["segments"][0]
    for change, words in (
        ({"segments": [first | {"file": "../victim/segment-00000001-0000.pnv"}]}, r"segments\[0\].file"),
        ({"segments": [first | {"live": [[0, 10**9]]}]}, "lists ids that it does not hold"),
        ({"segments": [first | {"ids": [[0, 10**9]], "live": [[0, 10**9]]}]}, "lists 1000000001 keyframes"),
        ({"segments": body["segments"][::-1]}, "ids do not ascend"),
        ({"next_id": 3}, "ids do not ascend to 3"),
        ({"keyframes": 3}, "do not hold 3 keyframes"),
        ({"next_session": 0}, "sessions do not ascend to 0"),
        ({"cameras": ["front", "front"]}, "named twice"),
        ({"dim": 0}, r"dim"),
        ({"generation": 10**8}, "generation"),
        ({"fingerprint": "x" * 10**6}, "fingerprint"),
    ):
        write_signed(folder, body | change)
        with pytest.raises(MapError, match=words) as refused:
            read_manifest(folder)
        assert len(str(refused.value)) < 500


def test_segments_with_right_checksums_and_wrong_content_are_refused_or_change_nothing(tmp_path):
    """The heads of records are rewritten at random, with every checksum up to the manifest's made to fit."""
    whole, folder = tmp_path / "whole", tmp_path / "map"
    truth = contents(saved(whole, 12))
    body = json.loads((whole / NAME).read_text())
    del body["sha256"]
    data = (whole / body["segments"][0]["file"]).read_bytes()
    starts = [i for i in range(len(data)) if data[i : i + 4] == b"PNVK"]
    record = struct.Struct("<4sIqqiHHdQI")
    numbers = st.one_of(st.integers(-5, 30), st.sampled_from([-(2**31), 2**31 - 1, 2**16 - 1]))
    outcome = {"refused": 0, "loaded": 0}

    @settings(max_examples=count(100, 5000), phases=[Phase.generate], **GENERATED)
    @given(
        which=st.integers(0, 11), field=st.integers(2, 8), number=numbers, texture=st.floats(),
        payload=st.none() | st.floats(width=32),
    )  # fmt: skip
    def load(which, field, number, texture, payload):
        changed = bytearray(data)
        fields = list(record.unpack_from(changed, starts[which]))
        if payload is None:
            fields[field] = texture if field == 7 else min(abs(number), 2**16 - 1) if field in (5, 6, 8) else number
        else:
            at = starts[which] + record.size
            changed[at : at + 4] = struct.pack("<f", payload)
            fields[9] = zlib.crc32(changed[at : at + fields[8]])
        changed[starts[which] : starts[which] + record.size] = record.pack(*fields)
        crc = zlib.crc32(changed[starts[which] + 8 : starts[which] + record.size])
        changed[starts[which] + 4 : starts[which] + 8] = struct.pack("<I", crc)
        digest = 0
        for start in starts:
            digest = zlib.crc32(changed[start : start + record.size], digest)
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
        (folder / body["segments"][0]["file"]).write_bytes(changed)
        write_signed(folder, body | {"segments": [body["segments"][0] | {"digest": digest}]})
        database = driven(3)
        before = contents(database)
        try:
            MapStore(folder, MODEL).load(database)
        except PnvError as error:
            assert refused_in_one_line(error)
            assert contents(database) == before
            outcome["refused"] += 1
        else:
            assert [kf[0].id for kf in contents(database)] == [kf[0].id for kf in truth]
            assert all(np.isfinite(np.frombuffer(kf[3], np.float32)).all() for kf in contents(database))
            outcome["loaded"] += 1
        shutil.rmtree(tmp_path / "out", ignore_errors=True)
        tools.recover(folder, tmp_path / "out")
        tools.verify(tmp_path / "out")

    load()
    tried = sum(outcome.values())
    tally("1e segments with right checksums and other content", tried, tried)


# Files that are no files, and numbers that are no numbers


def _socket(path):
    with socket.socket(socket.AF_UNIX) as s:
        os.chdir(path.parent)  # names of sockets are short
        s.bind(path.name)


ODD = {
    "pipe": os.mkfifo,
    "folder": os.mkdir,
    "socket": _socket,
    "dangling link": lambda path: path.symlink_to("nowhere"),
    "link to a device": lambda path: path.symlink_to("/dev/zero"),
    "link to itself": lambda path: path.symlink_to(path.name),
    "empty": lambda path: path.write_bytes(b""),
}


@pytest.mark.parametrize("kind", ODD)
def test_a_part_of_a_map_that_is_no_file_is_refused_at_once_whoever_asks(tmp_path, kind, monkeypatch):
    monkeypatch.chdir(tmp_path)
    tried = 0
    for part in ("segment-00000001-0000.pnv", NAME, "lock"):
        folder = tmp_path / part / "map"
        database = saved(folder, 10)
        (folder / part).unlink()
        ODD[kind](folder / part)
        for ask in (
            lambda folder=folder: MapStore(folder, MODEL).load(driven(0)),
            lambda folder=folder, database=database: MapStore(folder, MODEL).save(database.snapshot()),
            lambda folder=folder: tools.verify(folder),
            lambda folder=folder, part=part: tools.recover(folder, tmp_path / f"{part}-out"),
        ):
            tried += 1
            try:
                ask()
            except MapError as error:
                assert refused_in_one_line(error)
    tally(f"1f parts of a map that are a {kind}", tried, tried)


@pytest.mark.parametrize("number", [2, 50, 99_999_998, 99_999_999])
def test_a_stray_segment_file_does_not_end_the_saving(tmp_path, number):
    folder = tmp_path / "map"
    database, store = driven(5), MapStore(folder, MODEL)
    store.save(database.snapshot())
    for turn in range(4):
        (folder / f"segment-{number:08d}-0000.pnv").write_bytes(b"stray")
        go_on(database, 3, turn)
        store.save(database.snapshot())
        assert on_disk(folder) == contents(database)
    assert len(segment_files(folder)) == 5
    tally("1f saves beside a stray segment", 4, 4)


@settings(max_examples=count(15, 500), **GENERATED)
@given(budget=st.floats(0.01, 1.2), precision=st.sampled_from(["int8", "float32"]))
def test_a_map_pruned_to_a_budget_loads_into_that_budget(tmp_path_factory, budget, precision):
    folder = tmp_path_factory.mktemp("prune")
    saved(folder / "map", 150, memory_budget_mb=2.0, patch_precision=precision)
    tools.prune(folder / "map", folder / "less", budget_mb=budget)
    loaded = KeyframeDatabase(16, budget)
    MapStore(folder / "less", MODEL).load(loaded)
    assert loaded.bytes_used <= loaded.bytes_budget
    more = driven(0, memory_budget_mb=budget, patch_precision=precision)
    go_on(more, 150, 0)
    assert len(loaded) >= min(150, len(more)) - 2  # as many as a database of the budget keeps
    shutil.rmtree(folder)


@pytest.mark.parametrize("wrong", ["nan", "inf", "-inf", "-1"])
def test_a_budget_that_is_no_number_is_refused(tmp_path, wrong, capsys):
    saved(tmp_path / "map", 5)
    assert main(["map", "prune", str(tmp_path / "map"), "-o", str(tmp_path / "out"), f"--budget-mb={wrong}"]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert not (tmp_path / "out").exists()
    with pytest.raises(ConfigError, match="budget_mb"):
        tools.prune(tmp_path / "map", tmp_path / "out", budget_mb=float(wrong))


# Nobody waits for a map


def test_a_database_answers_while_a_map_is_read_into_it(tmp_path):
    database = driven(20)
    before = contents(database)
    keyframes = iter(driven(50, seed=3).snapshot().keyframes)
    half, go = threading.Event(), threading.Event()

    def slowly():
        for number, kf in enumerate(keyframes):
            if number == 25:
                half.set()
                assert go.wait(30)
            yield kf

    ready: list = []
    loading = threading.Thread(target=lambda: ready.append(database.prepared(slowly(), 50, 50, 1)))
    loading.start()
    assert half.wait(30)
    try:
        assert database.stats().keyframes == 20
        assert contents(database) == before
        go_on(database, 1, 9)
    finally:
        go.set()
        loading.join()
    database.become(ready[0])
    assert len(database) == 50


def test_saving_and_loading_a_map_stalls_no_callback_for_longer_than_20_ms(tmp_path):
    """At full counts it is a map of 1 GB. Other work on the machine can only add, so the best of three counts."""
    for trial in range(3):
        found = stalled(count(1500, 11_500), tmp_path / str(trial))
        shutil.rmtree(tmp_path / str(trial))
        worst = {what: round(ticks.longest_own, 1) for what, ticks in found.items()}
        if max(worst.values()) < 20:
            break
    kept = sum(ms < 20 for ms in worst.values())
    print(worst)
    tally(f"1g longest stalls by a map of {count(133, 1020)} MB that are below 20 ms", len(worst), kept)
    assert max(worst.values()) < 20, worst
