"""Merging, thinning and exporting maps at rest."""

import csv

import numpy as np
import pytest

from pnv_cli.main import main
from pnv_core.errors import MapError
from pnv_core.maps import MapStore, tools
from test.maps.worlds import contents, driven, on_disk, saved


def test_merged_maps_keep_both_with_ids_and_sessions_of_their_own(tmp_path):
    a, b = saved(tmp_path / "a", 20, 10), saved(tmp_path / "b", 15)
    tools.merge(tmp_path / "a", tmp_path / "b", tmp_path / "c")
    merged = on_disk(tmp_path / "c")
    first, second = contents(a), contents(b)
    assert merged[:30] == first
    assert [m[1:] for m in merged[30:]] == [m[1:] for m in second]
    assert [m[0].stamp_ns for m in merged[30:]] == [m[0].stamp_ns for m in second]
    assert [m[0].id for m in merged] == list(range(45))
    assert {m[0].session for m in merged[30:]}.isdisjoint({m[0].session for m in first})


def test_maps_of_two_models_are_not_merged_and_a_map_is_not_written_over(tmp_path):
    saved(tmp_path / "a", 5)
    MapStore(tmp_path / "b", "other").save(driven(5).snapshot())
    with pytest.raises(MapError, match="one model"):
        tools.merge(tmp_path / "a", tmp_path / "b", tmp_path / "c")
    with pytest.raises(MapError, match="holds a map already"):
        tools.merge(tmp_path / "a", tmp_path / "a", tmp_path / "b")


def test_pruning_keeps_so_many_of_the_sessions_that_stay(tmp_path):
    truth = contents(saved(tmp_path / "map", 40, 40))
    tools.prune(tmp_path / "map", tmp_path / "less", keep=15, drop_sessions=[1])
    kept = on_disk(tmp_path / "less")
    assert len(kept) == 15
    assert all(keyframe in truth for keyframe in kept)
    assert {keyframe[0].session for keyframe in kept} == {0}
    tools.prune(tmp_path / "map", tmp_path / "newest", budget_mb=0.005, eviction="oldest")
    newest = on_disk(tmp_path / "newest")
    assert newest == truth[-len(newest) :]
    assert sum(len(keyframe[3]) + len(keyframe[4]) for keyframe in newest) <= 5000


def test_exports_hold_what_the_map_holds(tmp_path):
    database = saved(tmp_path / "map", 12)
    assert main(["map", "export", str(tmp_path / "map"), "-o", str(tmp_path / "m.csv")]) == 0
    assert main(["map", "export", str(tmp_path / "map"), "-o", str(tmp_path / "m.npz"), "--patches"]) == 0
    with open(tmp_path / "m.csv") as file:
        rows = list(csv.DictReader(file))
    arrays = np.load(tmp_path / "m.npz")
    for i, ref in enumerate(database.refs()):
        assert (int(rows[i]["id"]), int(rows[i]["stamp_ns"]), rows[i]["camera"]) == (ref.id, ref.stamp_ns, ref.camera)
        assert (arrays["ids"][i], arrays["stamps_ns"][i], arrays["cameras"][i]) == (ref.id, ref.stamp_ns, ref.camera)
        np.testing.assert_array_equal(arrays["global"][i], database.vector(ref.id))
        for codes in database.patches(ref.id):
            np.testing.assert_array_equal(arrays[f"patches_{codes.size}"][i], codes.decode())
            assert arrays[f"grid_{codes.size}"].tolist() == [codes.rows, codes.cols]


def test_the_command_line_says_what_a_map_is_and_what_is_wrong_with_it(tmp_path, capsys):
    saved(tmp_path / "map", 12, 8)
    assert main(["map", "info", str(tmp_path / "map")]) == 0
    assert "20, next id 20" in capsys.readouterr().out
    assert main(["map", "verify", str(tmp_path / "map")]) == 0
    segment = max((tmp_path / "map").glob("segment-*"))
    segment.write_bytes(segment.read_bytes()[:-1])
    capsys.readouterr()
    assert main(["map", "verify", str(tmp_path / "map")]) == 2
    assert str(segment) in capsys.readouterr().err
    assert main(["map", "recover", str(tmp_path / "map"), "-o", str(tmp_path / "out")]) == 0
    assert "20 keyframes recovered, 0 lost" in capsys.readouterr().out
    for wrong in (["info", str(tmp_path)], ["prune", str(tmp_path / "out"), "-o", str(tmp_path / "x")]):
        assert main(["map", *wrong]) == 2
        assert capsys.readouterr().err.count("\n") == 1
