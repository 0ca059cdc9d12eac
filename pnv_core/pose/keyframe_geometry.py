"""What a keyframe keeps for poses: its camera, where it stood, and the depth at its points. N points.

    "PNVG", version u8, flags u8, fx fy cx cy f32, stereo baseline f32, pose x y z f64 and qx qy qz qw f64, N u16,
    points (N, 2) u16 in 1/16384 of the image's width, depths (N,) f16 in metres

Little-endian; 6 bytes a point. It stands behind what the verifier keeps, and says nothing where it is damaged.
"""

import struct
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from pnv_core.errors import ConfigError
from pnv_core.pose.geometry import Intrinsics
from pnv_core.rotations import matrix_of, quaternion_of, rigid

Array = NDArray[np.float64]

_HEAD = struct.Struct("<4sBB4ff7dH")
_MAGIC, _VERSION = b"PNVG", 1
_CAMERA, _POSE, _SHARED = 1, 2, 4  # flags
_MOST, _GRID = 4000, 16384
_SAME = 1.5 / _GRID + 0.5 / 640  # a point this close is the same one: half a pixel of what features are sought in


@dataclass(frozen=True, eq=False)
class KeyframeGeometry:
    """`camera` of the image; `pose` (4, 4) of its optical frame where a driver knew it; `shared` whether that is in one
    frame for all sessions, as a SLAM's map, and not in the odometry's own.

    `baseline_m` is how far right of a stereo pair's left camera this one stands. `points` (N, 2) in image widths and
    their `depth` (N,) in metres.
    """

    camera: Intrinsics | None = None
    pose: Array | None = None
    shared: bool = False
    baseline_m: float = 0.0
    points: NDArray[np.float32] = field(default_factory=lambda: np.empty((0, 2), np.float32))
    depth: NDArray[np.float32] = field(default_factory=lambda: np.empty(0, np.float32))

    def depth_near(self, points: NDArray) -> Array:
        """(M,) the depths stored at (M, 2) points; NaN where none is stored."""
        found = np.full(len(points), np.nan)
        if len(self.points) and len(points):
            apart = np.abs(np.asarray(points, np.float32)[:, None] - self.points[None]).max(2)
            nearest = apart.argmin(1)
            close = apart[np.arange(len(points)), nearest] <= _SAME
            found[close] = self.depth[nearest[close]]
        return found

    def encode(self) -> bytes:
        """Empty where nothing is known."""
        if self.camera is None and self.pose is None:
            return b""
        flags = _CAMERA * (self.camera is not None) + _POSE * (self.pose is not None) + _SHARED * self.shared
        c, pose = self.camera or Intrinsics(0, 0, 0, 0), np.eye(4) if self.pose is None else self.pose
        points = np.rint(np.clip(self.points[:_MOST], 0, 3.999) * _GRID).astype("<u2")
        numbers = (c.fx, c.fy, c.cx, c.cy, self.baseline_m, *pose[:3, 3], *quaternion_of(pose[:3, :3]), len(points))
        head = _HEAD.pack(_MAGIC, _VERSION, flags, *numbers)
        return head + points.tobytes() + self.depth[:_MOST].astype("<f2").tobytes()

    @classmethod
    def decode(cls, kept: bytes) -> "KeyframeGeometry":
        """What `encode` wrote; of anything else nothing is known."""
        if len(kept) < _HEAD.size or not kept.startswith(_MAGIC):
            return cls()
        _, version, flags, fx, fy, cx, cy, baseline, *pose, count = _HEAD.unpack_from(kept)
        usable = np.isfinite([fx, fy, cx, cy, baseline, *pose]).all()
        if version != _VERSION or not usable or len(kept) != _HEAD.size + 6 * count:
            return cls()
        places = np.frombuffer(kept, "<u2", 2 * count, _HEAD.size).reshape(count, 2)
        points = places.astype(np.float32) / np.float32(_GRID)
        depth = np.frombuffer(kept, "<f2", count, _HEAD.size + 4 * count).astype(np.float32)
        try:
            camera = Intrinsics.of_widths(fx, fy, cx, cy) if flags & _CAMERA else None
        except ConfigError:
            return cls()
        turned = matrix_of(pose[3:])
        known = flags & _POSE and np.isfinite(turned).all()
        where = rigid(turned, pose[:3]) if known else None
        return cls(camera, where, bool(flags & _SHARED), baseline, points, depth)
