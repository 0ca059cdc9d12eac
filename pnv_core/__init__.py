"""Patch-NetVLAD place recognition: images in, loop closures out. No ROS in here.

What a program needs is named here and loaded when it is first asked for.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

import pnv_core.openmp  # noqa: F401 - before torch is loaded
from pnv_core.config import Config
from pnv_core.errors import PnvError

if TYPE_CHECKING:
    from pnv_core.database import KeyframeDatabase
    from pnv_core.describe.describer import Describer, load_describer
    from pnv_core.maps import MapStore
    from pnv_core.pose.relative_poses import RelativePoses
    from pnv_core.recognizer import PlaceRecognizer
    from pnv_core.types import Evidence, Frame, ImageRef, LoopClosure, PatchGrid, PlaceDescriptor, Reason

_LATER = {
    "Describer": "pnv_core.describe.describer",
    "KeyframeDatabase": "pnv_core.database",
    "MapStore": "pnv_core.maps",
    "PlaceRecognizer": "pnv_core.recognizer",
    "RelativePoses": "pnv_core.pose.relative_poses",
    "load_describer": "pnv_core.describe.describer",
} | dict.fromkeys(
    ("Evidence", "Frame", "ImageRef", "LoopClosure", "PatchGrid", "PlaceDescriptor", "Reason"), "pnv_core.types"
)

__all__ = [
    "Config",
    "Describer",
    "Evidence",
    "Frame",
    "ImageRef",
    "KeyframeDatabase",
    "LoopClosure",
    "MapStore",
    "PatchGrid",
    "PlaceDescriptor",
    "PlaceRecognizer",
    "PnvError",
    "Reason",
    "RelativePoses",
    "load_describer",
]


def __getattr__(name: str) -> Any:
    """Names whose modules take long to import, and the version of what is installed."""
    if name == "__version__":
        from importlib.metadata import version

        return version("pnv_ros")
    if name in _LATER:
        return getattr(import_module(_LATER[name]), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
