"""What the keyframe database promises: its budget, its ids, its patches, and who is a candidate."""

import errno
import os
import subprocess
import sys
import textwrap

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pnv_core.database import KeyframeDatabase
from pnv_core.errors import ConfigError, PnvError
from pnv_core.types import PatchGrid, PlaceDescriptor
from test.database.synthetic import SECOND, drive, place, unit

FULL = bool(os.environ.get("PNV_FULL_TESTS"))  # the counts of the acceptance figures instead of quick ones


@settings(max_examples=25, deadline=None)
@given(
    sizes=st.lists(st.integers(0, 60), min_size=1, max_size=60),
    eviction=st.sampled_from(["oldest", "densest"]),
    precision=st.sampled_from(["float32", "float16", "int8"]),
    store=st.sampled_from(["memory", "disk"]),
)
def test_the_budget_is_never_exceeded_and_the_newest_keyframe_is_always_kept(sizes, eviction, precision, store):
    rng = np.random.default_rng(1)
    database = KeyframeDatabase(16, 0.03, eviction, patch_store=store, patch_precision=precision)
    for i, patches in enumerate(sizes):
        ref = database.add(i * SECOND, "front", place(rng, patches=2 * patches))
        assert ref.id == i
        assert database.bytes_used <= database.bytes_budget
        assert database.last() == ref
        assert ref.id in database
        assert len(database) + database.evicted == i + 1


@pytest.mark.parametrize("precision", ["float32", "float16", "int8"])
def test_the_bytes_of_a_keyframe_are_known_before_it_is_added(precision):
    rng = np.random.default_rng(2)
    database = KeyframeDatabase(16, 1, patch_precision=precision)
    for patches in (0, 6, 40):
        descriptor = place(rng, patches=patches)
        before = database.bytes_used
        database.add(0, "front", descriptor)
        assert database.bytes_used - before == database.bytes_per_keyframe(descriptor)


def test_a_keyframe_larger_than_the_budget_is_refused_and_nothing_is_lost():
    rng = np.random.default_rng(3)
    database = KeyframeDatabase(16, 0.02)
    kept = [database.add(i, "front", place(rng)) for i in range(4)]
    with pytest.raises(PnvError, match="memory_budget_mb = 0.02"):
        database.add(4, "front", place(rng, patches=2000))
    assert database.refs() == kept


def test_the_oldest_policy_keeps_the_newest():
    rng = np.random.default_rng(4)
    database = KeyframeDatabase(16, 0.05, "oldest")
    refs = [database.add(i * SECOND, "front", place(rng)) for i in range(100)]
    assert 0 < len(database) < 100
    assert database.refs() == refs[-len(database) :]


def test_the_densest_policy_keeps_places_covered_where_the_oldest_policy_forgets_them():
    rng = np.random.default_rng(5)
    seen = [*drive(rng, 100, 0.3), *drive(rng, 200, 0.0), *drive(rng, 100, 0.3)]  # drives, stands, drives
    worst = {}
    for eviction in ("oldest", "densest"):
        database = KeyframeDatabase(16, 0.2, eviction)
        for i, descriptor in enumerate(seen):
            database.add(i * SECOND, "front", descriptor)
        assert len(database) < 110
        kept = np.stack([database.vector(ref.id) for ref in database.refs()])
        worst[eviction] = min(float((kept @ d.global_vector).max()) for d in seen)
    assert worst["densest"] > 0.8 > worst["oldest"]


def test_the_densest_policy_thins_a_steady_drive_evenly():
    rng = np.random.default_rng(6)
    database = KeyframeDatabase(16, 0.1, "densest")
    for i, descriptor in enumerate(drive(rng, 400, 0.2)):
        database.add(i, "front", descriptor)
    gaps = np.diff([ref.id for ref in database.refs()])
    assert gaps.max() <= 6 * np.median(gaps)


