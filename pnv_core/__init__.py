"""Patch-NetVLAD place recognition: images in, loop closures out. No ROS in here."""

from typing import TYPE_CHECKING, Any

import pnv_core.openmp  # noqa: F401 - before torch is loaded
from pnv_core.config import Config
from pnv_core.types import Frame, LoopClosure, PatchGrid, PlaceDescriptor

if TYPE_CHECKING:
    from pnv_core.describe.describer import Describer, load_describer

__all__ = ["Config", "Describer", "Frame", "LoopClosure", "PatchGrid", "PlaceDescriptor", "load_describer"]


def __getattr__(name: str) -> Any:
    """The describer needs torch, which takes seconds to import: only who asks for it waits."""
    if name in ("Describer", "load_describer"):
        from pnv_core.describe import describer

        return getattr(describer, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
