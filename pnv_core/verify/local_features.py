"""Local features of small grey pictures: a second opinion on a candidate, and points for its geometry.

N = features of an image, M = matches.
"""

import io
from collections import OrderedDict
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from pnv_core.threads import Workers
from pnv_core.verify.feature_codes import pack, packed, unpack
from pnv_core.verify.verifier import EpipolarCheck, hull_area

WIDTH = 320  # pixels; at this width a thumbnail takes about a tenth of a keyframe's patches
_TALLEST = 4 * WIDTH
_QUALITY = 85
_FEATURES = 500
_CONTRAST = 0.02  # half of SIFT's own threshold: thumbnails are soft
_RATIO = 0.8  # Lowe 2004, section 7.1
_TOLERANCE_PX = 1.5
_LEAST = 8  # points that determine a fundamental matrix
_CACHED = 64  # pictures whose features are kept, about 0.3 MB each


@dataclass(frozen=True, eq=False)
class LocalFeatures:
    """RootSIFT of one image: points (N, 2) in units of its width, from the top left; unit descriptors (N, 128)."""

    points: NDArray[np.float32]
    descriptors: NDArray[np.float32]


def thumbnail(rgb: NDArray[np.uint8]) -> bytes:
    """(H, W, 3) uint8 -> a grey JPEG of at most 320 pixels width and the same aspect, up to four times as high."""
    grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
    if grey.shape[1] > WIDTH or grey.shape[0] > _TALLEST:
        grey = cv2.resize(grey, (min(WIDTH, grey.shape[1]), _height(grey)), interpolation=cv2.INTER_AREA)
    return cv2.imencode(".jpg", grey, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1].tobytes()


def decoded(picture: bytes) -> NDArray[np.uint8]:
    """(h, w) grey of a thumbnail; one that is damaged, or larger than `thumbnail` makes them, shows nothing.

    It may come from a map that somebody else wrote, so its sides are read before it is unpacked.
    """
    try:
        with Image.open(io.BytesIO(picture), formats=("JPEG",)) as header:
            small = header.width <= WIDTH and header.height <= _TALLEST
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError):
        small = False
    grey: Any = cv2.imdecode(np.frombuffer(picture, np.uint8), cv2.IMREAD_GRAYSCALE) if small else None
    return np.zeros((WIDTH, WIDTH), np.uint8) if grey is None else grey


def _height(grey: NDArray[np.uint8]) -> int:
    """The height at a width of 320 pixels, bounded so that a sliver of an image does not become a gigapixel."""
    return min(_TALLEST, max(1, round(grey.shape[0] * WIDTH / grey.shape[1])))


def detect(picture: bytes, valid: NDArray[np.bool_] | None = None) -> LocalFeatures:
    """A thumbnail, optionally (H, W) bool of the image's pixels to use -> its features, at most 500.

    What `features_of` made of a thumbnail is as good as the thumbnail.
    """
    if packed(picture):
        return _unpacked(picture)
    grey = decoded(picture)
    if grey.shape[1] < WIDTH:  # a small image has details of few pixels; SIFT wants them larger
        grey = cv2.resize(grey, (WIDTH, _height(grey)), interpolation=cv2.INTER_LINEAR)
    mask = None
    if valid is not None:
        mask = cv2.resize(valid.astype(np.uint8) * 255, grey.shape[::-1], interpolation=cv2.INTER_NEAREST)
        mask = cv2.erode(mask, np.ones((9, 9), np.uint8))  # the border of the mask is no feature
    sift = getattr(cv2, "SIFT_create")(nfeatures=_FEATURES, contrastThreshold=_CONTRAST)  # noqa: B009 - no stub has it
    keypoints, descriptors = sift.detectAndCompute(grey, mask)
    if descriptors is None:
        return LocalFeatures(np.empty((0, 2), np.float32), np.empty((0, 128), np.float32))
    root = np.sqrt(descriptors / np.maximum(descriptors.sum(1, keepdims=True), 1e-6))
    points = np.array([k.pt for k in keypoints], np.float32) + 0.5
    return LocalFeatures((points / WIDTH).astype(np.float32), root.astype(np.float32))