def test_ids_are_never_used_again():
    rng = np.random.default_rng(7)
    database = KeyframeDatabase(16, 0.02)
    first = [database.add(i, "front", place(rng)).id for i in range(20)]
    database.clear()
    assert len(database) == 0
    assert database.new_session() == 1
    second = [database.add(i, "front", place(rng)).id for i in range(20)]
    assert first + second == list(range(40))
    assert {ref.session for ref in database.refs()} == {1}


def _candidates(database, vectors, query, k, stamp_ns, exclude_ns, camera):
    """Brute force in float64 over what the database says it holds."""
    found = []
    for ref in database.refs():
        recent = ref.session == database.session and ref.stamp_ns > stamp_ns - exclude_ns
        if not recent and (camera is None or ref.camera == camera):
            found.append((-float(vectors[ref.id].astype(np.float64) @ query.astype(np.float64)), ref.id))
    return [i for _, i in sorted(found)[:k]]


@pytest.mark.parametrize("index", ["exact", "pq", "auto"])
@pytest.mark.parametrize("eviction", ["oldest", "densest"])
def test_every_index_finds_the_nearest_allowed_keyframes(index, eviction, monkeypatch):
    monkeypatch.setattr("pnv_core.database.index.EXACT_BYTES", 400_000)  # auto leaves exact search after 3125 rows
    rng = np.random.default_rng(8)
    database = KeyframeDatabase(32, 12, eviction, index)
    centres = unit(rng.standard_normal((300, 32)))
    vectors = {}
    for i in range(7000):
        if i == 3500:
            database.new_session()
        vector = unit(centres[i % 300] + 0.1 * rng.standard_normal(32))
        ref = database.add(i * SECOND, ("front", "rear")[i % 2], PlaceDescriptor(vector, ()))
        vectors[ref.id] = vector
    assert database.evicted > 500
    hits = wanted = 0
    for trial in range(40):
        query = unit(centres[rng.integers(300)] + 0.1 * rng.standard_normal(32))
        camera = (None, "front", "rear", "absent")[trial % 4]
        exclude_ns = (0, 300 * SECOND, 10_000 * SECOND)[trial % 3]
        given_back = database.nearest(query, 10, 7000 * SECOND, exclude_ns, camera)
        best = _candidates(database, vectors, query, 10, 7000 * SECOND, exclude_ns, camera)
        ids = [ref.id for ref, _ in given_back]
        assert len(ids) == len(best)
        for ref, similarity in given_back:
            assert ref.session == 0 or ref.stamp_ns <= 7000 * SECOND - exclude_ns
            assert camera in (None, ref.camera)
            assert similarity == pytest.approx(float(vectors[ref.id] @ query), abs=1e-6)
        assert [s for _, s in given_back] == sorted((s for _, s in given_back), reverse=True)
        if index == "exact":
            assert ids == best
        hits += len(set(ids) & set(best))
        wanted += len(best)
    assert hits >= 0.95 * wanted


def test_equal_vectors_are_ranked_by_id_wherever_they_lie():
    rng = np.random.default_rng(9)
    same = PlaceDescriptor(unit(rng.standard_normal(16)), ())
    database = KeyframeDatabase(16, 0.1)
    for i in range(200):
        database.add(i, "front", same if i % 3 else place(rng, patches=0))
    twins = [ref.id for ref in database.refs() if ref.id % 3]
    assert [ref.id for ref, _ in database.nearest(same.global_vector, 7, 10**9, 0)] == twins[:7]


def test_recent_keyframes_are_not_matched_and_other_sessions_are_never_recent():
    rng = np.random.default_rng(10)
    database = KeyframeDatabase(16, 1)
    here = place(rng)
    old = database.add(100 * SECOND, "front", here)
    database.new_session()
    for stamp in (70, 71, 100):
        database.add(stamp * SECOND, "front", here)
    found = {ref.id for ref, _ in database.nearest(here.global_vector, 10, 100 * SECOND, 30 * SECOND)}
    assert found == {old.id, 1}  # exactly 30 s old is no longer recent


