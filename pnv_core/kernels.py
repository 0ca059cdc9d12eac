"""Compiled inner loops. K clusters, C channels, h x w feature map (N = h * w), P patches of all sizes together.

They are compiled by numba on first use and kept on disk. Where numba is missing COMPILED is False and callers take
their plain formulation. They release the GIL: callers run several in threads.
"""

import math
from typing import Any

import numpy as np

try:
    from numba import njit

    COMPILED = True
except ImportError:  # a platform numba does not serve
    COMPILED = False

    def njit(**_: Any) -> Any:  # type: ignore[no-redef]
        return lambda function: function


# No reassociation: window sums and norms rely on the order of their additions. Contraction only fuses a*b + c.
_EXACT: dict[str, Any] = {"cache": True, "nogil": True, "error_model": "numpy"}
_OPTIONS: dict[str, Any] = {**_EXACT, "fastmath": {"contract"}}

_CANCELLED = np.float32(1e-3)  # a squared norm below this share of its terms is summed again, channel by channel


@njit(**_OPTIONS)
def add_windows(maps, offsets, weights, scales, h, w, sizes, strides, starts, out):
    """Adds one cluster's part to the patch sums.

    maps (N, L) projected local descriptors, offsets (L,) the projected centroid, weights (N,), scales (P,) one over the
    norm of the cluster in each patch; out (P, L) is added to. sizes ascend, starts (sizes,) count patches.
    L columns at a time, so that the window sums of one row stay in the first-level cache.
    """
    lanes = maps.shape[1]
    width = w * lanes
    residuals = np.empty((h, width), np.float32)
    column = np.empty(width, np.float32)
    ping = np.empty(width, np.float32)
    pong = np.empty(width, np.float32)
    total = np.empty(width, np.float32)
    for i in range(h):
        for j in range(w):
            weight = weights[i * w + j]
            source = maps[i * w + j]
            target = residuals[i, j * lanes : (j + 1) * lanes]
            for d in range(lanes):
                target[d] = weight * (source[d] - offsets[d])
    for i in range(h):
        column[:] = residuals[i]
        tall = 1
        for s in range(len(sizes)):
            size, stride = sizes[s], strides[s]
            if i + size > h:
                break
            for e in range(tall, size):  # the column sums of the next size continue those of the last
                source = residuals[i + e]
                for d in range(width):
                    column[d] += source[d]
            tall = size
            if i % stride:
                continue
            length = (w - size + 1) * lanes
            sums, reach, power, start = column, width, 1, 0
            while True:  # sums of powers of two, added up to the size
                if size & power:
                    part = sums[start * lanes : start * lanes + length]
                    if start == 0:
                        total[:length] = part
                    else:
                        for d in range(length):
                            total[d] += part[d]
                    start += power
                if 2 * power > size:
                    break
                doubled = pong if sums is ping else ping
                reach -= power * lanes
                shifted = sums[power * lanes : power * lanes + reach]
                for d in range(reach):
                    doubled[d] = sums[d] + shifted[d]
                sums = doubled
                power *= 2
            cols = (w - size) // stride + 1
            base = starts[s] + i // stride * cols
            for c in range(cols):
                scale = scales[base + c]
                target = out[base + c]
                source = total[c * stride * lanes : (c * stride + 1) * lanes]
                for d in range(lanes):
                    target[d] += scale * source[d]