def features_of(picture: bytes, valid: NDArray[np.bool_] | None = None) -> bytes:
    """The features of a thumbnail in place of the thumbnail: what is compared without what people can be seen on."""
    found = detect(picture, valid)
    return pack(found.points, found.descriptors, _aspect(picture))


def _unpacked(codes: bytes) -> LocalFeatures:
    """Damaged ones show nothing, as a damaged picture does."""
    try:
        points, descriptors, _ = unpack(codes)
    except ValueError:
        points, descriptors = np.empty((0, 2), np.float32), np.empty((0, 128), np.float32)
    return LocalFeatures(points, descriptors)


def _aspect(picture: bytes) -> float:
    """Height / width of a thumbnail or of the one that features are of."""
    if packed(picture):
        try:
            return unpack(picture)[2]
        except ValueError:
            return 1.0
    height, width = decoded(picture).shape
    return height / width


def match(query: LocalFeatures, reference: LocalFeatures) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Mutual nearest neighbours that pass Lowe's ratio test, as numbers (query, reference), by query number."""
    if min(len(query.points), len(reference.points)) < 2:
        return np.empty(0, np.int64), np.empty(0, np.int64)
    similarity = query.descriptors @ reference.descriptors.T
    best = similarity.argmax(1)
    mutual = similarity.argmax(0)[best] == np.arange(len(best))
    top = np.partition(similarity, -2, axis=1)[:, -2:]
    distinct = 1.0 - top[:, 1] < _RATIO**2 * (1.0 - top[:, 0])
    found = np.flatnonzero(mutual & distinct)
    return found, best[found]


def epipolar_check(query: LocalFeatures, reference: LocalFeatures, aspect: float) -> EpipolarCheck:
    """Which matches of two images agree on a fundamental matrix. `aspect` = height / width of the images.

    Two images of one place in motion fulfil it whatever the depth of the scene; eight points fulfil it by chance.
    """
    q, r = match(query, reference)
    a, b = query.points[q], reference.points[r]
    inlier = np.zeros(len(q), bool)
    if len(q) >= _LEAST:
        _, mask = cv2.findFundamentalMat(a * WIDTH, b * WIDTH, cv2.FM_RANSAC, _TOLERANCE_PX, 0.99)
        if mask is not None:
            inlier = mask.ravel().astype(bool)
    return EpipolarCheck(a, b, inlier, min(hull_area(a[inlier]), hull_area(b[inlier])) / aspect)


class RootSIFTVerifier:
    """RootSIFT of small pictures, the latest features kept; neighbouring queries meet the same candidates."""

    side = WIDTH

    def __init__(self) -> None:
        self._features: OrderedDict[bytes, LocalFeatures] = OrderedDict()
        self._valid: dict[str, NDArray[np.bool_]] = {}

    def keep(self, rgb: NDArray[np.uint8], camera: str, valid: NDArray[np.bool_] | None = None) -> bytes:
        """A thumbnail. `valid` leaves out the robot's own body, in the camera's older pictures as well."""
        if valid is not None:
            self._valid[camera] = valid
        return thumbnail(rgb)

    def prepare(self, kept: Iterable[tuple[bytes, str]], workers: Workers) -> None:
        """Find the features of thumbnails that are about to be checked, in threads."""
        new = {picture: camera for picture, camera in kept if picture not in self._features}
        found = workers.map(lambda item: detect(item[0], self._valid.get(item[1])), new.items())
        self._features.update(zip(new, found, strict=True))

    def check(self, query: bytes, query_camera: str, reference: bytes, reference_camera: str) -> EpipolarCheck:
        """Two thumbnails and the cameras that took them."""
        return epipolar_check(
            self._detected(query, query_camera), self._detected(reference, reference_camera), _aspect(query)
        )

    def _detected(self, picture: bytes, camera: str) -> LocalFeatures:
        features = self._features.pop(picture, None) or detect(picture, self._valid.get(camera))
        self._features[picture] = features
        while len(self._features) > _CACHED:
            self._features.popitem(last=False)
        return features