def test_patches_come_back_in_the_precision_they_are_stored_in():
    rng = np.random.default_rng(11)
    descriptor = place(rng, patches=40)
    for precision, dtype in (("float32", np.float32), ("float16", np.float16), ("int8", np.int8)):
        database = KeyframeDatabase(16, 1, patch_precision=precision)
        ref = database.add(0, "front", descriptor)
        for codes, grid, back in zip(
            database.patches(ref.id), descriptor.patches, database.descriptor(ref.id).patches, strict=True
        ):
            assert codes.codes.dtype == dtype
            assert (codes.size, codes.rows, codes.cols, codes.stride) == (grid.size, grid.rows, grid.cols, grid.stride)
            largest = np.abs(grid.descriptors).max(axis=1, keepdims=True)
            step = {"float32": 0.0, "float16": 2.0**-11, "int8": 0.5 / 127}[precision]  # half a unit of the last place
            assert (np.abs(codes.decode() - grid.descriptors) <= step * largest * 1.001 + 1e-7).all()
            np.testing.assert_array_equal(np.asarray(back.descriptors, np.float32), codes.decode())


def test_a_blank_patch_survives_int8():
    grid = PatchGrid(2, 1, 2, np.array([[0, 0], [0.6, -0.8]], np.float32))
    database = KeyframeDatabase(2, 1, patch_precision="int8")
    ref = database.add(0, "front", PlaceDescriptor(np.array([1, 0], np.float32), (grid,)))
    np.testing.assert_allclose(database.descriptor(ref.id).patches[0].descriptors, grid.descriptors, atol=0.004)


def test_patches_of_old_keyframes_move_to_disk_and_come_back_the_same(tmp_path):
    rng = np.random.default_rng(12)
    seen = [place(rng, patches=100) for _ in range(100)]
    database = KeyframeDatabase(16, 0.3, patch_store="disk", patch_folder=str(tmp_path), patch_precision="float32")
    refs = [database.add(i, "front", d) for i, d in enumerate(seen)]
    assert len(database) == 100
    assert database.stats().disk_bytes > 0.2e6
    for ref, d in zip(refs, seen, strict=True):
        for a, b in zip(database.descriptor(ref.id).patches, d.patches, strict=True):
            np.testing.assert_array_equal(a.descriptors, b.descriptors)
    assert not list(tmp_path.iterdir())  # the file has no name: nothing is left however the process ends


def test_patches_on_disk_are_bounded_and_their_places_used_again(tmp_path):
    rng = np.random.default_rng(13)
    options = {"patch_store": "disk", "patch_folder": str(tmp_path), "disk_budget_gb": 1e-4}
    database = KeyframeDatabase(16, 0.1, **options)
    for i in range(500):
        database.add(i, "front", place(rng, patches=40))
        assert database.bytes_used <= database.bytes_budget
        assert database.stats().disk_bytes <= 100_000
    assert database.evicted > 0
    database.descriptor(database.refs()[0].id)


def test_a_full_disk_keeps_patches_in_memory_within_the_budget(monkeypatch, caplog):
    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    rng = np.random.default_rng(14)
    database = KeyframeDatabase(16, 0.1, patch_store="disk")
    monkeypatch.setattr(os, "pwrite", full)
    for i in range(200):
        database.add(i, "front", place(rng))
        assert database.bytes_used <= database.bytes_budget
    assert database.last().id == 199
    assert caplog.text.count("No space left on device") == 1


def test_a_snapshot_stays_what_it_was():
    rng = np.random.default_rng(15)
    database = KeyframeDatabase(16, 0.1, patch_store="disk", disk_budget_gb=1e-4)
    for i in range(60):
        database.add(i, "front", place(rng))
    before = [(kf.ref, kf.vector.copy(), kf.read().copy()) for kf in database.snapshot().keyframes]
    snapshot = database.snapshot()
    for i in range(300):
        database.add(i, "front", place(rng))
    database.clear()
    for kf, (ref, vector, buffer) in zip(snapshot.keyframes, before, strict=True):
        assert kf.ref == ref
        np.testing.assert_array_equal(kf.vector, vector)
        np.testing.assert_array_equal(kf.read(), buffer)


