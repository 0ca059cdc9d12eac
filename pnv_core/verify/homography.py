"""RANSAC for homographies: OpenCV's samples, tests and stopping rule, many samples at a time. M matches, n samples.

OpenCV solves each sample by an eigenvalue problem, one after another; four points have a closed form, and a sample
matters only if more matches agree with it than with those before, which is known for many at once.
"""

import functools
import itertools
import math

import cv2
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.floating]
Mask = NDArray[np.bool_]

LEAST = 4  # a homography needs four points
_MOST, _CONFIDENCE = 2000, 0.995  # OpenCV's defaults, which the authors' code takes
_ATTEMPTS = 10000  # unusable samples in a row after which OpenCV gives up
_FIRST, _BLOCK = 256, 4096  # samples looked at together, twice as many each time: often the first few suffice
_ROWS = 256  # models whose residuals fit the second-level cache
_DRAWS = 1 << 15
_MULTIPLIER, _LOW = 4164903690, 0xFFFFFFFF  # of OpenCV's multiply-with-carry generator
_AT_INFINITY = np.float32(1e-7)  # squared; a point whose depth is rounding alone agrees with nothing
_EPSILON = np.finfo(np.float32).eps
_PAIRS = [(j, k) for j in range(3) for k in range(j)]
_TRIPLES = [(0, 1, 2), (1, 2, 3), (0, 2, 3), (0, 1, 3)]
# From this release on findHomography gives the inliers of the refined homography (OpenCV issue 25546).
_REFINED = tuple(int(part) for part in cv2.__version__.split(".")[:2]) >= (4, 12)


def homography_inliers(source: NDArray[np.float32], target: NDArray[np.float32], tolerance: float) -> Mask:
    """(M, 2) each, M >= 4, pixels -> (M,): the inliers of cv2.findHomography with RANSAC, found faster.

    Only the search is our own; refinement is OpenCV's.
    """
    if len(source) == LEAST:
        return _opencv_inliers(source, target, tolerance)
    model = _best_model(source, target, np.float32(tolerance * tolerance))
    if model is None:
        return np.zeros(len(source), bool)
    inlier = _transferred(model, source, target, tolerance)
    if not _REFINED:
        return inlier
    if np.count_nonzero(inlier) < LEAST:
        return _opencv_inliers(source, target, tolerance)
    refined, _ = cv2.findHomography(source[inlier], target[inlier], 0)
    if refined is None:
        return _opencv_inliers(source, target, tolerance)
    return _transferred(refined.astype(np.float32).ravel(), source, target, tolerance)


def usac_inliers(source: NDArray[np.float32], target: NDArray[np.float32], tolerance: float) -> Mask:
    """(M, 2) each, M >= 4, pixels -> (M,): inliers of OpenCV's USAC (Raguram et al., TPAMI 2013), the same every time.

    Nearly those of RANSAC in a tenth of its time (`benchmarks/run.py`, rows ransac and usac of the re-ranking).
    """
    _, mask = cv2.findHomography(source, target, cv2.USAC_FAST, tolerance, maxIters=_MOST, confidence=_CONFIDENCE)
    return np.zeros(len(source), bool) if mask is None else mask.ravel().astype(bool)


def _opencv_inliers(source: NDArray[np.float32], target: NDArray[np.float32], tolerance: float) -> Mask:
    _, mask = cv2.findHomography(source, target, cv2.RANSAC, tolerance)
    return np.zeros(len(source), bool) if mask is None else mask.ravel().astype(bool)


def _transferred(h: NDArray[np.float32], source: Floats, target: Floats, tolerance: float) -> Mask:
    """Which points the homography h (8 or 9,), its ninth number 1, brings within `tolerance` of their targets."""
    x, y = source.T
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        scale = np.float32(1) / (h[6] * x + h[7] * y + np.float32(1))
        dx = (h[0] * x + h[1] * y + h[2]) * scale - target[:, 0]
        dy = (h[3] * x + h[4] * y + h[5]) * scale - target[:, 1]
        found: Mask = dx * dx + dy * dy <= np.float32(tolerance * tolerance)
    return found


