"""Rendered places with known poses: a small seeded generator for tests, the demo and training."""

from pnv_lab.worlds.light import Light
from pnv_lab.worlds.rendering import CAMERA_IN_BODY, Camera, Pose
from pnv_lab.worlds.scenes import KINDS
from pnv_lab.worlds.sequences import Sequence, World, contact_sheet, loop_sequence

__all__ = ["CAMERA_IN_BODY", "KINDS", "Camera", "Light", "Pose", "Sequence", "World", "contact_sheet", "loop_sequence"]
