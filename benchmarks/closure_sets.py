"""Sequences of known truth, to fit and to judge closures on. Indices count the images of a sequence in order.

Those that may train a shipped model: icl, ikuta, the walks, the tower, the panoramas and the rendered worlds.
"""

import csv
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pnv_core.images import read_image
from pnv_core.types import Frame
from pnv_lab.worlds.sequences import loop_sequence

FIT = ("icl", "ikuta", "walks", "world_corridor", "tower")
JUDGE = (
    "donkey", "pepper", "kitti03", "multifloor", "tower", "tower_height", "viewpoint", "gardens", "essex", "webcams",
    "panoramas",
)  # fmt: skip
NARROW = ("donkey", "pepper", "gardens", "viewpoint")  # ground truth that knows fewer true pairs than there are
TRUE, FALSE, IGNORE = 1, 0, -1

Truth = Callable[[int, int], int]


@dataclass(frozen=True, eq=False)
class TruthSequence:
    """Images with stamps in seconds. `truth(query, match)` says whether two of them show one place.

    `starts` are the numbers where another session begins, `queries` those that count, `one_way` how many images come
    before the first revisit (all of them where there is none).
    """

    name: str
    keys: list[str]
    stamps: NDArray[np.float64]
    truth: Truth
    exclude_recent_s: float
    read: Callable[[int], NDArray[np.uint8]]
    starts: tuple[int, ...] = ()
    queries: NDArray[np.bool_] | None = None
    min_interval_s: float = 0.5
    positions: NDArray[np.float64] | None = None  # (N, 3) m, of an odometry

    def __len__(self) -> int:
        return len(self.keys)

    def frames(self) -> Iterator[Frame]:
        for i, stamp in enumerate(self.stamps):
            yield Frame(round(stamp * 1e9), "camera", self.read(i))


def sequence(name: str, shared: Path) -> TruthSequence:
    """One of FIT or JUDGE by name."""
    if name.startswith("world_"):
        return _world(name)
    return _LOADERS[name](shared)


def _rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def _of_files(name: str, files: list[Path], *arguments, **more) -> TruthSequence:
    return TruthSequence(name, [str(f) for f in files], *arguments, read=lambda i: read_image(files[i]), **more)


def _posed(
    name: str, folder: Path, spacing: float, near: float, far: float, turn: float, exclude: float
) -> TruthSequence:
    rows = _rows(folder / "poses.csv")
    files = [folder / "images" / r["frame"] for r in rows]
    xyz = np.array([[float(r[k]) for k in "xyz"] for r in rows])
    yaw = np.array([float(r["yaw"]) for r in rows])
    stamps = np.array([float(r["timestamp"]) for r in rows]) * spacing
    distance = np.linalg.norm(xyz[:, None] - xyz[None], axis=2)
    turned = np.abs((yaw[:, None] - yaw[None] + np.pi) % (2 * np.pi) - np.pi)
    table = np.where(
        (distance <= near) & (turned <= turn), TRUE, np.where((distance <= far) & (turned <= 2 * turn), IGNORE, FALSE)
    )
    return _of_files(name, files, stamps, lambda q, c: int(table[q, c]), exclude)


def _icl(shared: Path) -> TruthSequence:
    return _posed("icl", shared / "data/icl_office_kt3_synth", 1.0, 0.75, 3.0, 0.52, 10.0)


def _ikuta(shared: Path) -> TruthSequence:
    return _posed("ikuta", shared / "data/ikuta_campus_loop", 3.0, 10.0, 20.0, 0.6, 30.0)


def _kitti03(shared: Path) -> TruthSequence:
    # nothing is near: no place of this drive is seen twice
    return _posed("kitti03", shared / "data/kitti03_noloop", 1.0, -1.0, 20.0, 0.5, 15.0)


def _donkey(shared: Path) -> TruthSequence:
    folder = shared / "data/donkey_desks_laps"
    rows = _rows(folder / "frames.csv")
    stamps = np.array([float(r["timestamp"]) for r in rows])
    uncertain = np.array([r["status"] == "uncertain" for r in rows])
    number = {r["frame"]: i for i, r in enumerate(rows)}
    true = {
        number[r["query"]]: np.array([number[f] for f in r["true_refs"].split(";")])
        for r in _rows(folder / "matches.csv")
    }

    def truth(q: int, c: int) -> int:
        if uncertain[q] or uncertain[c]:
            return IGNORE
        if q in true and c in true[q]:
            return TRUE
        # soft to a second, says its README
        near = [n for n in np.flatnonzero(np.abs(stamps - stamps[q]) <= 1.0) if n in true]
        soft = any(np.abs(stamps[true[n]] - stamps[c]).min() <= (1.0 if n == q else 0.0) for n in near)
        return IGNORE if soft else FALSE

    files = [folder / "images" / r["frame"] for r in rows]
    queries = np.isin(np.arange(len(rows)), list(true))
    return _of_files("donkey", files, stamps, truth, 10.0, queries=queries)