@njit(**_OPTIONS)
def window_norms(x, gram, dots, weights, centroids, squares, h, w, size, stride, first_row, end_row, norms):
    """Norms of every cluster's summed residuals in every window of one size, without summing C channels.

    x (N, C) and centroids (K, C), both shifted by the same vector (small values cancel less); gram (N, N) = x x^T,
    dots (N, K) = x centroids^T, weights (N, K), squares (K,) of the centroids. Fills patch rows first_row..end_row of
    norms (rows, cols, K). |sum a (x - c)|^2 = sum_ij a_i a_j x_i.x_j - 2 (sum a) (sum a x.c) + (sum a)^2 c.c; where
    that cancels the channels are summed after all.
    """
    clusters = weights.shape[1]
    channels = x.shape[1]
    cols = (w - size) // stride + 1
    top = first_row * stride
    bottom = (end_row - 1) * stride + size
    pairs = np.zeros((bottom - top, size, cols, clusters), np.float32)  # by upper row, distance of the rows, column
    line = np.empty(clusters, np.float32)
    mass = np.empty(clusters, np.float32)
    cross = np.empty(clusters, np.float32)
    direct = np.empty(channels, np.float32)
    for y in range(top, bottom):
        for dy in range(min(size, bottom - y)):
            for c in range(cols):
                form = pairs[y - top, dy, c]
                for e in range(size):
                    n = y * w + c * stride + e
                    line[:] = 0
                    for f in range(size):
                        m = (y + dy) * w + c * stride + f
                        product = gram[n, m]
                        row = weights[m]
                        for k in range(clusters):
                            line[k] += product * row[k]
                    row = weights[n]
                    for k in range(clusters):
                        form[k] += row[k] * line[k]
    for r in range(first_row, end_row):
        y = r * stride - top
        for c in range(cols):
            line[:] = 0
            mass[:] = 0
            cross[:] = 0
            for e in range(size):
                form = pairs[y + e, 0, c]
                for k in range(clusters):
                    line[k] += form[k]
                for dy in range(1, size - e):
                    form = pairs[y + e, dy, c]
                    for k in range(clusters):
                        line[k] += np.float32(2) * form[k]
                for f in range(size):
                    n = (top + y + e) * w + c * stride + f
                    row = weights[n]
                    dot = dots[n]
                    for k in range(clusters):
                        mass[k] += row[k]
                        cross[k] += row[k] * dot[k]
            for k in range(clusters):
                square = line[k] - np.float32(2) * mass[k] * cross[k] + mass[k] * mass[k] * squares[k]
                if square < _CANCELLED * mass[k] * mass[k]:
                    direct[:] = 0
                    for e in range(size):
                        for f in range(size):
                            n = (top + y + e) * w + c * stride + f
                            for d in range(channels):
                                direct[d] += weights[n, k] * (x[n, d] - centroids[k, d])
                    square = np.float32(0)
                    for d in range(channels):
                        square += direct[d] * direct[d]
                norms[r, c, k] = math.sqrt(square)


@njit(**_EXACT)
def _collinear(x, y):
    """Whether the last of four points lies on a line with two of the others (or on one of them)."""
    for j in range(3):
        dx, dy = x[j] - x[3], y[j] - y[3]
        for k in range(j):
            ex, ey = x[k] - x[3], y[k] - y[3]
            if abs(ex * dy - ey * dx) <= 1.1920929e-07 * (abs(dx) + abs(dy) + abs(ex) + abs(ey)):
                return True
    return False


@njit(**_EXACT)
def _orientation(x, y, a, b, c):
    return (x[b] - x[a]) * (y[c] - y[a]) - (x[c] - x[a]) * (y[b] - y[a])


@njit(**_EXACT)
def _flipped(x, y, u, v, a, b, c):
    return _orientation(x, y, a, b, c) * _orientation(u, v, a, b, c) < 0


@njit(**_EXACT)
def _from_square(x, y, m):
    """The homography m (3, 3) from the unit square to four points (Heckbert 1989); False if they have none."""
    sx, sy = x[0] - x[1] + x[2] - x[3], y[0] - y[1] + y[2] - y[3]
    dx1, dx2, dy1, dy2 = x[1] - x[2], x[3] - x[2], y[1] - y[2], y[3] - y[2]
    area = dx1 * dy2 - dx2 * dy1
    if area == 0.0:
        return False
    g, h = (sx * dy2 - dx2 * sy) / area, (dx1 * sy - sx * dy1) / area
    m[0, 0], m[0, 1], m[0, 2] = x[1] - x[0] + g * x[1], x[3] - x[0] + h * x[3], x[0]
    m[1, 0], m[1, 1], m[1, 2] = y[1] - y[0] + g * y[1], y[3] - y[0] + h * y[3], y[0]
    m[2, 0], m[2, 1], m[2, 2] = g, h, 1.0
    return True


@njit(**_EXACT)
def _four_point_homography(x, y, u, v, a, b, model):
    """The homography (x, y) -> (u, v) of four points as eight numbers (the ninth is 1); False if there is none."""
    if not _from_square(x, y, a) or not _from_square(u, v, b):
        return False
    inverse = np.empty((3, 3))  # up to a factor
    for i in range(3):
        for j in range(3):
            p, q, r, s = (j + 1) % 3, (j + 2) % 3, (i + 1) % 3, (i + 2) % 3
            inverse[i, j] = a[p, r] * a[q, s] - a[p, s] * a[q, r]
    last = b[2, 0] * inverse[0, 2] + b[2, 1] * inverse[1, 2] + b[2, 2] * inverse[2, 2]
    if last == 0.0:
        return False
    for i in range(8):
        row, col = i // 3, i % 3
        model[i] = (b[row, 0] * inverse[0, col] + b[row, 1] * inverse[1, col] + b[row, 2] * inverse[2, col]) / last
    return True


