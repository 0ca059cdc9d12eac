"""Patch-NetVLAD place recognition: images in, loop closures out. No ROS in here."""

import pnv_core.openmp  # noqa: F401 - before torch is loaded
from pnv_core.config import Config
from pnv_core.describer import Describer, load_describer
from pnv_core.types import Frame, LoopClosure, PatchGrid, PlaceDescriptor

__all__ = ["Config", "Describer", "Frame", "LoopClosure", "PatchGrid", "PlaceDescriptor", "load_describer"]