def _pepper(shared: Path) -> TruthSequence:
    folder = shared / "data/pepper_s11"
    references, queries = sorted((folder / "ref").iterdir()), sorted((folder / "query").iterdir())
    files = references + queries
    number = {f"{f.parent.name}/{f.name}": i for i, f in enumerate(files)}
    true = {
        number[r["query"]]: np.array([number[f] for f in r["true_refs"].split(";")])
        for r in _rows(folder / "matches.csv")
    }

    def truth(q: int, c: int) -> int:
        if q not in true:
            return IGNORE  # not to be scored, says its README
        if c in true[q]:
            return TRUE
        return IGNORE if np.abs(true[q] - c).min() <= 5 else FALSE  # five key-frames: about half a metre

    counted = np.isin(np.arange(len(files)), list(true))
    return _of_files(
        "pepper", files, np.arange(len(files)) * 1.0, truth, 1e5, starts=(len(references),), queries=counted
    )


def _multifloor(shared: Path) -> TruthSequence:
    folder = shared / "data/multifloor_corridor_noloop"
    floors = [sorted((folder / f).iterdir()) for f in ("floor1", "floor2")]
    first = len(floors[0])

    def truth(q: int, c: int) -> int:
        return FALSE if (q < first) != (c < first) else IGNORE  # far views of one corridor overlap

    files = floors[0] + floors[1]
    return _of_files("multifloor", files, np.arange(len(files)) * 0.5, truth, 15.0)


def _paired(name: str, folder: Path, parts: tuple[str, str], same: Callable[[str, str], int]) -> TruthSequence:
    references, queries = sorted((folder / parts[0]).iterdir()), sorted((folder / parts[1]).iterdir())
    files, first = references + queries, len(references)

    def truth(q: int, c: int) -> int:
        return same(files[q].stem, files[c].stem) if c < first <= q else IGNORE

    counted = np.arange(len(files)) >= first
    return _of_files(name, files, np.arange(len(files)) * 1.0, truth, 1e5, starts=(first,), queries=counted)


def _gardens(shared: Path) -> TruthSequence:
    def same(q: str, r: str) -> int:
        apart = abs(int(q) - int(r))
        return TRUE if apart == 0 else IGNORE if apart <= 3 else FALSE  # neighbours may be valid, says its README

    return _paired("gardens", shared / "data/gardens_point_thumbs", ("ref", "query"), same)


def _essex(shared: Path) -> TruthSequence:
    return _paired("essex", shared / "data/essex3in1_thumbs", ("ref", "query"), lambda q, r: int(int(q) == int(r)))


def _viewpoint(shared: Path) -> TruthSequence:
    folder = shared / "data/viewpoint_places"
    true = {Path(r["query"]).stem: {Path(ref).stem for ref in r["true_refs"].split(";")}
            for r in _rows(folder / "matches.csv")}  # fmt: skip
    return _paired("viewpoint", folder, ("ref", "query"), lambda q, r: int(r in true.get(q, ())))


def _webcams(shared: Path) -> TruthSequence:
    def same(q: str, r: str) -> int:
        return int(q.split("_")[0] == r.split("_")[0])

    return _paired("webcams", shared / "data/webcams_daynight", ("ref_day", "query_night"), same)


def _grouped(folder: Path) -> tuple[list[Path], list[str], list[int], list[str]]:
    rows = _rows(folder / "groups.csv")
    files = [folder / "images" / r["image"] for r in rows]
    return (
        files,
        [r["place_or_sequence_id"] for r in rows],
        [int(r["index_in_sequence"]) for r in rows],
        [r["note"] for r in rows],
    )


def _walks(shared: Path) -> TruthSequence:
    """Several walks, one after the other: what a few images apart shows one place, what is of another walk does not.

    Within a walk the rest is unknown. Every third image is taken, so that neighbours differ.
    """
    files, walk, near = [], [], []
    for name in ("rc_patio_laps", "rtabmap_corridor", "tum_rgbd_fr1", "udacity_highway", "opensfm_lund_berlin"):
        found, groups, _, _ = _grouped(shared / "train" / name)
        found, groups = found[::3], groups[::3]
        files += found
        walk += [name if name.startswith("tum") else f"{name}/{g}" for g in groups]  # the tum ones share an office
        near += [{"rc_patio_laps": 3, "tum_rgbd_fr1": 2}.get(name, 1)] * len(found)

    def truth(q: int, c: int) -> int:
        if walk[q] != walk[c]:
            return FALSE
        return TRUE if abs(q - c) <= near[q] else IGNORE

    return _of_files("walks", files, np.arange(len(files)) * 1.0, truth, 1.5)


