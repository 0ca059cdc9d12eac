"""RobotCar Seasons v2 and Extended CMU Seasons: long-term visual localisation.

Where: https://www.visuallocalization.net/datasets/.
Layout of RobotCar: ROOT/images/CONDITION/CAMERA/STAMP.jpg, ROOT/3D-models/all-merged/all.nvm,
ROOT/robotcar_v2_train.txt (name and a 4x4 matrix camera to world) and ROOT/robotcar_v2_test.txt (names).
Layout of CMU: ROOT/sliceN/database, query, ground-truth-database-images-sliceN.txt, test-images-sliceN.txt and
camera-poses/*.txt (poses of about half the queries).
Rule: the query takes over the pose of the best reference; it counts at 0.25 m and 2 degrees, 0.5 m and 5, 5 m and 10
(Toft et al., TPAMI 2020). Recall@N counts references within the last of these.
"""

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pnv_core.errors import PnvError
from pnv_core.files import atomic_write
from pnv_lab.evaluation.datasets.dataset import Dataset
from pnv_lab.evaluation.datasets.pose_truth import pose_from_world_rotation, quaternion, within_pose
from pnv_lab.evaluation.datasets.tables import existing, numbers, words

TOLERANCES = ((0.25, 2.0), (0.5, 5.0), (5.0, 10.0))  # metres, degrees
_UNKNOWN = np.full((4, 4), np.nan)
_RULE = "pose of the best reference within 0.25 m, 2 deg / 0.5 m, 5 deg / 5 m, 10 deg"
SCENES = {"urban": range(2, 9), "suburban": range(9, 18), "park": range(18, 26)}  # the CMU slices


def robotcar_seasons(root: Path, split: str = "") -> Dataset:
    """`split` is train (queries with poses, the default) or test (poses withheld: only the submission file).

    All 49 submaps are merged and the given submap is not used, as in the paper's supplement.
    """
    if split not in ("", "train", "test"):
        raise PnvError(f"--split {split!r}; allowed for robotcar: train, test")
    known = _nvm_poses(root / "3D-models" / "all-merged" / "all.nvm")
    source = root / f"robotcar_v2_{split or 'train'}.txt"
    listed = words(source)
    names = [line[0] for _, line in listed]
    poses = [np.array(numbers(source, n, line[1:], 16)).reshape(4, 4) if line[1:] else _UNKNOWN for n, line in listed]
    return _dataset(
        "robotcar-seasons-v2",
        existing(root / "images", names),
        existing(root / "images", list(known)),
        np.array(poses),
        np.array(list(known.values())),
        conditions=tuple(Path(name).parts[0] for name in names),
        names=tuple("/".join(Path(name).with_suffix(".jpg").parts[-2:]) for name in names),
    )


def cmu_seasons(root: Path, split: str = "") -> Dataset:
    """`split` names slices, such as 2,3,4 or 2-8, or urban, suburban, park; by default every slice under ROOT.

    A query is compared with the references of its own slice, as the benchmark gives it.
    """
    queries: list[Path] = []
    references: list[Path] = []
    query_poses: list[np.ndarray] = []
    reference_poses: list[np.ndarray] = []
    conditions: list[str] = []
    query_slice: list[int] = []
    reference_slice: list[int] = []
    for number in _slices(root, split):
        folder = root / f"slice{number}"
        known = _cmu_poses(folder / f"ground-truth-database-images-slice{number}.txt")
        given: dict[str, np.ndarray] = {}
        for file in sorted((folder / "camera-poses").glob("*.txt")):
            given |= _cmu_poses(file)
        names = [line[0] for _, line in words(folder / f"test-images-slice{number}.txt")] + sorted(given)
        names = list(dict.fromkeys(names))
        scene = next((s for s, r in SCENES.items() if number in r), "other")
        queries += existing(folder / "query", names)
        references += existing(folder / "database", list(known))
        query_poses += [given.get(name, _UNKNOWN) for name in names]
        reference_poses += known.values()
        conditions += [scene] * len(names)
        query_slice += [number] * len(names)
        reference_slice += [number] * len(known)
    slices = np.array(reference_slice)
    others = {number: np.flatnonzero(slices != number) for number in set(query_slice)}
    return _dataset(
        "extended-cmu-seasons",
        tuple(queries),
        tuple(references),
        np.array(query_poses),
        np.array(reference_poses),
        conditions=tuple(conditions),
        names=tuple(q.name for q in queries),
        excluded=tuple(others[n] for n in query_slice) if len(others) > 1 else None,
    )