def test_neighbours_in_time_are_of_the_same_session_and_camera():
    rng = np.random.default_rng(16)
    database = KeyframeDatabase(16, 1)
    for i in range(12):
        if i == 6:
            database.new_session()
        database.add(i, ("front", "rear")[i % 2], place(rng))
    assert [ref.id for ref in database.neighbours(8, 2)] == [6, 10]
    assert [ref.id for ref in database.neighbours(2, 1)] == [0, 4]
    assert [ref.id for ref in database.neighbours(4, 5)] == [0, 2]


def test_a_read_only_database_answers_and_takes_nothing():
    rng = np.random.default_rng(17)
    database = KeyframeDatabase(16, read_only=True)
    with pytest.raises(PnvError, match="read-only"):
        database.add(0, "front", place(rng))
    assert database.nearest(place(rng).global_vector, 5, 0, 0) == []


@pytest.mark.parametrize(
    ("vector", "message"),
    [(np.ones(16), "length 4"), (np.zeros(16), "length 0"), (np.ones(3), r"\(3,\)"), (np.full(16, np.nan), "nan")],
)
def test_what_is_no_unit_vector_is_refused(vector, message):
    database = KeyframeDatabase(16, 1)
    with pytest.raises(PnvError, match=message):
        database.add(0, "front", PlaceDescriptor(vector.astype(np.float32), ()))
    with pytest.raises(PnvError, match=message):
        database.nearest(vector, 1, 0, 0)


@pytest.mark.parametrize("option", ["eviction", "index", "patch_store", "patch_precision"])
def test_an_unknown_option_is_refused_with_what_is_allowed(option):
    with pytest.raises(ConfigError, match=f"{option} = 'other' is (out of range|not known); allowed: one of "):
        KeyframeDatabase(16, 1, **{option: "other"})


@pytest.mark.process
@pytest.mark.parametrize("eviction", ["oldest", "densest"])
def test_the_memory_of_the_process_stays_within_the_budget(eviction):
    budget, count = (256, 50_000) if FULL else (32, 3000)
    script = f"""
        import numpy as np
        from pnv_core.database import KeyframeDatabase
        from pnv_core.types import PatchGrid, PlaceDescriptor

        def resident():
            return int(open("/proc/self/statm").read().split()[1]) * 4096 / 1e6

        rng = np.random.default_rng(0)
        patches = rng.standard_normal((8, 1000, 64), dtype=np.float32)
        steps = rng.standard_normal((64, 256), dtype=np.float32) / 16
        vector = steps[0] / np.linalg.norm(steps[0])
        database = KeyframeDatabase(256, {budget}, {eviction!r})
        database.add(0, "front", PlaceDescriptor(vector, (PatchGrid(2, 25, 40, patches[0]),)))
        database.nearest(vector, 10, 0, 0)
        empty, figures = resident(), []
        for i in range({count}):
            vector = vector + 0.3 * steps[rng.integers(64)]
            vector /= np.linalg.norm(vector)
            database.nearest(vector, 10, i * 10**9, 30 * 10**9)
            database.add(i * 10**9, "front", PlaceDescriptor(vector, (PatchGrid(2, 25, 40, patches[i % 8]),)))
            if i % ({count} // 20) == 0:
                figures.append(resident() - empty)
        print(empty, max(figures), figures[-8], figures[-1])
    """
    out = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(script)],
        check=True,
        capture_output=True,
        text=True,
        env=os.environ | {"OMP_NUM_THREADS": "1"},
    )
    empty, most, earlier, last = map(float, out.stdout.split())
    print(f"{eviction}: empty process {empty:.1f} MB, above it at most {most:.1f} MB, at the end {last:.1f} MB")
    assert most + empty <= 1.1 * budget + empty
    assert abs(last - earlier) <= 0.02 * budget + 1
