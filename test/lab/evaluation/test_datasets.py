"""Every data set layout on a miniature copy; ground truth and figures worked out by hand."""

import csv
import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat

from pnv_cli.main import main
from pnv_core.config import Config
from pnv_core.errors import PnvError
from pnv_lab.evaluation.datasets import Dataset, SequenceRule, open_dataset
from pnv_lab.evaluation.datasets.seasons import TOLERANCES, write_submission
from pnv_lab.evaluation.evaluate import Evaluation, localised
from pnv_lab.evaluation.methods import global_method
from pnv_lab.evaluation.metrics import recall_at

from .places import place, write

SMALL = Config.make(image_width=160, image_height=112, patch_sizes=(2,), patch_weights=(1.0,), threads=1)


def silent(items, count, what) -> Iterator:  # type: ignore[no-untyped-def]
    return iter(items)


def truth(dataset: Dataset) -> list[list[int]]:
    return [t.tolist() for t in dataset.truth]


def retrieved(dataset: Dataset, cache: Path):  # type: ignore[no-untyped-def]
    return Evaluation(SMALL, cache, silent).run(dataset, [global_method()])[0]


def table(path: Path, header: str, rows: list[tuple]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with open(path, "w", newline="") as file:
        csv.writer(file).writerows([header.split(","), *rows])


def test_nordland_accepts_ten_frames(tmp_path: Path) -> None:
    for i in range(24):
        write(tmp_path / "summer" / f"{i:05}.png", place(i))
        shown = {0: 23, 5: 12}.get(i, i)  # winter 0 looks like 23, which is too far; winter 5 like 12, which is not
        write(tmp_path / "winter" / f"{i:05}.png", place(shown, gain=0.8))
    dataset = open_dataset("nordland", tmp_path)
    assert truth(dataset)[0] == list(range(11))
    assert truth(dataset)[23] == list(range(13, 24))
    assert recall_at(retrieved(dataset, tmp_path / "cache").hits, 1) == pytest.approx(23 / 24)
    (tmp_path / "cleanImageNames.txt").write_text("00000.png\n00023.png\n")
    assert truth(open_dataset("nordland", tmp_path, "summer/winter")) == [[0, 1], [0, 1]]


def netvlad_list(path: Path, references: list, queries: list) -> None:
    names, utm = zip(*references, strict=True)
    asked, at = zip(*queries, strict=True)
    listed = {"dbImageFns": np.array(names, object)[:, None], "qImageFns": np.array(asked, object)[:, None]}
    listed |= {"utmDb": np.array(utm, float).T, "utmQ": np.array(at, float).T}
    path.parent.mkdir(parents=True, exist_ok=True)
    savemat(path, {"dbStruct": listed | {"whichSet": "test", "posDistThr": 25.0}})


def test_pittsburgh_accepts_25_metres(tmp_path: Path) -> None:
    references = [("000/a.jpg", (0, 0)), ("000/b.jpg", (100, 0)), ("001/c.jpg", (200, 0))]
    queries = [("q/0.jpg", (0, 25)), ("q/1.jpg", (100, 25.1)), ("q/2.jpg", (190, 0))]
    netvlad_list(tmp_path / "datasets" / "pitts30k_test.mat", references, queries)
    for seed, (name, _) in enumerate(references):
        write(tmp_path / name, place(seed))
    for seed, (name, _) in zip((0, 1, 1), queries, strict=True):  # the third looks like the second place
        write(tmp_path / "queries_real" / name, place(seed, shift=3))
    dataset = open_dataset("pitts30k", tmp_path)
    assert truth(dataset) == [[0], [], [2]]
    assert dataset.answerable == 2
    assert recall_at(retrieved(dataset, tmp_path / "cache").hits, 1) == pytest.approx(1 / 2)


def test_tokyo_counts_the_cut_outs_of_a_panorama_once(tmp_path: Path) -> None:
    references = [(f"03814/{p}_{y:03}.jpg", (1000.0 * p, 0)) for p in range(2) for y in range(12)]
    netvlad_list(tmp_path / "tokyo247.mat", references, [("00001.jpg", (1000, 3))])
    for number, (name, _) in enumerate(references):
        look = place(7, shift=number) if number < 6 else place(7, shift=30) if number == 12 else place(100 + number)
        write((tmp_path / "database_gsv_vga" / name).with_suffix(".png"), look)  # the list says .jpg, the disk .png
    write(tmp_path / "247query_subset_v2" / "00001.jpg", place(7))
    dataset = open_dataset("tokyo247", tmp_path)
    assert truth(dataset) == [list(range(12, 24))]
    hits = retrieved(dataset, tmp_path / "cache").hits
    assert recall_at(hits, 1) == 0.0
    assert recall_at(hits, 2) == 1.0  # six cut-outs of the wrong panorama are one answer


def test_mapillary_accepts_25_metres_and_40_degrees(tmp_path: Path) -> None:
    def city(part: str, images: list[tuple[str, float, float, float, bool, int]]) -> None:
        folder = tmp_path / "train_val" / "cph" / part
        rows = [("", k, e, n, False) for k, e, n, _, _, _ in images]
        table(folder / "postprocessed.csv", ",key,easting,northing,night", rows)
        table(folder / "raw.csv", ",key,ca,pano", [("", k, ca, pano) for k, _, _, ca, pano, _ in images])
        table(folder / "subtask_index.csv", ",key,all", [("", k, True) for k, *_ in images])
        for key, *_, seed in images:
            write(folder / "images" / f"{key}.jpg", place(seed, shift=2 if part == "query" else 0))

    city(
        "database",
        [("a", 0, 0, 350, False, 0), ("b", 0, 0, 90, False, 1), ("c", 60, 0, 0, False, 2), ("p", 0, 0, 0, True, 0)],
    )
    city("query", [("x", 25, 0, 30, False, 0), ("y", 25, 0, 31, False, 0), ("z", 62, 0, 10, False, 1)])
    dataset = open_dataset("msls", tmp_path, "cph")
    assert truth(dataset) == [[0], [], [2]]  # 40 degrees across north, 41 degrees, 10 degrees
    assert len(dataset.references) == 3  # the panorama is left out
    assert recall_at(retrieved(dataset, tmp_path / "cache").hits, 1) == pytest.approx(1 / 2)


def test_robotcar_inherits_the_pose_of_the_best_reference(tmp_path: Path) -> None:
    half = np.sqrt(0.5)
    names = [f"overcast-reference/rear/{i}.jpg" for i in range(3)]
    # identity at the origin; turned a quarter about z (world to camera) at (10, 0, 0); identity at (50, 0, 0)
    poses = ["1 0 0 0 0 0 0", f"{half} 0 0 {half} 10 0 0", "1 0 0 0 50 0 0"]
    model = "NVM_V3\n\n3\n" + "".join(f"./{n} 400 {p} 0 0\n" for n, p in zip(names, poses, strict=True))
    (tmp_path / "3D-models" / "all-merged").mkdir(parents=True)
    (tmp_path / "3D-models" / "all-merged" / "all.nvm").write_text(model)
    quarter = "0 1 0 10.4 -1 0 0 0 0 0 1 0 0 0 0 1"  # camera to world: the inverse turn, 0.4 m off
    rows = [
        ("sun/rear/11.jpg", "1 0 0 0.2 0 1 0 0 0 0 1 0 0 0 0 1", 0),
        ("night/rear/12.jpg", quarter, 1),
        ("night/rear/13.jpg", "1 0 0 53 0 1 0 0 0 0 1 0 0 0 0 1", 2),
        ("night/rear/14.jpg", "1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1", 2),  # looks like a reference 50 m away
    ]
    (tmp_path / "robotcar_v2_train.txt").write_text("".join(f"{n} {m}\n" for n, m, _ in rows))
    for seed, name in enumerate(names):
        write(tmp_path / "images" / name, place(seed))
    for name, _, seed in rows:
        write(tmp_path / "images" / name, place(seed, shift=2))
    dataset = open_dataset("robotcar", tmp_path)
    assert dataset.conditions == ("sun", "night", "night", "night")
    assert truth(dataset) == [[0], [1], [2], [0]]
    result = retrieved(dataset, tmp_path / "cache")
    assert localised(result, TOLERANCES) == pytest.approx([1 / 4, 2 / 4, 3 / 4])
    assert write_submission(tmp_path / "out.txt", dataset, [int(r.references[0]) for r in result.rankings]) == 4
    first, second, *_ = (tmp_path / "out.txt").read_text().splitlines()
    assert first.split()[0] == "rear/11.jpg"
    assert np.array(first.split()[1:], float) == pytest.approx([1, 0, 0, 0, 0, 0, 0])
    # R = quarter turn about z, c = (10, 0, 0): t = -R c = (0, -10, 0)
    assert np.array(second.split()[1:], float) == pytest.approx([half, 0, 0, half, 0, -10, 0])

    small = [
        "--image-width",
        "160",
        "--image-height",
        "112",
        "--patch-sizes",
        "2",
        "--threads",
        "1",
        "--method",
        "netvlad",
    ]
    given = ["--dataset", "robotcar", "--root", str(tmp_path), "--cache", str(tmp_path / "cache"), *small]
    assert main(["evaluate", *given, "--out", str(tmp_path / "train")]) == 0
    rows = {r["condition"]: r for r in json.loads((tmp_path / "train" / "results.json").read_text())}
    assert [rows[c]["within_0.5m_5deg"] for c in ("", "sun", "night")] == pytest.approx([2 / 4, 1, 1 / 3], abs=1e-5)
    # the test list has names only: nothing to measure, but a file to submit and a report to look at
    (tmp_path / "robotcar_v2_test.txt").write_text("night/rear/12.jpg\n")
    assert main(["evaluate", *given, "--split", "test", "--out", str(tmp_path / "test")]) == 0
    assert (tmp_path / "test" / "robotcar-seasons-v2_eval_netvlad.txt").read_text() == second + "\n"
    assert "nan" not in (tmp_path / "test" / "report.html").read_text().split("<svg", 1)[1].split("data:image")[0]


def test_cmu_queries_are_compared_within_their_slice(tmp_path: Path) -> None:
    for number, offset in ((3, 0.0), (20, 0.1)):
        folder = tmp_path / f"slice{number}"
        for i in range(2):
            write(folder / "database" / f"img_{i}_c0_{number}us.jpg", place(i))
        lines = [f"img_{i}_c0_{number}us.jpg 1 0 0 0 {100 * i} {offset} 0\n" for i in range(2)]
        folder.joinpath(f"ground-truth-database-images-slice{number}.txt").write_text("".join(lines))
        write(folder / "query" / f"img_9_c0_{number}us.jpg", place(1, shift=2))
        folder.joinpath(f"test-images-slice{number}.txt").write_text(f"img_9_c0_{number}us.jpg\n")
    (tmp_path / "slice3" / "camera-poses").mkdir()
    (tmp_path / "slice3" / "camera-poses" / "slice-3-gt-query-images.txt").write_text(
        "img_9_c0_3us.jpg 1 0 0 0 100.4 0 0\n"
    )
    dataset = open_dataset("cmu", tmp_path)
    assert dataset.conditions == ("urban", "park")
    assert truth(dataset) == [[1], []]  # the second query's pose is withheld
    result = retrieved(dataset, tmp_path / "cache")
    assert [set(r.references.tolist()) for r in result.rankings] == [{0, 1}, {2, 3}]
    assert localised(result, TOLERANCES) == [0.0, 1.0, 1.0]
    write_submission(tmp_path / "out.txt", dataset, [int(r.references[0]) for r in result.rankings])
    assert (tmp_path / "out.txt").read_text().splitlines()[1].startswith("img_9_c0_20us.jpg 1.0")
    assert open_dataset("cmu", tmp_path, "park").conditions == ("park",)
    with pytest.raises(PnvError, match=r"\[3, 20\]"):
        open_dataset("cmu", tmp_path, "4-8")


# A square walked once and then its first side again: x, y, heading per image, one image per second.
WALK = [
    (0, 0, 0),
    (10, 0, 0),
    (20, 0, 90),
    (20, 10, 180),
    (10, 10, 180),
    (0, 10, 270),
    (0, 1, 0),
    (10, 1, 0),
    (20, 1, 180),
]
REVISITS = {6: [0], 7: [1]}  # image 8 is back at image 2 but turned by 90 degrees
RULE = SequenceRule(radius_m=2.0, angle_deg=45.0, exclude_recent_s=3.0)


def check_walk(dataset: Dataset, cache: Path) -> None:
    assert {i: t for i, t in enumerate(truth(dataset)) if t} == REVISITS
    assert dataset.excluded is not None
    assert dataset.excluded[7].tolist() == [5, 6, 7, 8]  # only images at least three seconds older may be found
    result = retrieved(dataset, cache)
    assert recall_at(result.hits, 1) == 1.0
    assert result.decisions.possible.sum() == 2


def walk_images(folder: Path, pattern: str) -> list[Path]:
    seeds = [0, 1, 2, 3, 4, 5, 0, 1, 8]
    return [write(folder / pattern.format(i), place(s, shift=2 * (i > 5))) for i, s in enumerate(seeds)]


def test_a_folder_with_poses(tmp_path: Path) -> None:
    walk_images(tmp_path / "images", "{:03}.png")
    rows = [(f"{i:03}.png", i, x, y, 0, np.radians(a)) for i, (x, y, a) in enumerate(WALK)]
    table(tmp_path / "poses.csv", "frame,timestamp,x,y,z,yaw", rows)
    check_walk(open_dataset("folder", tmp_path, rule=RULE), tmp_path / "cache")


def test_a_tum_sequence(tmp_path: Path) -> None:
    files = walk_images(tmp_path / "rgb", "{}.png")
    (tmp_path / "rgb.txt").write_text(
        "# colour\n" + "".join(f"{100 + i}.01 rgb/{f.name}\n" for i, f in enumerate(files))
    )
    lines = []
    for i, (x, y, a) in enumerate(WALK):
        half = np.radians(a) / 2
        lines.append(f"{100 + i}.0 {x} {y} 0 0 0 {np.sin(half)} {np.cos(half)}\n")
    (tmp_path / "groundtruth.txt").write_text("# truth\n" + "".join(lines))
    check_walk(open_dataset("tum", tmp_path, rule=RULE), tmp_path / "cache")


def test_a_kitti_sequence(tmp_path: Path) -> None:
    walk_images(tmp_path / "sequences" / "07" / "image_0", "{:06}.png")
    (tmp_path / "sequences" / "07" / "times.txt").write_text("".join(f"{i}.0\n" for i in range(len(WALK))))
    (tmp_path / "poses").mkdir()
    lines = []
    for x, y, a in WALK:
        c, s = np.cos(np.radians(a)), np.sin(np.radians(a))
        lines.append(f"{c} {-s} 0 {x} {s} {c} 0 {y} 0 0 1 0\n")
    (tmp_path / "poses" / "07.txt").write_text("".join(lines))
    check_walk(open_dataset("kitti", tmp_path, "07", RULE), tmp_path / "cache")


def test_a_euroc_sequence(tmp_path: Path) -> None:
    files = walk_images(tmp_path / "mav0" / "cam0" / "data", "{}.png")
    rows = [(10**18 + i * 10**9, f.name) for i, f in enumerate(files)]
    table(tmp_path / "mav0" / "cam0" / "data.csv", "#timestamp [ns],filename", rows)
    truth_rows = []
    for i, (x, y, a) in enumerate(WALK):
        half = np.radians(a) / 2
        truth_rows.append((10**18 + i * 10**9 + 4 * 10**6, x, y, 0, np.cos(half), 0, 0, np.sin(half), 0, 0, 0))
    source = tmp_path / "mav0" / "state_groundtruth_estimate0" / "data.csv"
    table(source, "#timestamp,p_x,p_y,p_z,q_w,q_x,q_y,q_z,v_x,v_y,v_z", truth_rows)
    check_walk(open_dataset("euroc", tmp_path, rule=RULE), tmp_path / "cache")


def test_a_folder_with_matches_of_one_sequence(tmp_path: Path) -> None:
    walk_images(tmp_path / "images", "{:03}.png")
    table(tmp_path / "matches.csv", "query,true_refs", [("006.png", "000.png"), ("007.png", "001.png;006.png")])
    table(tmp_path / "frames.csv", "frame,timestamp", [(f"{i:03}.png", i) for i in range(9)])
    check_walk(open_dataset("folder", tmp_path, rule=RULE), tmp_path / "cache")


def test_a_folder_of_links_holds_no_more_than_the_links(tmp_path: Path) -> None:
    for seed in range(6):
        write(tmp_path / "pool" / f"{seed}.png", place(seed))
    for name, seeds in (("query", (0, 1)), ("ref", (2, 3, 4))):
        (tmp_path / "links" / name).mkdir(parents=True)
        for seed in seeds:
            (tmp_path / "links" / name / f"{seed}.png").symlink_to(tmp_path / "pool" / f"{seed}.png")
    (tmp_path / "links" / "matches.csv").write_text("query,true_refs\nquery/0.png,ref/2.png\nquery/1.png,ref/3.png\n")
    dataset = open_dataset("folder", tmp_path / "links")
    assert [p.name for p in dataset.queries] == ["0.png", "1.png"]
    assert [p.name for p in dataset.references] == ["2.png", "3.png", "4.png"]
    assert not dataset.sequence


def test_names_that_carry_the_position(tmp_path: Path) -> None:
    for i in range(3):
        write(tmp_path / "images/test/database" / f"@{100 * i}@0@x@.jpg", place(i))
    write(tmp_path / "images/test/queries" / "@120@0@x@.jpg", place(1))
    assert truth(open_dataset("utm", tmp_path)) == [[1]]
    assert truth(open_dataset("tokyo247", tmp_path)) == [[1]]
    write(tmp_path / "images/test/queries" / "plain.jpg", place(1))
    with pytest.raises(PnvError, match=r"plain.jpg: allowed names"):
        open_dataset("utm", tmp_path)


@pytest.mark.parametrize(
    "kind", ["nordland", "pitts30k", "tokyo247", "msls", "robotcar", "cmu", "tum", "kitti", "euroc"]
)
def test_an_empty_folder_is_refused_in_one_line(kind: str, tmp_path: Path) -> None:
    with pytest.raises(PnvError) as refusal:
        open_dataset(kind, tmp_path)
    assert str(tmp_path) in str(refusal.value)
    assert "\n" not in str(refusal.value)
