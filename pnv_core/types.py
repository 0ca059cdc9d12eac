"""The values that travel between the parts. All are frozen; every array is numpy.

D = descriptor dimension, rows x cols = patch grid of one patch size.
"""

from dataclasses import dataclass, field
from enum import StrEnum
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from pnv_core.errors import PnvError


@dataclass(frozen=True, eq=False)
class Frame:
    """One camera image. `stamp_ns` is the image's own stamp (never the wall clock), `rgb` is (H, W, 3) uint8.

    `depth` (H, W) is in metres along the optical axis, aligned to the image; 0 or NaN where unknown.

    Raises PnvError for a stamp that is no whole number of nanoseconds: seconds in a float would all be one moment.
    """

    stamp_ns: int
    camera: str
    rgb: NDArray[np.uint8]
    valid: NDArray[np.bool_] | None = None  # (H, W), False where the robot sees itself; None = all valid
    depth: NDArray[np.float32] | None = None

    def __post_init__(self) -> None:
        whole = isinstance(self.stamp_ns, int | np.integer) and not isinstance(self.stamp_ns, bool)
        if not whole or not -(2**63) <= self.stamp_ns < 2**63:
            raise PnvError(f"stamp_ns = {self.stamp_ns!r}; allowed: a whole number of nanoseconds in 64 bits")
        object.__setattr__(self, "stamp_ns", int(self.stamp_ns))  # numpy's integers go into no JSON


@dataclass(frozen=True, eq=False)
class PatchGrid:
    """The patch descriptors of one patch size: (rows * cols, D) unit rows, row-major over the grid.

    `size` and `stride` count feature cells of `cell` pixels. Patch (row, col) is centred at pixel
    (cell * stride * col + cell * size / 2 - 1, the same for row) of the resized image.
    """

    size: int
    rows: int
    cols: int
    descriptors: NDArray[np.float32]
    stride: int = 1
    cell: int = 16

    def keypoints(self) -> NDArray[np.int64]:
        """(rows * cols, 2) pixel centres (x, y) in the resized image, truncated to whole pixels. Read-only."""
        return _keypoints(self.size, self.rows, self.cols, self.stride, self.cell)

    def indices(self) -> NDArray[np.int64]:
        """(rows * cols, 2) grid coordinates (col, row). Read-only."""
        return _indices(self.rows, self.cols)


@lru_cache(maxsize=64)  # asked for at every match of every candidate; a program knows few grids
def _indices(rows: int, cols: int) -> NDArray[np.int64]:
    row, col = np.divmod(np.arange(rows * cols), cols)
    indices = np.stack([col, row], axis=1)
    indices.flags.writeable = False
    return indices


