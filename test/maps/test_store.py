"""Saving and loading: whole, small, atomic, and never in the way of frames."""

import os
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from pnv_core.database import KeyframeDatabase
from pnv_core.errors import MapError, PnvError
from pnv_core.maps import Autosave, MapStore
from pnv_core.maps import manifest as manifest_module
from pnv_core.maps.manifest import read_manifest
from pnv_core.maps.store import segment_files
from test.database.synthetic import SECOND, place
from test.maps.worlds import MODEL, contents, driven, go_on, on_disk, saved


@pytest.mark.parametrize("precision", ["float32", "float16", "int8"])
@pytest.mark.parametrize("store", ["memory", "disk"])
def test_a_loaded_map_equals_the_saved_one_and_answers_alike(tmp_path, precision, store):
    database = driven(300, memory_budget_mb=0.9, patch_precision=precision, patch_store=store, eviction="densest")
    MapStore(tmp_path / "map", MODEL).save(database.snapshot())
    loaded = KeyframeDatabase(16, 0.9, index="pq", patch_store=store)
    MapStore(tmp_path / "map", MODEL).load(loaded)
    assert contents(loaded) == contents(database)
    query = place(np.random.default_rng(5)).global_vector
    assert loaded.nearest(query, 20, 0, 0) == database.nearest(query, 20, 10**18, 0)


def test_a_map_answers_alike_in_a_new_process(tmp_path):
    database = saved(tmp_path / "map", 200)
    query = place(np.random.default_rng(5)).global_vector
    script = f"""if True:
        import numpy as np
        from pnv_core.database import KeyframeDatabase
        from pnv_core.maps import MapStore
        database = KeyframeDatabase(16, 1)
        MapStore({str(tmp_path / "map")!r}, {MODEL!r}).load(database)
        for ref, similarity in database.nearest(np.array({query.tolist()}, np.float32), 20, 0, 0):
            print(ref.id, ref.stamp_ns, ref.camera, ref.session, repr(similarity))
    """
    out = subprocess.run([sys.executable, "-c", script], check=True, capture_output=True, text=True).stdout
    for line, (ref, similarity) in zip(out.splitlines(), database.nearest(query, 20, 10**18, 0), strict=True):
        *which, found = line.split()
        assert which == [str(ref.id), str(ref.stamp_ns), ref.camera, str(ref.session)]
        assert float(found) == pytest.approx(similarity, abs=1e-6)


def test_a_save_writes_only_what_is_new(tmp_path):
    database, store = driven(100), MapStore(tmp_path / "map", MODEL)
    assert store.save(database.snapshot()).written == 100
    assert store.save(database.snapshot()).bytes_written == 0
    go_on(database, 7, seed=1)
    report = store.save(database.snapshot())
    assert (report.keyframes, report.written) == (107, 7)
    assert on_disk(tmp_path / "map") == contents(database)


def test_mapping_continues_in_a_loaded_map_with_new_ids_and_a_new_session(tmp_path):
    first = saved(tmp_path / "map", 50)
    second, store = KeyframeDatabase(16, 1, patch_precision="int8"), MapStore(tmp_path / "map", MODEL)
    store.load(second)
    go_on(second, 10, seed=2)
    assert store.save(second.snapshot()).written == 10
    assert on_disk(tmp_path / "map")[:50] == contents(first)
    assert [ref.id for ref in second.refs()] == list(range(60))
    assert [s.keyframes for s in read_manifest(tmp_path / "map").sessions] == [50, 10]


@pytest.mark.parametrize("eviction", ["oldest", "densest"])
def test_a_rolling_map_follows_evictions_without_growing(tmp_path, eviction):
    database, store = driven(0, memory_budget_mb=0.3, eviction=eviction), MapStore(tmp_path / "map", MODEL)
    sizes = []
    for seed in range(60):
        go_on(database, 20, seed)
        store.save(database.snapshot())
        assert on_disk(tmp_path / "map") == contents(database)
        sizes.append(sum(path.stat().st_size for path in segment_files(tmp_path / "map")))
    assert database.evicted > 800
    assert max(sizes[20:]) <= 2.5 * min(sizes[20:])
    assert len(segment_files(tmp_path / "map")) < 40


def test_clearing_the_database_clears_the_map_at_the_next_save(tmp_path):
    database, store = driven(30), MapStore(tmp_path / "map", MODEL)
    store.save(database.snapshot())
    database.clear()
    go_on(database, 5, seed=3)
    store.save(database.snapshot())
    assert on_disk(tmp_path / "map") == contents(database)


def test_an_empty_map_is_a_map(tmp_path):
    MapStore(tmp_path / "map", MODEL).save(driven(0).snapshot())
    loaded = driven(3)
    MapStore(tmp_path / "map", MODEL).load(loaded)
    assert len(loaded) == 0


def test_a_map_of_another_model_is_refused_with_both_fingerprints(tmp_path):
    saved(tmp_path / "map", 5)
    database = driven(3)
    before = contents(database)
    with pytest.raises(MapError, match=f"{MODEL}.*aabbccdd"):
        MapStore(tmp_path / "map", "aabbccdd").load(database)
    assert contents(database) == before