def _best_model(source: Floats, target: Floats, limit: np.float32) -> NDArray[np.float32] | None:
    """The first of the samples' homographies that most matches agree with, None if no four of them do."""
    matches = len(source)
    sides = [np.ascontiguousarray(side.T, np.float32) for side in (source, target)]
    terms = _residual_terms(source, target, math.sqrt(limit))
    best, tried, needed, useless, model = LEAST - 1, 0, _MOST, 0, None
    for block in itertools.count():
        rows, _ = _samples(matches, block)
        points, images = (np.take(side, rows, axis=1) for side in sides)  # (2, 4, n)
        good = _usable(points, images)  # exact in float32 for patches: their centres are whole or half pixels
        gaps = (
            np.diff(good, prepend=-1 - useless, append=rows.shape[1]) - 1
        )  # unusable samples before each and after all
        if (long := np.flatnonzero(gaps[:-1] >= _ATTEMPTS)).size:
            good = good[: long[0]]
        good = good[: _MOST - tried]
        models = _four_point_homographies(*(np.take(side, good, axis=2).astype(float) for side in (points, images)))
        counts = _counts(models, terms)
        record = np.maximum.accumulate(np.append(best, counts))
        for number in np.flatnonzero(record[1:] > record[:-1]):
            if tried + number >= needed:
                break
            best, model = int(counts[number]), models[number]
            needed = _iterations((matches - best) / matches, needed)
        tried += len(good)
        useless = gaps[-1]
        if tried >= needed or long.size or useless >= _ATTEMPTS:
            return model
    raise AssertionError("samples never end")


def _usable(points: Floats, images: Floats) -> NDArray[np.int64]:
    """(2, 4, n) each -> the samples with no three points on a line with the last, and no triangle turned over."""
    turned = [_turn(points, *triple) * _turn(images, *triple) < 0 for triple in _TRIPLES]
    alike = (turned[0] == turned[1]) & (turned[0] == turned[2]) & (turned[0] == turned[3])  # all four, or none
    rows = np.flatnonzero(alike)
    points, images = (np.take(side, rows, axis=2) for side in (points, images))
    usable = np.ones(len(rows), bool)
    for side in (points, images):
        offsets = side[:, :3] - side[:, 3:]
        size = np.abs(offsets).sum(0)
        for j, k in _PAIRS:
            area = offsets[0, k] * offsets[1, j] - offsets[1, k] * offsets[0, j]
            usable &= np.abs(area) > _EPSILON * (size[j] + size[k])
    return rows[usable]


def _turn(points: Floats, a: int, b: int, c: int) -> Floats:
    x, y = points
    return (x[b] - x[a]) * (y[c] - y[a]) - (x[c] - x[a]) * (y[b] - y[a])


def _from_square(p: Floats) -> list[list[Floats]]:
    """The homographies from the unit square to four points (2, 4, n) (Heckbert 1989); not finite if there is none."""
    (x0, x1, x2, x3), (y0, y1, y2, y3) = p
    sx, sy = x0 - x1 + x2 - x3, y0 - y1 + y2 - y3
    dx1, dx2, dy1, dy2 = x1 - x2, x3 - x2, y1 - y2, y3 - y2
    area = dx1 * dy2 - dx2 * dy1
    g, h = (sx * dy2 - dx2 * sy) / area, (dx1 * sy - sx * dy1) / area
    return [[x1 - x0 + g * x1, x3 - x0 + h * x3, x0], [y1 - y0 + g * y1, y3 - y0 + h * y3, y0], [g, h, np.ones_like(g)]]


def _four_point_homographies(points: Floats, images: Floats) -> NDArray[np.float32]:
    """(2, 4, n) each -> (n, 9), the ninth 1; not finite where there is none."""
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        a, b = _from_square(points), _from_square(images)

        def cofactor(i: int, j: int) -> Floats:  # of the inverse of a, up to a factor
            p, q, r, s = (j + 1) % 3, (j + 2) % 3, (i + 1) % 3, (i + 2) % 3
            return a[p][r] * a[q][s] - a[p][s] * a[q][r]

        inverse = [[cofactor(i, j) for j in range(3)] for i in range(3)]
        product = np.stack([sum(b[i][m] * inverse[m][j] for m in range(3)) for i in range(3) for j in range(3)], axis=1)
        return (product / product[:, 8:]).astype(np.float32)


