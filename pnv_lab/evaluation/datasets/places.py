"""Pittsburgh 30k, Tokyo 24/7, and folders that carry the position in the file name.

Where: https://www.di.ens.fr/willow/research/netvlad/ (the lists, datasets/*.mat) and the authors' download forms;
https://github.com/gmberton/VPR-datasets-downloader writes the @UTM names.
Layout: ROOT/pitts30k_test.mat or ROOT/datasets/pitts30k_test.mat with the images as it names them under ROOT and
ROOT/queries_real; ROOT/tokyo247.mat with 247query_subset_v2 and database_gsv_vga (or the cut-outs under ROOT). Or
ROOT/images/test/database and queries with names @easting@northing@...
Rule: a reference at most 25 m away (Arandjelovic et al., CVPR 2016, section 5.1). The cut-outs of a Tokyo panorama
count as one answer, as in the NetVLAD code.
"""

from pathlib import Path

import numpy as np
from scipy.io import loadmat

from pnv_core.errors import PnvError
from pnv_lab.evaluation.datasets.dataset import Dataset
from pnv_lab.evaluation.datasets.pairs import images_under
from pnv_lab.evaluation.datasets.pose_truth import within_radius
from pnv_lab.evaluation.datasets.tables import existing

RADIUS_M = 25.0
_CUT_OUTS = 12  # of a Tokyo panorama, consecutive in the list


def pitts30k(root: Path, split: str = "") -> Dataset:
    """`split` is test (the paper's), val or train."""
    chosen = _split(split)
    return _from_list_or_names(root, "pitts30k", f"pitts30k_{chosen}.mat", chosen, ("queries_real", "queries", "."))


def tokyo247(root: Path, split: str = "") -> Dataset:
    """Queries by day, at sunset and at night against street-view cut-outs."""
    if split not in ("", "test"):
        raise PnvError(f"--split {split!r}; allowed for tokyo247: test")
    return _from_list_or_names(root, "tokyo247", "tokyo247.mat", "test", ("247query_subset_v2", "queries", "."))


def utm_folder(root: Path, split: str = "") -> Dataset:
    """ROOT/images/SPLIT/database and queries, or ROOT/database and queries, with names @easting@northing@..."""
    base = root / "images" / _split(split)
    base = base if base.is_dir() else root
    references, queries = images_under(base / "database"), images_under(base / "queries")
    positions = [np.array([_utm(p) for p in files]) for files in (queries, references)]
    truth = within_radius(positions[0], positions[1], RADIUS_M)
    return Dataset(root.name, tuple(queries), tuple(references), truth, f"at most {RADIUS_M:g} m away")


def _split(split: str) -> str:
    if split not in ("", "test", "val", "train"):
        raise PnvError(f"--split {split!r}; allowed: test, val, train")
    return split or "test"


def _from_list_or_names(root: Path, name: str, list_name: str, split: str, query_folders: tuple[str, ...]) -> Dataset:
    found = next((p for p in (root / list_name, root / "datasets" / list_name) if p.is_file()), None)
    if found is None:
        if (root / "images" / split).is_dir():
            named = utm_folder(root, split)
            return Dataset(name, named.queries, named.references, named.truth, named.rule)
        raise PnvError(f"{root}: holds neither {list_name} nor images/{split}; see docs/evaluation.md for the layout")
    try:
        listed = loadmat(found, squeeze_me=True, struct_as_record=False)["dbStruct"]
        names = {part: [str(n) for n in np.atleast_1d(getattr(listed, part))] for part in ("dbImageFns", "qImageFns")}
        utm = {part: np.atleast_2d(np.asarray(getattr(listed, part), np.float64).T) for part in ("utmDb", "utmQ")}
    except (ValueError, KeyError, AttributeError, NotImplementedError, TypeError) as error:
        raise PnvError(f"{found}: is no list of the NetVLAD authors ({error})") from None
    references = existing(
        _base(root, names["dbImageFns"][0], ("database_gsv_vga", "database", ".")), names["dbImageFns"]
    )
    queries = existing(_base(root, names["qImageFns"][0], query_folders), names["qImageFns"])
    groups = np.arange(len(references)) // _CUT_OUTS if name == "tokyo247" else None
    truth = within_radius(utm["utmQ"], utm["utmDb"], RADIUS_M)
    return Dataset(name, queries, references, truth, f"at most {RADIUS_M:g} m away", groups=groups)


def _base(root: Path, name: str, folders: tuple[str, ...]) -> Path:
    """The folder of `folders` under root that holds the image, .jpg or .png."""
    for folder in folders:
        base = root / folder
        if any((base / name).with_suffix(s).is_file() for s in (".jpg", ".png")):
            return base
    raise PnvError(f"{root / folders[0] / name}: no such image, though the data set's list names it")


def _utm(path: Path) -> tuple[float, float]:
    try:
        east, north = path.name.split("@")[1:3]
        return float(east), float(north)
    except ValueError:
        raise PnvError(f"{path}: allowed names: @easting@northing@...@{path.suffix}") from None
