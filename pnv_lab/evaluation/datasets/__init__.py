"""Data sets by their published folder layouts and ground-truth rules. Each module says where to get its own."""

from pathlib import Path

from pnv_core.errors import ConfigError, PnvError
from pnv_lab.evaluation.datasets.dataset import Dataset
from pnv_lab.evaluation.datasets.folder import folder
from pnv_lab.evaluation.datasets.msls import msls
from pnv_lab.evaluation.datasets.nordland import nordland
from pnv_lab.evaluation.datasets.places import pitts30k, tokyo247, utm_folder
from pnv_lab.evaluation.datasets.seasons import cmu_seasons, robotcar_seasons
from pnv_lab.evaluation.datasets.sequences import SequenceRule, euroc, kitti, tum

__all__ = ["KINDS", "Dataset", "SequenceRule", "open_dataset"]

KINDS = ("folder", "nordland", "pitts30k", "tokyo247", "utm", "msls", "robotcar", "cmu", "tum", "kitti", "euroc")


def open_dataset(kind: str, root: Path, split: str = "", rule: SequenceRule | None = None) -> Dataset:
    """A data set by kind and folder. Raises PnvError for anything missing or malformed in it."""
    rule = rule or SequenceRule()
    if not root.is_dir():
        raise PnvError(f"{root}: no such folder")
    if kind in ("folder", "tum", "euroc") and split:
        raise ConfigError(f"--split {split!r}: {kind} knows none")
    match kind:
        case "folder":
            return folder(root, rule)
        case "nordland":
            return nordland(root, split)
        case "pitts30k":
            return pitts30k(root, split)
        case "tokyo247":
            return tokyo247(root, split)
        case "utm":
            return utm_folder(root, split)
        case "msls":
            return msls(root, split)
        case "robotcar":
            return robotcar_seasons(root, split)
        case "cmu":
            return cmu_seasons(root, split)
        case "tum":
            return tum(root, rule)
        case "kitti":
            return kitti(root, rule, split)
        case "euroc":
            return euroc(root, rule)
        case _:
            raise ConfigError(f"--dataset {kind!r} is not one of {', '.join(KINDS)}, bag")
