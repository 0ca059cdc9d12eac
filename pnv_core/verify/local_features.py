"""Local features of images, compared: a second opinion on a candidate, and points for its geometry.

N = features of an image, M = matches.
"""

import contextlib
import io
import math
from collections import OrderedDict
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from pnv_core.config import Config
from pnv_core.describe.download import cache_folder
from pnv_core.threads import Workers, shared
from pnv_core.verify.feature_codes import features_only, pack, packed, picture_of, unpack
from pnv_core.verify.matching import mutual_maxima, similarities
from pnv_core.verify.verifier import RATIO, CloserLook, EpipolarCheck, hull_area

WIDTH = 640  # pixels of the longer side; night against day needs it
MOST = 500  # features: 34 kB a keyframe
KEPT_BYTES = 68 * MOST + 8_000  # of a keyframe: features, and a small picture of usual size
_SMALL = 320  # pixels of the picture kept for people
_TALLEST = 4 * _SMALL
_QUALITY = 85
_TWIN = 0.965  # cosine to a second feature from which on a look occurs twice: tiles of a wall
_TOLERANCE_PX = 1.5
_MOST_LIKE = 2.0
_LEAST = 8  # points that determine a fundamental matrix
_CACHED = 64  # images whose features are kept, about 0.2 MB each


@dataclass(frozen=True, eq=False)
class LocalFeatures:
    """Points (N, 2) of one image in units of its width, from the top left; unit descriptors (N, D)."""

    points: NDArray[np.float32]
    descriptors: NDArray[np.float32]

    @cached_property
    def own_distance(self) -> float:
        """How far apart (1 - cosine) a feature and the most similar other one of the image are, on average.

        Small where the image repeats itself, or is blurred. Two features at least.
        """
        similarity = similarities(self.descriptors, self.descriptors)
        np.fill_diagonal(similarity, -1.0)
        return 1.0 - float(similarity.max(1).mean())


def no_features(dim: int) -> LocalFeatures:
    return LocalFeatures(np.empty((0, 2), np.float32), np.empty((0, dim), np.float32))


def thumbnail(rgb: NDArray[np.uint8]) -> bytes:
    """(H, W, 3) uint8 -> a grey JPEG of at most 320 pixels width and the same aspect, up to four times as high."""
    grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
    if grey.shape[1] > _SMALL or grey.shape[0] > _TALLEST:
        height = min(_TALLEST, max(1, round(grey.shape[0] * _SMALL / grey.shape[1])))
        grey = cv2.resize(grey, (min(_SMALL, grey.shape[1]), height), interpolation=cv2.INTER_AREA)
    return cv2.imencode(".jpg", grey, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1].tobytes()


def decoded(picture: bytes) -> NDArray[np.uint8]:
    """(h, w) grey of a thumbnail; one that is damaged, or larger than `thumbnail` makes them, shows nothing.

    It may come from a map that somebody else wrote, so its sides are read before it is unpacked.
    """
    try:
        with Image.open(io.BytesIO(picture), formats=("JPEG",)) as header:
            small = header.width <= _SMALL and header.height <= _TALLEST
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError):
        small = False
    grey: Any = cv2.imdecode(np.frombuffer(picture, np.uint8), cv2.IMREAD_GRAYSCALE) if small else None
    return np.zeros((_SMALL, _SMALL), np.uint8) if grey is None else grey


def match(
    query: LocalFeatures, reference: LocalFeatures
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.bool_], NDArray[np.float32]]:
    """Mutual nearest neighbours, as numbers (query, reference), and which of them are distinct (Lowe's ratio test).

    With the cosine (N,) of every feature of the query and its nearest one.
    """
    if min(len(query.points), len(reference.points)) < 2:
        return np.empty(0, np.int64), np.empty(0, np.int64), np.empty(0, bool), np.zeros(len(query.points), np.float32)
    similarity = similarities(query.descriptors, reference.descriptors)
    best, mutual = mutual_maxima(similarity)
    first = similarity[mutual, best]
    similarity[mutual, best] = -1.0
    nearest = similarity.max(1)
    second = np.maximum(nearest[mutual], similarity.max(0)[best])
    nearest[mutual] = first
    return mutual, best, (1.0 - first < RATIO**2 * (1.0 - second)) & (second < _TWIN), nearest


def epipolar_check(query: LocalFeatures, reference: LocalFeatures, aspect: float) -> EpipolarCheck:
    """Which matches of two images are distinct and agree on a fundamental matrix. `aspect` = height / width.

    Two images of one place in motion fulfil it whatever the depth of the scene; eight points fulfil it by chance.
    Found by USAC with graph-cut refinement (Raguram et al., TPAMI 2013; Barath and Matas, CVPR 2018).
    """
    q, r, distinct, nearest = match(query, reference)
    a, b = query.points[q], reference.points[r]
    inlier = np.zeros(len(q), bool)
    inlier[distinct] = _epipolar_inliers(a[distinct] * WIDTH, b[distinct] * WIDTH)
    spread = min(hull_area(a[inlier]), hull_area(b[inlier])) / aspect
    return EpipolarCheck(a, b, inlier, spread, _likeness(query, reference, q, r), distinct, q, nearest)