def _residual_terms(source: Floats, target: Floats, tolerance: float) -> NDArray[np.float32]:
    """(9, 3 * M): what a homography's nine numbers are multiplied with for X - u W, Y - v W and tolerance * W."""
    x, y = source.T.astype(np.float32)
    u, v = target.T.astype(np.float32)
    one, zero = np.ones_like(x), np.zeros_like(x)
    across = [x, y, one, zero, zero, zero, -u * x, -u * y, -u]
    down = [zero, zero, zero, x, y, one, -v * x, -v * y, -v]
    depth = [zero] * 6 + [tolerance * x, tolerance * y, tolerance * one]
    return np.concatenate([across, down, depth], axis=1, dtype=np.float32)


def _counts(models: NDArray[np.float32], terms: NDArray[np.float32]) -> NDArray[np.int64]:
    """Matches within the tolerance of each model (n, 9); 0 for one that is not finite."""
    finite = np.asarray(np.isfinite(models).all(axis=1))
    models = np.where(finite[:, None], models, 0)
    counts = [_count(models[start : start + _ROWS], terms) for start in range(0, len(models), _ROWS)]
    return np.where(finite, np.concatenate([np.empty(0, np.int64), *counts]), 0)


def _count(models: NDArray[np.float32], terms: NDArray[np.float32]) -> NDArray[np.int64]:
    with np.errstate(over="ignore"):  # infinitely far off
        residuals = models @ terms
        np.square(residuals, out=residuals)
        across, down, limit = np.split(residuals, 3, axis=1)
        across += down
        across += _AT_INFINITY
    return np.asarray(np.count_nonzero(across <= limit, axis=1))


def _iterations(outliers: float, most: int) -> int:
    """Samples after which, with OpenCV's confidence, one was free of outliers; never more than `most`."""
    failure = 1.0 - (1.0 - outliers) ** 4
    if failure < np.finfo(np.float64).tiny:
        return 0
    wanted, each = math.log(1.0 - _CONFIDENCE), math.log(failure)
    return most if each >= 0 or -wanted >= most * -each else round(wanted / each)


@functools.lru_cache(maxsize=8)
def _draws(power: int) -> NDArray[np.uint32]:
    """The first 2 ** power of OpenCV's random numbers."""
    found, state = [], 0xFFFFFFFFFFFFFFFF  # its seed
    for _ in range(1 << power):
        state = (state & _LOW) * _MULTIPLIER + (state >> 32)
        found.append(state & _LOW)
    return np.array(found, np.uint32)


@functools.lru_cache(maxsize=512)  # up to 33 kB each; neighbouring frames have about as many matches
def _samples(matches: int, block: int) -> tuple[NDArray[np.int16], int]:
    """(4, n) numbers of matches as OpenCV draws them, four different ones at a time, and how many draws that took.

    Block 0 has _FIRST samples, every later one twice as many up to _BLOCK.
    """
    start = _samples(matches, block - 1)[1] if block else 0
    count = min(_FIRST << min(block, 10), _BLOCK)
    enough = max(15, (start + 8 * count).bit_length())
    while True:
        drawn = (_draws(enough)[start:] % np.uint32(matches)).astype(np.int16)
        quads = np.lib.stride_tricks.sliding_window_view(drawn, 4)
        clean = np.ones(len(quads), bool)
        for j, k in _PAIRS + [(3, k) for k in range(3)]:
            clean &= quads[:, j] != quads[:, k]
        rows, at = _walk(drawn, quads, clean.tobytes(), count)
        if len(rows) == count:
            return np.ascontiguousarray(rows.T), start + at
        enough += 1


def _walk(
    drawn: NDArray[np.int16], quads: NDArray[np.int16], clean: bytes, count: int
) -> tuple[NDArray[np.int16], int]:
    """Samples one after another: most are four draws, those that repeat a number take more."""
    places: list[int] = []
    longer: dict[int, list[int]] = {}
    at, last = 0, len(quads) - 64
    while len(places) < count and at < last:
        places.append(at)
        if clean[at]:
            at += 4
            continue
        sample: list[int] = []
        while len(sample) < 4 and at < len(drawn):
            if drawn[at] not in sample:
                sample.append(int(drawn[at]))
            at += 1
        longer[len(places) - 1] = sample
    rows = quads[places]
    for number, sample in longer.items():
        rows[number] = sample
    return rows, at