def test_a_map_beyond_the_memory_budget_is_refused(tmp_path):
    saved(tmp_path / "map", 100)
    small = driven(5, memory_budget_mb=0.05)
    before = contents(small)
    with pytest.raises(PnvError, match=r"memory_budget_mb = 0\.05"):
        MapStore(tmp_path / "map", MODEL).load(small)
    assert contents(small) == before


def test_a_map_that_was_not_loaded_is_not_overwritten(tmp_path):
    before = contents(saved(tmp_path / "map", 20))
    with pytest.raises(MapError, match="20 keyframes that was not loaded"):
        MapStore(tmp_path / "map", MODEL).save(driven(5).snapshot())
    assert on_disk(tmp_path / "map") == before
    other = driven(5, seed=9)
    MapStore(tmp_path / "map", MODEL, replace=True).save(other.snapshot())
    assert on_disk(tmp_path / "map") == contents(other)


@pytest.mark.parametrize("kind", ["file", "strangers", "unwritable"])
def test_a_place_that_cannot_take_a_map_is_refused_by_name(tmp_path, kind):
    target = tmp_path / "map"
    if kind == "file":
        target.write_text("precious")
    elif kind == "strangers":
        target.mkdir()
        (target / "thesis.tex").write_text("precious")
    else:
        target = tmp_path / "nul\0name" if os.geteuid() == 0 else tmp_path / "closed" / "map"
        if os.geteuid() == 0:
            target = target.parent / "file" / "map"
            target.parent.write_text("no folder")
        else:
            target.parent.mkdir(mode=0o500)
    with pytest.raises(MapError, match=str(target)):
        MapStore(target, MODEL).save(driven(3).snapshot())
    if kind == "strangers":
        assert [path.name for path in target.iterdir()] == ["thesis.tex"]


def test_only_one_process_saves_a_map_at_a_time(tmp_path):
    import fcntl

    saved(tmp_path / "map", 5)
    store = MapStore(tmp_path / "map", MODEL)
    database = driven(0)
    store.load(database)
    with open(tmp_path / "map" / "lock") as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        with pytest.raises(MapError, match="being saved by another process"):
            store.save(database.snapshot())
    store.save(database.snapshot())


def test_everything_a_manifest_names_is_on_the_disk_before_the_manifest(tmp_path, monkeypatch):
    events: list[str] = []
    fsync, replace = os.fsync, os.replace

    def noted_fsync(handle):
        events.append(os.path.basename(os.readlink(f"/proc/self/fd/{handle}")))
        fsync(handle)

    def noted_replace(source, target):
        events.append("replace")
        replace(source, target)

    monkeypatch.setattr(os, "fsync", noted_fsync)
    monkeypatch.setattr(manifest_module.os, "replace", noted_replace)
    saved(tmp_path / "map", 30)
    names = [path.name for path in segment_files(tmp_path / "map")]
    assert names
    assert set(events[: events.index("map")]) == set(names) | {"map.json.new"}  # contents, then names in the folder
    assert events[events.index("map") :] == ["map", "replace", "map"]


def test_frames_go_on_while_a_save_waits_for_the_disk(tmp_path, monkeypatch):
    reached, go = threading.Event(), threading.Event()
    fsync = os.fsync

    def slow_fsync(handle):
        reached.set()
        assert go.wait(60)
        fsync(handle)

    monkeypatch.setattr(os, "fsync", slow_fsync)
    database = driven(50)
    expected = contents(database)
    store = MapStore(tmp_path / "map", MODEL)
    with ThreadPoolExecutor(1) as pool:
        saving = pool.submit(store.save, database.snapshot())
        assert reached.wait(60)
        go_on(database, 50, seed=4)
        assert len(database.nearest(place(np.random.default_rng(1)).global_vector, 5, 10**18, 0)) == 5
        go.set()
        saving.result()
    assert on_disk(tmp_path / "map") == expected


def test_autosave_reports_failures_goes_on_and_saves_the_rest_at_the_end(tmp_path):
    target = tmp_path / "file"
    target.write_text("in the way")
    reports: list = []
    failed = threading.Event()

    def report(outcome):
        reports.append(outcome)
        failed.set()

    database = driven(5)
    autosave = Autosave(database, MapStore(target, MODEL), 0.01, report)
    autosave.start()
    assert failed.wait(60)
    target.unlink()
    go_on(database, 5, seed=6)
    autosave.stop()
    assert isinstance(reports[0], MapError)
    assert on_disk(target) == contents(database)


def test_stamps_keep_every_nanosecond(tmp_path):
    database, stamp = driven(0), 1_700_000_000 * SECOND + 123_456_789
    database.add(stamp, "front", place(np.random.default_rng(0)))
    MapStore(tmp_path / "map", MODEL).save(database.snapshot())
    assert on_disk(tmp_path / "map")[0][0].stamp_ns == stamp