@njit(**_EXACT)
def _count_inliers(h, x, y, u, v, limit):
    one = np.float32(1)
    h0, h1, h2, h3, h4, h5, h6, h7 = h[0], h[1], h[2], h[3], h[4], h[5], h[6], h[7]
    count = np.int32(0)
    for i in range(len(x)):
        scale = one / (h6 * x[i] + h7 * y[i] + one)
        dx = (h0 * x[i] + h1 * y[i] + h2) * scale - u[i]
        dy = (h3 * x[i] + h4 * y[i] + h5) * scale - v[i]
        count += np.int32(dx * dx + dy * dy <= limit)
    return count


@njit(**_EXACT)
def transfer_inliers(h, x, y, u, v, limit, inlier):
    """Which of the points (x, y) the homography h (8,), its ninth number 1, brings within sqrt(limit) of (u, v)."""
    one = np.float32(1)
    for i in range(len(x)):
        scale = one / (h[6] * x[i] + h[7] * y[i] + one)
        dx = (h[0] * x[i] + h[1] * y[i] + h[2]) * scale - u[i]
        dy = (h[3] * x[i] + h[4] * y[i] + h[5]) * scale - v[i]
        inlier[i] = dx * dx + dy * dy <= limit


@njit(**_EXACT)
def _iterations(confidence, outliers, most):
    """Samples after which, with this confidence, one was free of outliers; never more than `most`."""
    failure = 1.0 - (1.0 - outliers) ** 4
    if failure < 2.2250738585072014e-308:
        return 0
    wanted, each = math.log(1.0 - confidence), math.log(failure)
    if each >= 0 or -wanted >= most * -each:
        return most
    return int(np.rint(wanted / each))


@njit(**_EXACT)
def ransac_homography(source, target, tolerance, most, confidence):
    """RANSAC as OpenCV's findHomography runs it before refinement: the same samples, tests and stopping rule.

    source, target (M, 2) float32, M > 4, tolerance in pixels. Gives the inliers (M,) of the best model, none if there
    is no model. OpenCV solves each sample by an eigenvalue problem; four points have a closed form.
    """
    matches = len(source)
    x, y, u, v = source[:, 0].copy(), source[:, 1].copy(), target[:, 0].copy(), target[:, 1].copy()
    low = np.uint64(0xFFFFFFFF)
    state = np.uint64(0xFFFFFFFFFFFFFFFF)  # OpenCV's seed, and its multiply-with-carry generator below
    sample = np.zeros(4, np.int64)
    px, py, pu, pv = np.empty(4), np.empty(4), np.empty(4), np.empty(4)
    a, b, solved = np.empty((3, 3)), np.empty((3, 3)), np.empty(8)
    model, best_model = np.empty(8, np.float32), np.zeros(8, np.float32)
    limit = np.float32(tolerance * tolerance)
    best, tried, needed = 3, 0, most
    while tried < needed:
        found = False
        for _ in range(10000):
            for i in range(4):
                while True:
                    state = (state & low) * np.uint64(4164903690) + (state >> np.uint64(32))
                    sample[i] = np.int64((state & low) % np.uint64(matches))
                    repeated = False
                    for j in range(i):
                        repeated |= sample[j] == sample[i]
                    if not repeated:
                        break
            for i in range(4):
                px[i], py[i], pu[i], pv[i] = x[sample[i]], y[sample[i]], u[sample[i]], v[sample[i]]
            if _collinear(px, py) or _collinear(pu, pv):
                continue
            flips = 0
            flips += _flipped(px, py, pu, pv, 0, 1, 2)
            flips += _flipped(px, py, pu, pv, 1, 2, 3)
            flips += _flipped(px, py, pu, pv, 0, 2, 3)
            flips += _flipped(px, py, pu, pv, 0, 1, 3)
            if flips == 0 or flips == 4:
                found = True
                break
        if not found:
            break
        tried += 1
        if not _four_point_homography(px, py, pu, pv, a, b, solved):
            continue
        for i in range(8):
            model[i] = np.float32(solved[i])
        count = _count_inliers(model, x, y, u, v, limit)
        if count > best:
            best = count
            best_model[:] = model
            needed = _iterations(confidence, (matches - count) / matches, needed)
    inlier = np.zeros(matches, np.bool_)
    if best > 3:
        transfer_inliers(best_model, x, y, u, v, limit, inlier)
    return inlier


_FAST: dict[str, Any] = {**_EXACT, "fastmath": {"contract", "reassoc", "nnan", "nsz"}}  # sums in any order


