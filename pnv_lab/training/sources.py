"""What training learns places from: folders of images and what is known of which of them show one place.

A training folder has `images/` and `groups.csv` (image, place_or_sequence_id, index_in_sequence), or `poses.csv`
(frame, x, y, z, yaw), and may have `panos/` (equirectangular panoramas). Which pairs are positive, negative or neither
is decided by `SetRule`.
"""

import csv
import re
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from pnv_core.errors import ModelError
from pnv_core.images import read_image

Pose = tuple[float, float, float, float]  # x, y, z in metres, yaw in radians

LONGER_SIDE = 480  # pixels kept of a training image; views are smaller
PANORAMA_WIDTH = 1600


@dataclass(frozen=True)
class SetRule:
    """How a set's images relate. Gaps count positions in a sequence.

    Images of one sequence at most `same` apart show one place; more than `other` apart, two; -1 = never known to be
    two (laps, one desk). Different sequences are different places unless `alias` (a pattern whose first group is
    compared) says they may be one. `step` thins a sequence.
    """

    same: int = 0
    other: int = -1
    alias: str = ""
    step: int = 1
    weight: float = 1.0  # how often its places are drawn, per image


DEFAULT_RULE = SetRule()
RULES: dict[str, SetRule] = {
    "ie_tower": SetRule(other=2, alias=r"(.*)-v\d+$", weight=1.0),
    "polyhaven_hdri": SetRule(weight=0.4),
    "wosevision_campus_tour": SetRule(alias=r"([a-z]+)-.*", weight=0.4),
    "rc_patio_laps": SetRule(weight=0.5),
    "tum_rgbd_fr1": SetRule(same=4, weight=0.3),
    "udacity_highway": SetRule(same=1, other=15, weight=0.7),
    "rtabmap_corridor": SetRule(weight=1.0),
    "opensfm_lund_berlin": SetRule(weight=1.0),
    "icl_office_kt3_synth": SetRule(same=5, weight=0.35),
    "ikuta_campus_loop": SetRule(other=2, weight=1.5),
    # Panoramas: what may show one place has one alias (their ATTRIBUTION.txt).
    "cubemap_places": SetRule(alias=r"(modern_buildings|teufelsberg|palermo)_.*", weight=0.4),
    "panoramas": SetRule(alias=r"(uvic|wide_street|greenwich_park|afrikaans_church)_.*", weight=0.4),
}

# Kept out of training to validate on: whole floors, whole panoramas, whole sets.
HELD_FLOORS = ("floor5", "floor12", "floor17", "floor21", "basement3")
HELD_PANORAMAS = (
    "leadenhall-market",
    "modern-buildings-2",
    "venice-sunset",
    "autoshop-01",
    "forest-slope",
    "dancing-hall",
)
HELD_SETS = ("rtabmap_corridor", "opensfm_lund_berlin", "tum_rgbd_samples")

POSE_SAME_M, POSE_SAME_DEG = 0.5, 20.0
POSE_OTHER_M, POSE_OTHER_DEG = 1.5, 60.0


@dataclass(frozen=True, eq=False)
class PlaceImage:
    """An image and where in its set it belongs. `family` is equal where two sequences may show one place."""

    name: str
    set_name: str
    sequence: str
    family: str
    index: int
    rgb: NDArray[np.uint8]
    panorama: bool = False
    pose: Pose | None = None


def is_held(image: PlaceImage) -> bool:
    """Whether an image is kept out of training."""
    place = image.family.split("/")[1]
    held = {"ie_tower": HELD_FLOORS, "polyhaven_hdri": HELD_PANORAMAS}.get(image.set_name, ())
    return image.set_name in HELD_SETS or place in held


def load_set(folder: Path | str) -> list[PlaceImage]:
    """The images of one training folder, thinned as its rule says. Raises ModelError for a folder without images."""
    folder = Path(folder)
    rule = RULES.get(folder.name, DEFAULT_RULE)
    rows: list[tuple[str, str, int, Pose | None]]
    if (folder / "groups.csv").is_file():
        rows = [
            (r["image"], r["place_or_sequence_id"], int(r["index_in_sequence"]), None)
            for r in _rows(folder / "groups.csv")
        ]
    elif (folder / "poses.csv").is_file():
        rows = [
            (r["frame"], folder.name, i, (float(r["x"]), float(r["y"]), float(r["z"]), float(r["yaw"])))
            for i, r in enumerate(_rows(folder / "poses.csv"))
        ]
    else:
        raise ModelError(f"{folder}: no training folder; allowed: one with images/ and groups.csv or poses.csv")
    found = []
    for image, sequence, index, pose in rows[:: rule.step]:
        rgb = _read(folder / "images" / image, LONGER_SIDE)
        found.append(
            PlaceImage(
                image,
                folder.name,
                f"{folder.name}/{sequence}",
                _family(folder.name, sequence, rule),
                index,
                rgb,
                False,
                pose,
            )
        )
    for path in sorted((folder / "panos").glob("*.jpg")):
        sequence = path.stem.replace("_", "-") if folder.name == "polyhaven_hdri" else path.stem
        found.append(
            PlaceImage(
                path.name,
                folder.name,
                f"{folder.name}/{sequence}",
                _family(folder.name, sequence, rule),
                0,
                _read(path, PANORAMA_WIDTH),
                panorama=True,
            )
        )
    return found


def relation(a: PlaceImage, b: PlaceImage) -> int:
    """1 = one place, -1 = two places, 0 = not known."""
    if a is b:
        return 1
    if a.family != b.family:
        return -1
    if a.sequence != b.sequence or a.panorama or b.panorama:
        return 0
    rule = RULES.get(a.set_name, DEFAULT_RULE)
    gap = abs(a.index - b.index)
    if a.pose is not None and b.pose is not None and a.set_name.startswith("icl"):
        metres = float(np.linalg.norm(np.subtract(a.pose[:3], b.pose[:3])))
        degrees = abs(np.rad2deg(np.angle(np.exp(1j * (a.pose[3] - b.pose[3])))))
        if metres <= POSE_SAME_M and degrees <= POSE_SAME_DEG:
            return 1
        return -1 if metres > POSE_OTHER_M or degrees > POSE_OTHER_DEG else 0
    if gap <= rule.same:
        return 1
    return -1 if rule.other >= 0 and gap > rule.other else 0


def _family(set_name: str, sequence: str, rule: SetRule) -> str:
    match = re.match(rule.alias, sequence) if rule.alias else None
    return f"{set_name}/{match.group(1) if match else sequence}"


def _rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def _read(path: Path, longer_side: int) -> NDArray[np.uint8]:
    image = read_image(path)
    scale = longer_side / max(image.shape[:2])
    if scale >= 1:
        return image
    return cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA).astype(np.uint8, copy=False)
