"""Data sets by their published folder layouts and ground-truth rules."""

from pnv_core.evaluation.datasets.dataset import Dataset

__all__ = ["Dataset"]
