"""What examines a candidate beside its patches. A new one is a file here and a line in
`VERIFIERS`, or `VERIFIERS.register` in a program."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from pnv_core.errors import ConfigError
from pnv_core.registry import Registry
from pnv_core.threads import Workers

RATIO = 0.9  # Lowe 2004, section 7.1; plain mutual neighbours agree in look-alike corridors by the hundred


@dataclass(frozen=True, eq=False)
class EpipolarCheck:
    """Matched points (M, 2) of two images in units of their widths, and which (M,) agree on one geometry.

    `spread` is the area of the inliers' convex hull as a share of the image, the smaller of both. `likeness` is the log
    of how far apart the most similar features of one image are over how far apart matched features are: high where
    matches are sure, low where the images repeat themselves. `distinct` (M,) are the matches that look like each other
    alone; None where all do. `numbers` (M,) are the matched features of the query, `nearest` (N,) is how similar each
    of its N features is to the nearest of the reference; None where that is not known.
    """

    query: NDArray[np.float32]
    reference: NDArray[np.float32]
    inlier: NDArray[np.bool_]
    spread: float
    likeness: float = 0.0
    distinct: NDArray[np.bool_] | None = None
    numbers: NDArray[np.int64] | None = None
    nearest: NDArray[np.float32] | None = None

    @property
    def inliers(self) -> int:
        return int(self.inlier.sum())

    def matches_beside(self, rivals: Sequence["EpipolarCheck"]) -> int:
        """How many features of the query are matched nearer, by Lowe's ratio, than any of the rivals has them.

        `rivals` are the same query against other places; of none, every match counts. Where `nearest` is not known, the
        inliers count.
        """
        others = [rival.nearest for rival in rivals if rival.nearest is not None]
        if self.numbers is None or self.nearest is None:
            return self.inliers
        if not others:
            return len(self.inlier)
        elsewhere = np.max([nearest[self.numbers] for nearest in others], axis=0)
        return int((1.0 - self.nearest[self.numbers] < RATIO**2 * (1.0 - elsewhere)).sum())

    def swapped(self) -> "EpipolarCheck":
        """The same with query and reference exchanged."""
        return replace(self, query=self.reference, reference=self.query, numbers=None, nearest=None)


@dataclass(frozen=True)
class CloserLook:
    """What a matcher that knows all features of both images finds: the sum of its matches' probabilities, and how much
    larger the matched points lie in one image than in the other, at least 1.
    """

    confidence: float
    magnification: float = 1.0


class Verifier(Protocol):
    """Compares two images by what it kept of each, as bytes that go into the map. Made from the completed Config."""

    side: int  # pixels it looks at along the longer side of an image; more tell it nothing

    def keep(self, rgb: NDArray[np.uint8], camera: str, valid: NDArray[np.bool_] | None = None) -> bytes:
        """(H, W, 3) uint8, optionally (H, W) bool of the pixels to use -> what is kept of the image.

        Another thread may be comparing other images meanwhile.
        """
        ...

    def prepare(self, kept: Iterable[tuple[bytes, str]], workers: Workers) -> None:
        """Called before `check` with everything (kept, camera) that is about to be compared."""
        ...

    def check(self, query: bytes, query_camera: str, reference: bytes, reference_camera: str) -> EpipolarCheck:
        """Two images by what was kept of them. Damaged bytes agree on nothing."""
        ...

    def look_closer(self, query: bytes, reference: bytes) -> CloserLook:
        """As `check`, slower and more thorough; asked about few candidates, where the calibration has a part for it.

        Only the shipped model's has one, for xfeat: another verifier does without this method.
        """
        ...


VERIFIERS: Registry[Verifier] = Registry(
    "verifier", {"xfeat": "pnv_core.verify.local_features:XFeatVerifier"}, ConfigError
)


def hull_area(points: NDArray) -> float:
    """Area of the convex hull of (N, 2) points, in their unit squared; 0 for fewer than three."""
    if len(points) < 3:
        return 0.0
    return float(cv2.contourArea(cv2.convexHull(np.ascontiguousarray(points, np.float32))))