@njit(**_FAST)
def quantise_rows(rows, codes, scales):
    """Rows (n, D) float32 as int8 codes (n, D) times scales (n,); gives the length of the worst rounding error."""
    worst = np.float32(0)
    for i in range(len(rows)):
        row = rows[i]
        largest = np.float32(0)
        for d in range(len(row)):
            size = abs(row[d])
            largest = size if size > largest else largest
        scale = largest / np.float32(127)
        scales[i] = scale
        inverse = np.float32(0) if scale == 0 else np.float32(1) / scale
        error = np.float32(0)
        code = codes[i]
        for d in range(len(row)):
            value = row[d] * inverse
            rounded = np.int32(value + np.float32(0.5) if value > 0 else value - np.float32(0.5))
            code[d] = rounded
            rest = row[d] - np.float32(rounded) * scale
            error += rest * rest
        worst = error if error > worst else worst
    return math.sqrt(worst)


@njit(**_EXACT)
def unpack_halves(halves, rows):
    """float16 as uint16 bits (n, D) -> float32 rows (n, D); no infinities. numpy converts ten times slower."""
    bits = rows.view(np.uint32)
    rebias = np.float32(2.0**112)  # difference of the exponents' biases; the product is exact, for subnormals too
    for i in range(len(halves)):
        half, bit, row = halves[i], bits[i], rows[i]
        for d in range(len(half)):
            wide = np.uint32(half[d])
            bit[d] = ((wide & np.uint32(0x8000)) << np.uint32(16)) | ((wide & np.uint32(0x7FFF)) << np.uint32(13))
        for d in range(len(half)):
            row[d] *= rebias


@njit(**_FAST)
def _dot(a, b):
    total = np.float32(0)
    for d in range(len(a)):
        total += a[d] * b[d]
    return total


@njit(**_FAST)
def _largest_similarities(products, scales, reference_scales, by_query, by_reference):
    """products (n_r, n_q) int32 -> the largest approximate similarity of each query and each reference patch."""
    by_query[:] = -np.float32(2)
    for i in range(len(products)):
        row = products[i]
        factor = reference_scales[i]
        largest = np.float32(-2)
        for j in range(len(row)):
            similarity = np.float32(row[j]) * (factor * scales[j])
            best = by_query[j]
            by_query[j] = similarity if similarity > best else best
            largest = similarity if similarity > largest else largest
        by_reference[i] = largest


_BLOCK = 32  # columns looked at together for a similarity worth computing exactly


@njit(**_FAST)
def _any_close(row, factor, scales, own, floor):
    """Whether an approximate similarity reaches the floor of its reference patch (own) or of its query patch."""
    close = np.int32(0)
    for j in range(len(row)):
        similarity = np.float32(row[j]) * (factor * scales[j])
        least = own if own < floor[j] else floor[j]
        close += np.int32(similarity >= least)
    return close


@njit(**_EXACT)
def nearest_of_products(products, query, reference, scales, reference_scales, margin, forward, backward):
    """The most similar query patch of each reference patch, forward (n_r,), and the reverse, backward (n_q,).

    products (n_r, n_q) int32 of the codes of reference (n_r, D) and query (n_q, D) float32; `margin` bounds how far an
    approximate similarity is from the exact one, so that only those within twice the margin of the largest need the
    exact product. The lowest number wins ties. A row of zeros has no nearest: -1.
    """
    n = len(query)
    by_query = np.empty(n, np.float32)
    by_reference = np.empty(len(reference), np.float32)
    _largest_similarities(products, scales, reference_scales, by_query, by_reference)
    floor = np.empty(n, np.float32)
    for j in range(n):
        floor[j] = by_query[j] - 2 * margin if scales[j] > 0 else np.float32(3)
    best_query = np.full(n, -np.inf, np.float32)
    best_reference = np.full(len(reference), -np.inf, np.float32)
    forward[:] = -1
    backward[:] = -1
    for i in range(len(reference)):
        factor = reference_scales[i]
        if factor == 0:
            continue
        row = products[i]
        own = by_reference[i] - 2 * margin
        for start in range(0, n, _BLOCK):
            end = min(start + _BLOCK, n)
            if not _any_close(row[start:end], factor, scales[start:end], own, floor[start:end]):
                continue
            for j in range(start, end):
                similarity = np.float32(row[j]) * (factor * scales[j])
                if scales[j] == 0 or (similarity < own and similarity < floor[j]):
                    continue
                exact = _dot(reference[i], query[j])
                if exact > best_reference[i]:
                    best_reference[i] = exact
                    forward[i] = j
                if exact > best_query[j]:
                    best_query[j] = exact
                    backward[j] = i
