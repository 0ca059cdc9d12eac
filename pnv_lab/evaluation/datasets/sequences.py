"""Sequences with poses: a place is asked for again when the robot comes back to it.

Every image is a query and a reference; a query finds only images older than `exclude_recent_s`.
Rule: at most `radius_m` away and `angle_deg` turned.
Layouts: poses.csv (frame,timestamp,x,y,z and yaw in radians or qx,qy,qz,qw) beside the images or an images folder;
TUM RGB-D (rgb.txt and groundtruth.txt, https://cvg.cit.tum.de/data/datasets/rgbd-dataset); KITTI odometry
(image_0 or image_2 and times.txt under ROOT/sequences/NN, ROOT/poses/NN.txt, https://www.cvlibs.net/datasets/kitti);
EuRoC (mav0/cam0/data.csv and mav0/state_groundtruth_estimate0/data.csv, https://projects.asl.ethz.ch/datasets).
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pnv_core.errors import PnvError
from pnv_core.images import list_images
from pnv_lab.evaluation.datasets.dataset import Dataset
from pnv_lab.evaluation.datasets.pose_truth import heading, pose, rotation, within_pose
from pnv_lab.evaluation.datasets.tables import existing, number, numbers, rows, words

_MAX_GAP_S = 0.05  # between an image and its pose; a camera period at 20 Hz


@dataclass(frozen=True)
class SequenceRule:
    """When two images of a sequence show the same place, and how long a place is not asked for again."""

    radius_m: float = 5.0
    angle_deg: float = 45.0
    exclude_recent_s: float = 30.0

    def words(self) -> str:
        return (
            f"at most {self.radius_m:g} m away and {self.angle_deg:g} degrees turned, "
            f"at least {self.exclude_recent_s:g} s older"
        )


def older_than(stamps: NDArray[np.float64], gap_s: float) -> tuple[NDArray[np.int64], ...]:
    """Per image of a sequence in time order the images that are not at least `gap_s` older (views of one array)."""
    limits = np.searchsorted(stamps, stamps - gap_s, side="right")
    limits = np.minimum(limits, np.arange(len(stamps)))  # never itself or a later one
    everything = np.arange(len(stamps))
    return tuple(everything[limit:] for limit in limits)


def sequence(name: str, files: tuple[Path, ...], stamps: NDArray, poses: NDArray, rule: SequenceRule) -> Dataset:
    """A data set of one sequence; its images are put in time order."""
    order = np.argsort(stamps, kind="stable")
    files, stamps, poses = tuple(files[i] for i in order), stamps[order], poses[order]
    excluded = older_than(stamps, rule.exclude_recent_s)
    near = within_pose(poses, poses, rule.radius_m, rule.angle_deg)
    truth = tuple(t[t < len(files) - len(barred)] for t, barred in zip(near, excluded, strict=True))
    return Dataset(
        name, files, files, truth, rule.words(), excluded=excluded, sequence=True,
        query_positions=poses[:, :3, 3], stamps=stamps,
    )  # fmt: skip


def poses_csv(root: Path, rule: SequenceRule) -> Dataset:
    """ROOT/poses.csv with the images it names in ROOT/images or ROOT."""
    source = root / "poses.csv"
    table = rows(source, ("frame", "timestamp", "x", "y", "z"))
    if not table:
        raise PnvError(f"{source}: holds no pose")
    base = root / "images" if (root / "images").is_dir() else root
    quaternions = {"qx", "qy", "qz", "qw"} <= set(table[0])
    if not quaternions and "yaw" not in table[0]:
        raise PnvError(f"{source}: lacks yaw, or qx, qy, qz and qw")
    poses = []
    for row in table:
        position = [number(source, row, axis) for axis in "xyz"]
        if quaternions:
            turn = rotation(*(number(source, row, f"q{axis}") for axis in "wxyz"))
            poses.append(pose(turn, position))
        else:
            poses.append(heading(number(source, row, "yaw"), position))
    stamps = np.array([number(source, row, "timestamp") for row in table])
    return sequence(root.name, existing(base, [row["frame"] for row in table]), stamps, np.array(poses), rule)


def tum(root: Path, rule: SequenceRule) -> Dataset:
    """A TUM RGB-D sequence."""
    listed = words(root / "rgb.txt")
    stamps = np.array([numbers(root / "rgb.txt", n, line[:1], 1)[0] for n, line in listed])
    truth = np.array([numbers(root / "groundtruth.txt", n, line, 8) for n, line in words(root / "groundtruth.txt")])
    poses = [pose(rotation(r[7], *r[4:7]), r[1:4]) for r in truth]
    return _associated(root.name, existing(root, [line[1] for _, line in listed]), stamps, truth[:, 0], poses, rule)


def kitti(root: Path, rule: SequenceRule, split: str = "") -> Dataset:
    """A KITTI odometry sequence; `split` is its number, by default 00."""
    number_ = split or "00"
    folder = root / "sequences" / number_
    images = next((folder / c for c in ("image_2", "image_0") if (folder / c).is_dir()), None)
    if images is None:
        raise PnvError(f"{folder}: holds neither image_2 nor image_0; --split takes the number of a sequence")
    files = tuple(list_images(images))
    source = root / "poses" / f"{number_}.txt"
    matrices = [np.array(numbers(source, n, line, 12)).reshape(3, 4) for n, line in words(source)]
    stamps = [numbers(folder / "times.txt", n, line, 1)[0] for n, line in words(folder / "times.txt")]
    if not len(files) == len(matrices) == len(stamps):
        raise PnvError(
            f"{folder}: {len(files)} images, {len(stamps)} times and {len(matrices)} poses; allowed: as many"
        )
    poses = np.array([pose(m[:, :3], m[:, 3]) for m in matrices])
    return sequence(f"kitti-{number_}", files, np.array(stamps), poses, rule)


def euroc(root: Path, rule: SequenceRule) -> Dataset:
    """An EuRoC sequence; poses are the body's, a constant turn away from the camera's."""
    base = root / "mav0" if (root / "mav0").is_dir() else root
    listed = base / "cam0" / "data.csv"
    table = rows(listed, ("timestamp [ns]", "filename"))
    stamps = np.array([number(listed, r, "timestamp [ns]") / 1e9 for r in table])
    source = base / "state_groundtruth_estimate0" / "data.csv"
    values = []
    for line, texts in words(source):
        fields = [t for t in "".join(texts).split(",") if t]
        values.append(numbers(source, line, fields[:8], 8))
    truth = np.array(values)
    poses = [pose(rotation(*r[4:8]), r[1:4]) for r in truth]
    files = existing(base / "cam0" / "data", [r["filename"].strip() for r in table])
    return _associated(root.name, files, stamps, truth[:, 0] / 1e9, poses, rule)


def _associated(
    name: str, files: tuple[Path, ...], stamps: NDArray, pose_stamps: NDArray, poses: list[NDArray], rule: SequenceRule
) -> Dataset:
    """The images that have a pose close in time, with the nearest one."""
    order = np.argsort(pose_stamps)
    times = pose_stamps[order]
    right = np.searchsorted(times, stamps).clip(1, len(times) - 1)
    nearest = np.where(stamps - times[right - 1] <= times[right] - stamps, right - 1, right)
    kept = np.flatnonzero(np.abs(times[nearest] - stamps) <= _MAX_GAP_S)
    if not len(kept):
        raise PnvError(f"{name}: no image has a pose within {_MAX_GAP_S} s; do both files use the same clock?")
    chosen = np.array([poses[order[nearest[i]]] for i in kept])
    return sequence(name, tuple(files[i] for i in kept), stamps[kept], chosen, rule)
