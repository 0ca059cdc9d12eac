"""Saved maps: keyframes on disk, whole or refused."""

from pnv_core.maps.autosave import Autosave
from pnv_core.maps.store import MapStore, SaveReport

__all__ = ["Autosave", "MapStore", "SaveReport"]