def _dataset(name: str, queries, references, query_poses, reference_poses, **more) -> Dataset:
    radius, angle = TOLERANCES[-1]
    truth = within_pose(query_poses, reference_poses, radius, angle)
    if more.get("excluded"):
        truth = tuple(np.setdiff1d(true, barred) for true, barred in zip(truth, more["excluded"], strict=True))
    return Dataset(
        name, queries, references, truth, _RULE, query_poses=query_poses, reference_poses=reference_poses, **more
    )


def _slices(root: Path, split: str) -> list[int]:
    present = sorted(int(m[1]) for p in root.glob("slice*") if (m := re.fullmatch(r"slice(\d+)", p.name)))
    if not present:
        raise PnvError(f"{root}: no folder sliceN; allowed: the extracted slices of Extended CMU Seasons")
    if not split:
        return present
    wanted: set[int] = set()
    for part in split.split(","):
        span = re.fullmatch(r"(\d+)(?:-(\d+))?", part)
        if part in SCENES:
            wanted |= set(SCENES[part])
        elif span:
            wanted |= set(range(int(span[1]), int(span[2] or span[1]) + 1))
        else:
            raise PnvError(f"--split {split!r}; allowed for cmu: slices such as 2,3 or 2-8, or {', '.join(SCENES)}")
    chosen = [n for n in present if n in wanted]
    if not chosen:
        raise PnvError(f"--split {split!r}: none of these slices is under {root}; there are {present}")
    return chosen


def _nvm_poses(path: Path) -> dict[str, np.ndarray]:
    """Image name -> pose from an NVM model: name focal qw qx qy qz cx cy cz radial 0, world to camera and centre."""
    lines = words(path)
    if len(lines) < 2 or not lines[0][1][0].startswith("NVM"):
        raise PnvError(f"{path}: is no NVM model")
    count = int(numbers(path, lines[1][0], lines[1][1], 1)[0])
    poses = {}
    for line, texts in lines[2 : 2 + count]:
        values = numbers(path, line, texts[2:9], 7)
        poses[texts[0].removeprefix("./")] = _pose(path, line, values)
    return poses


def _cmu_poses(path: Path) -> dict[str, np.ndarray]:
    """Image name -> pose from lines name qw qx qy qz cx cy cz, world to camera and centre."""
    poses = {}
    for line, texts in words(path):
        poses[texts[0]] = _pose(path, line, numbers(path, line, texts[1:8], 7))
    return poses


def _pose(path: Path, line: int, values: list[float]) -> np.ndarray:
    try:
        return pose_from_world_rotation(values[:4], values[4:])
    except ValueError as error:
        raise PnvError(f"{path} line {line}: {error}") from None


def write_submission(path: Path, dataset: Dataset, best: Sequence[int]) -> int:
    """The benchmark's file: `name qw qx qy qz tx ty tz` per query, world to camera; -1 leaves a query out.

    Gives how many lines were written. Raises PnvError for a data set without poses.
    """
    if dataset.reference_poses is None or not dataset.names:
        raise PnvError(f"{dataset.name}: has no reference poses; a submission is for robotcar and cmu")
    lines = []
    for name, reference in zip(dataset.names, best, strict=True):
        if reference >= 0:
            pose = dataset.reference_poses[reference]
            turn = pose[:3, :3].T
            numbers_ = (*quaternion(turn), *(-turn @ pose[:3, 3]))
            lines.append(f"{name} {' '.join(f'{v:.12f}' for v in numbers_)}\n")
    with atomic_write(path) as file:
        file.write("".join(lines).encode())
    return len(lines)