def _tower(shared: Path) -> TruthSequence:
    """Clips of a tower whose floors look alike: other floors are other places."""
    files, clip, index, _ = _grouped(shared / "train/ie_tower")
    half = [i for i in range(len(files)) if int(clip[i].rsplit("-v", 1)[1]) % 4 == 0]
    files, clip, index = ([values[i] for i in half] for values in (files, clip, index))
    floor = [c.split("-v")[0] for c in clip]

    def truth(q: int, c: int) -> int:
        if floor[q] != floor[c]:
            return FALSE
        return TRUE if clip[q] == clip[c] and abs(index[q] - index[c]) <= 6 else IGNORE

    return _of_files("tower", files, np.arange(len(files)) * 1.0, truth, 1.5)


def _tower_height(shared: Path) -> TruthSequence:
    """The tower with the odometry of a drone: a metre an image, 3.5 m a floor, height that drifts by 1 % of the way.

    The set has no positions; all floors begin at one spot, so that height alone tells them apart.
    """
    tower = _tower(shared)
    names = [Path(key).stem for key in tower.keys]
    floors = [name.split("-v")[0] for name in names]
    levels = [-1 - int(f[8:]) if f.startswith("basement") else int(f[5:]) for f in floors]
    along = np.array([float(name.rsplit("_", 1)[1]) for name in names])
    xyz = np.stack([along, np.zeros(len(names)), 3.5 * np.array(levels)], 1)
    way = np.concatenate([[0.0], np.linalg.norm(np.diff(xyz, axis=0), axis=1).cumsum()])
    xyz[:, 2] -= 0.01 * way
    return replace(tower, name="tower_height", positions=xyz)


def _panoramas(shared: Path) -> TruthSequence:
    """Views of panoramas: references at one exposure, queries at another yaw, field of view and exposure."""
    files, place, _, notes = _grouped(shared / "train/polyhaven_hdri")
    views = [dict(part.split("=") for part in note.split()) for note in notes]
    use = [i for i, view in enumerate(views) if "yaw" in view]  # the others are near-duplicates at one spot
    files, place, views = ([values[i] for i in use] for values in (files, place, views))
    exposed = np.array([float(v["ev"]) for v in views])
    order = np.concatenate([np.flatnonzero(exposed == 0), np.flatnonzero(exposed != 0)])
    first = int((exposed == 0).sum())
    files, place, views = ([values[i] for i in order] for values in (files, place, views))
    yaw, width = (np.array([float(v[k]) for v in views]) for k in ("yaw", "fov"))

    def truth(q: int, c: int) -> int:
        if place[q] != place[c]:
            return FALSE
        apart = abs((yaw[q] - yaw[c] + 180) % 360 - 180)
        return TRUE if apart <= 0.35 * min(width[q], width[c]) else IGNORE

    return _of_files("panoramas", files, np.arange(len(files)) * 1.0, truth, 1e5, starts=(first,))


def _world(name: str) -> TruthSequence:
    """Two laps of a rendered place, the second in another light."""
    walk = loop_sequence(7, name.removeprefix("world_"), laps=1.4, fps=0.8, light_change=0.6)
    near, far = walk.places(2.0, 30.0), walk.places(6.0, 60.0)
    stamps = np.array(walk.stamps_ns) / 1e9 - walk.stamps_ns[0] / 1e9
    keys = [f"{name}/{i}" for i in range(len(walk))]

    def truth(q: int, c: int) -> int:
        return TRUE if near[q, c] else IGNORE if far[q, c] else FALSE

    return TruthSequence(name, keys, stamps, truth, 15.0, read=lambda i: walk[i].rgb)


_LOADERS: dict[str, Callable[[Path], TruthSequence]] = {
    "icl": _icl, "ikuta": _ikuta, "walks": _walks, "tower": _tower,
    "tower_height": _tower_height, "panoramas": _panoramas, "donkey": _donkey,
    "pepper": _pepper, "kitti03": _kitti03, "multifloor": _multifloor, "gardens": _gardens, "essex": _essex,
    "webcams": _webcams, "viewpoint": _viewpoint,
}  # fmt: skip