def _likeness(query: LocalFeatures, reference: LocalFeatures, q: NDArray[np.int64], r: NDArray[np.int64]) -> float:
    """As EpipolarCheck has it, of the matches q, r; within 2 of 0, and -2 without matches.

    Lowe's ratio of the whole images, with each image's own features in the place of the second best: light changes both
    distances alike, and look-alike corridors are nearer to themselves than to one another.
    """
    if not len(q):
        return -_MOST_LIKE
    matched = 1.0 - float((query.descriptors[q] * reference.descriptors[r]).sum(1).mean())
    own = (query.own_distance + reference.own_distance) / 2
    return max(-_MOST_LIKE, min(_MOST_LIKE, math.log(max(own, 1e-6) / max(matched, 1e-6))))


def _epipolar_inliers(a: NDArray[np.float32], b: NDArray[np.float32]) -> NDArray[np.bool_]:
    """(M, 2) pixels each -> (M,)."""
    mask = None
    if len(a) >= _LEAST:
        with contextlib.suppress(cv2.error):  # no sample gave a model
            _, mask = cv2.findFundamentalMat(a, b, cv2.USAC_ACCURATE, _TOLERANCE_PX, 0.999, 1000)
    return np.zeros(len(a), bool) if mask is None else mask.ravel() > 0


def _size(points: NDArray[np.float32], weights: NDArray[np.float32]) -> float:
    """Standard deviation of weighted points (M, 2) about their mean; 0 for none."""
    if not weights.sum() > 0:
        return 0.0
    offsets = points - np.average(points, 0, weights)
    return math.sqrt(float(np.average((offsets**2).sum(1), 0, weights)))


def features_of(kept: bytes) -> bytes:
    """What was kept of an image less the picture; the features of the picture where a map holds that alone."""
    if picture_of(kept) == kept and kept:
        found, aspect = XFeatVerifier().features(kept)
        return pack(found.points, found.descriptors, aspect)
    try:
        return features_only(kept)
    except ValueError:
        return kept


class XFeatVerifier:
    """Keeps 500 learned features of an image and a small grey picture of it for people."""

    side = WIDTH

    def __init__(self, config: Config | None = None) -> None:
        from pnv_core.networks.openvino_backend import native_precision
        from pnv_core.verify.lighterglue import lighterglue
        from pnv_core.verify.xfeat import XFeat

        config = config or Config()
        _, threads = shared(config.threads, bool(config.verify))
        settings = threads, native_precision(), cache_folder() / "openvino"  # what is found is matched alike in both
        self._xfeat = XFeat(WIDTH, MOST, *settings)
        self._glue = lighterglue(*settings)
        self._features: OrderedDict[bytes, tuple[LocalFeatures, float]] = OrderedDict()

    def keep(self, rgb: NDArray[np.uint8], camera: str, valid: NDArray[np.bool_] | None = None) -> bytes:
        """Features and picture. `valid` leaves out the robot's own body."""
        found = self.found(rgb, valid)
        return pack(found.points, found.descriptors, rgb.shape[0] / rgb.shape[1], thumbnail(rgb))

    def found(self, rgb: NDArray[np.uint8], valid: NDArray[np.bool_] | None = None) -> LocalFeatures:
        """(H, W, 3) uint8 -> its features, before they are packed."""
        grey: Any = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
        return self._xfeat.features(grey, valid)

    def prepare(self, kept: Iterable[tuple[bytes, str]], workers: Workers) -> None:
        """Unpack features here, in one thread; the checks may then run in several."""
        for picture, _ in kept:
            self.features(picture)

    def check(self, query: bytes, query_camera: str, reference: bytes, reference_camera: str) -> EpipolarCheck:
        """Two images by what was kept of them."""
        (one, aspect), (other, _) = self.features(query), self.features(reference)
        return epipolar_check(one, other, aspect)

    def look_closer(self, query: bytes, reference: bytes) -> CloserLook:
        """By LighterGlue. Points that all lie at one place magnify nothing."""
        one, other = self.features(query), self.features(reference)
        q, r, probability = self._glue.matches(*one, *other)
        sizes = [_size(one[0].points[q], probability), _size(other[0].points[r], probability)]
        magnification = max(sizes) / min(sizes) if min(sizes) > 0 else 1.0
        return CloserLook(float(probability.sum()), magnification)

    def features(self, kept: bytes) -> tuple[LocalFeatures, float]:
        """Features as kept; where a map holds the picture alone, those of the picture."""
        found = self._features.get(kept)
        if found is None:
            found = self._features[kept] = self._unpacked(kept)
            while len(self._features) > _CACHED:
                self._features.popitem(last=False)
        return found

    def _unpacked(self, kept: bytes) -> tuple[LocalFeatures, float]:
        """What is damaged shows nothing."""
        if packed(kept):
            try:
                points, descriptors, aspect = unpack(kept)
            except ValueError:
                return no_features(64), 1.0
            return LocalFeatures(points, descriptors), aspect
        grey = decoded(kept)
        return self._xfeat.features(grey), grey.shape[0] / grey.shape[1]