@lru_cache(maxsize=64)
def _keypoints(size: int, rows: int, cols: int, stride: int, cell: int) -> NDArray[np.int64]:
    keypoints = cell * stride * _indices(rows, cols) + (cell * size // 2 - 1)
    keypoints.flags.writeable = False
    return keypoints


@dataclass(frozen=True, eq=False)
class PlaceDescriptor:
    """What is remembered of an image: a unit global vector (D,) float32 and one PatchGrid per patch size.

    `texture` in [0, 1] is the share of the image that is not blank; it gates meaningless matches.
    `thumbnail` is what the verifier keeps of the image, with a small grey JPEG at its end; empty where none is kept.
    """

    global_vector: NDArray[np.float32]
    patches: tuple[PatchGrid, ...]
    texture: float = 1.0
    thumbnail: bytes = b""
    geometry: bytes = b""  # what a driver that knows the camera keeps for poses


@dataclass(frozen=True)
class ImageRef:
    """Which image: keyframe id (monotone, never reused; -1 for a query that is no keyframe), stamp, camera, session.

    `robot` names another robot, or this one towards others; empty within one robot's own map.
    """

    id: int
    stamp_ns: int
    camera: str
    session: int = 0
    robot: str = ""


@dataclass(frozen=True, eq=False)
class Query:
    """What a keyframe is looked up with, here or by others: which it is and its descriptor.

    `predecessor` is the cosine to the keyframe before it, 1 where there is none.
    """

    ref: ImageRef
    descriptor: PlaceDescriptor
    predecessor: float


@dataclass(frozen=True, eq=False)
class PatchMatches:
    """Mutual nearest neighbours of one patch size: (M,) patch numbers in query and reference, and RANSAC's verdict."""

    size: int
    query: NDArray[np.int64]
    reference: NDArray[np.int64]
    inlier: NDArray[np.bool_]  # (M,), all False where RANSAC was not run
    query_xy: NDArray[np.int64]  # (M, 2) patch centres in pixels of the resized images
    reference_xy: NDArray[np.int64]


class Reason(StrEnum):
    """Why a candidate was refused. The order is the wire code of ~/candidates: append only."""

    ACCEPTED = ""
    LOW_SCORE = "low_score"
    LOW_TEXTURE = "low_texture"
    UNCONFIRMED = "unconfirmed"
    ODOMETRY = "odometry"
    NOT_RERANKED = "not_reranked"
    NOT_VERIFIED = "not_verified"
    AMBIGUOUS = "ambiguous"


NO_PICTURE = -2  # local_inliers of a keyframe of which no picture was kept (`verify: 0`)


@dataclass(frozen=True)
class Evidence:
    """What is known of a candidate before the decision.

    Leads are differences, positive where the candidate stands out; "elsewhere" is every candidate that is no neighbour
    of this one. Spreads are areas of convex hulls of inliers as a share of the image, the smaller of both images.
    """

    similarity: float  # cosine of the global vectors
    spatial: float  # fused spatial score in [0, 1]
    inliers: int  # RANSAC inliers over all patch sizes (mutual matches for the rapid scorer)
    spread: float = 0.0  # of the patch inliers, in [0, 1]
    distortion: float = 0.0  # Frobenius distance of the affine map between the patch inliers from the identity
    lead: float = 0.0  # of similarity over the best candidate elsewhere
    recent_lead: float = 0.0  # of similarity over that of the query's predecessor to the query
    spatial_lead: float = 0.0  # of the spatial score over the best candidate elsewhere
    texture: float = 1.0  # the lesser of both images, in [0, 1]
    local_inliers: int = -1  # local features on one epipolar geometry; -1: not examined, -2: no picture to examine
    local_spread: float = 0.0  # of those
    local_matches: int = 0  # mutual nearest neighbours among the local features, whether they agree or not
    own_matches: int = 0  # of those: nearer than to any feature of the examined candidates elsewhere
    likeness: float = 0.0  # of all: log of the distance between features of one image over that of matched ones
    rival_inliers: int = 0  # local features of the best examined candidate elsewhere
    near_inliers: int = 0  # of the best examined one near the match in its sequence, itself included
    match_confidence: float = -1.0  # sum of the probabilities of LighterGlue's matches; -1: it was not asked
    magnification: float = 1.0  # between the points of those in both images, at least 1
    background: float = 0.0  # similarity of the fifth most similar keyframe elsewhere; of a young map, the middle one


@dataclass(frozen=True)
class LoopClosure:
    """A candidate examined for a query: accepted, or refused with a reason.

    score: P(same place) in [0, 1] after calibration; similarity: cosine of the global vectors;
    spatial: fused spatial score in [0, 1]; inliers: RANSAC inliers over all patch sizes (matches for the rapid scorer).
    """

    query: ImageRef
    match: ImageRef
    score: float
    similarity: float
    spatial: float
    inliers: int
    accepted: bool
    reason: Reason = Reason.ACCEPTED
    matches: tuple[PatchMatches, ...] = field(default=(), compare=False, repr=False)
    evidence: Evidence | None = field(default=None, compare=False, repr=False)
