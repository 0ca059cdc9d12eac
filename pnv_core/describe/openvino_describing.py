"""Describing with OpenVINO: pixels to descriptors in one graph.

K clusters, C channels, h x w feature map (N = h * w cells), E channels of the h' x w' map that is pooled,
D dimensions, n = patches of one size. Window sums add one axis at a time and cancel nothing. A projection is linear
and so is the sum over a window: each cluster's residual map is projected once, and its windows are summed afterwards;
only the norms of the intra-normalisation need the unprojected sums.
"""

import hashlib
from collections.abc import Callable, Sequence
from functools import cached_property, partial
from pathlib import Path

import numpy as np
import openvino as ov
from numpy.typing import NDArray
from openvino import opset15 as ops

from pnv_core.describe.model_files import Model
from pnv_core.networks.layers import Scale
from pnv_core.networks.openvino_backend import Compiled, Node, build, constant, image_input, integers

Floats = NDArray[np.float32]
Windows = Sequence[tuple[int, int]]  # (size, stride) per patch size

_COLUMNS = 16  # of the projection at a time: with K clusters their maps then fit the second-level cache
_SEPARATE = 4  # sizes from here on are summed one axis at a time
_EPSILON = 1e-12  # as F.normalize
_GRAPH = "1"  # to be counted up where the graph changes: what older programs compiled is no longer read


class OpenVinoDescribing:
    """A model at one image size, on the processor. `pixels` are (H, W, 3) uint8 of that size."""

    def __init__(
        self, model: Model, size: tuple[int, int], windows: Windows, threads: int, precision: str, cache: Path | None
    ) -> None:
        """`precision` is that of the trunk but for its precise layers; `cache` a folder for what is compiled."""
        self._model, self._size, self._cache, self._dense = model, size, cache, model.trunk.dense
        self._threads, self._half = threads, precision == "bfloat16"
        cells = model.trunk.shape(*size)[1:]
        self._every = np.ones((1, 1, *cells), np.float32)
        shaping = size, tuple(map(tuple, windows))
        if self._dense is None:
            self._graph = self._compiled(partial(describing, model, size, windows, self._half), "describing", *shaping)
        else:
            self._graph = self._compiled(partial(head, model, cells, windows), "head", *shaping)

    def _compiled(self, graph: Callable[[], ov.Model], *shaping: object) -> Compiled:
        told = f"{_GRAPH} {self._model.fingerprint()} {shaping} {self._half}"
        name = hashlib.sha256(told.encode()).hexdigest()[:32]
        return Compiled(graph, self._threads, kept=None if self._cache is None else self._cache / name)

    @cached_property
    def _trunk(self) -> Compiled:
        return self._compiled(partial(trunk_maps, self._model, self._size, self._half), "maps", self._size)

    def maps(self, pixels: NDArray[np.uint8]) -> tuple[Floats, ...]:
        """The trunk's maps: features (C, h, w), before the neck (W, h, w), and deep ones (E, h', w')."""
        if self._dense is not None:
            return (self._dense(pixels),) * 3
        found = self._trunk(np.ascontiguousarray(pixels)[None])
        return found[0][0], found[1 if self._model.trunk.neck else 0][0], found[-1][0]

    def describe(self, pixels: NDArray[np.uint8], cells: Floats | None = None) -> tuple[Floats, list[Floats]]:
        """The global vector (D,) and the patches [(n, D), ...]. `cells` (h, w) say how much each cell counts."""
        counted = self._every if cells is None else np.ascontiguousarray(cells, np.float32).reshape(self._every.shape)
        if self._dense is None:
            vector, *patches = self._graph(np.ascontiguousarray(pixels)[None], counted)
        else:
            features = self._dense(pixels)[None]
            vector, *patches = self._graph(features, features, counted)
        return vector, patches


def describing(model: Model, size: tuple[int, int], windows: Windows, half: bool = False) -> ov.Model:
    """(1, H, W, 3) uint8 and (1, 1, h, w), how much each cell counts -> the vector (D,), patches (n, D), ...

    With `half` the trunk computes in bfloat16 after its precise layers, and local descriptors are projected in it.
    """
    pixels, features, wide, deep = _maps(model, size, half)
    counted = ops.parameter([1, 1, *model.trunk.shape(*size)[1:]], np.float32)
    outputs = _described(model, features, wide, deep, counted, windows, half)
    return ov.Model(outputs, [pixels, counted], "describing")


def head(model: Model, cells: tuple[int, int], windows: Windows) -> ov.Model:
    """As `describing`, from the trunk's maps: (1, C, h, w), (1, E, h', w') and (1, 1, h, w); for a model without
    `middle_projection`, as a dense trunk makes it.
    """
    features = ops.parameter([1, model.trunk.channels, *cells], np.float32)
    deep = ops.parameter([1, *model.trunk.pooled_shape(cells)], np.float32)
    counted = ops.parameter([1, 1, *cells], np.float32)
    outputs = _described(model, features, features, deep, counted, windows, False)
    return ov.Model(outputs, [features, deep, counted], "head")


def trunk_maps(model: Model, size: tuple[int, int], half: bool = False) -> ov.Model:
    """(1, H, W, 3) uint8 -> the trunk's features, the map before its neck and the deep one, each once."""
    pixels, features, wide, deep = _maps(model, size, half)
    outputs = [features] * bool(model.trunk.neck) + [wide] + [deep] * bool(model.trunk.deep)
    return ov.Model(outputs, [pixels], "trunk")


def _maps(model: Model, size: tuple[int, int], half: bool) -> tuple[Node, Node, Node, Node]:
    """The graph's input; the trunk's features, the map before its neck and the deep one."""
    trunk, weights = model.trunk, model.part("trunk")
    scale = next((layer for layer in trunk.layers[: trunk.input_layers] if isinstance(layer, Scale)), None)
    pixels, images = image_input(*size, scale)
    first = max(trunk.precise, trunk.input_layers)
    x = build(tuple(layer for layer in trunk.layers[:first] if layer is not scale), weights, images)
    wide = build(trunk.layers[first:], weights, ops.convert(x, "bf16") if half else x)
    found = build(trunk.neck, weights, wide), wide, build(trunk.deep, weights, wide)
    return pixels, *(ops.convert(maps, "f32") for maps in found)


def _described(
    model: Model, features: Node, wide: Node, deep: Node, counted: Node, windows: Windows, half: bool
) -> list[Node]:
    """What follows the trunk."""
    centroids = model.tensors["netvlad.centroids"]
    _, c, h, w = features.output(0).shape
    x = ops.reshape(_unit(features, 1), integers(c, h * w), False)
    logits = ops.matmul(constant(model.tensors["netvlad.assignment"]), x, False, False)  # (K, N)
    weights = ops.multiply(ops.softmax(logits, 0), ops.reshape(counted, integers(1, h * w), False))
    vector = _global_vector(model, x, weights, {"pooled_projection": deep, "middle_projection": wide}, counted)
    scales = _scales(centroids, x, weights, (h, w), windows)
    return [vector, *_patches(model, ops.convert(x, "bf16") if half else x, weights, scales, (h, w), windows)]


def _unit(x: Node, axis: int) -> Node:
    return ops.normalize_l2(x, integers(axis), _EPSILON**2, "max")


def _projected(model: Model, part: str, row: Node) -> Node:
    """(1, inputs) -> unit (1, D)."""
    weight, bias = (model.tensors[f"{part}.{name}"] for name in ("weight", "bias"))
    return _unit(ops.add(ops.matmul(row, constant(weight), False, True), constant(bias[None])), 1)


def _global_vector(model: Model, x: Node, weights: Node, maps: dict[str, Node], counted: Node) -> Node:
    """Projected VLAD, beside it the projected generalised means of those `maps` that the model has a part for: (D,)."""
    centroids = model.tensors["netvlad.centroids"]
    mass = ops.reduce_sum(weights, integers(1), True)  # (K, 1)
    sums = ops.subtract(ops.matmul(weights, x, False, True), ops.multiply(mass, constant(centroids)))
    vlad = _unit(ops.reshape(_unit(sums, 1), integers(1, centroids.size), False), 1)
    parts = [
        ops.multiply(
            _projected(model, part, _mean(maps[part], counted) if part in maps else vlad), constant(np.sqrt(share))
        )
        for part, share in model.shares.items()
    ]
    return ops.reshape(ops.concat(parts, 1), integers(-1), False)


def _mean(maps: Node, counted: Node) -> Node:
    """Generalised mean (p = 3) over the cells of (1, E, h', w'): unit (1, E)."""
    step = counted.shape[3] // maps.shape[3]
    if step > 1:
        counted = ops.avg_pool(counted, [step, step], [0, 0], [0, 0], [step, step], True)
    floored = ops.maximum(maps, constant(1e-6))
    cubes = ops.multiply(ops.multiply(floored, floored), floored)
    total = ops.reduce_sum(ops.multiply(cubes, counted), integers(2, 3), False)
    area = ops.maximum(ops.reduce_sum(counted, integers(2, 3), False), constant(1e-6))
    return _unit(ops.power(ops.maximum(ops.divide(total, area), constant(1e-18)), constant(1 / 3)), 1)


def _window_means(maps: Node, size: int, stride: int) -> Node:
    """(K, C, h, w) -> (K, C, rows, cols)."""
    pool = partial(ops.avg_pool, pads_begin=[0, 0], pads_end=[0, 0], exclude_pad=True)
    if size < _SEPARATE:
        return pool(maps, [stride, stride], kernel_shape=[size, size])
    return pool(pool(maps, [stride, 1], kernel_shape=[size, 1]), [1, stride], kernel_shape=[1, size])


def _scales(centroids: Floats, x: Node, weights: Node, cells: tuple[int, int], windows: Windows) -> list[Node]:
    """Per patch size the factor (K, 1, rows, cols) that makes each cluster's mean residual unit, and all of them."""
    h, w = cells
    local = ops.reshape(x, integers(1, -1, h, w), False)
    squares: list[list[Node]] = [[] for _ in windows]
    for number, centroid in enumerate(centroids):  # one cluster at a time: its maps stay in cache
        rows = ops.slice(weights, integers(number), integers(number + 1), integers(1), integers(0))
        weight = ops.reshape(rows, integers(1, 1, h, w), False)
        residuals = ops.multiply(ops.subtract(local, constant(centroid[None, :, None, None])), weight)
        for found, window in zip(squares, windows, strict=True):
            means = _window_means(residuals, *window)
            found.append(ops.reduce_sum(ops.multiply(means, means), integers(1), True))
    scales = []
    for found in squares:
        norms = ops.sqrt(ops.concat(found, 0))
        floor = ops.maximum(norms, constant(_EPSILON))
        units = ops.divide(norms, floor)
        total = ops.sqrt(ops.reduce_sum(ops.multiply(units, units), integers(0), True))
        touched = ops.convert(ops.greater(total, constant(0.0)), "f32")  # a patch no cluster touches becomes zero
        scales.append(ops.divide(touched, ops.multiply(floor, ops.maximum(total, constant(_EPSILON)))))
    return scales


def _patches(
    model: Model, x: Node, weights: Node, scales: list[Node], cells: tuple[int, int], windows: Windows
) -> list[Node]:
    """Projected unit patches per size, (n, D)."""
    h, w = cells
    centroids = model.tensors["netvlad.centroids"]
    k, c = centroids.shape
    weight, bias = (model.tensors[f"{model.patches_projection}.{name}"] for name in ("weight", "bias"))
    parts: list[list[Node]] = [[] for _ in windows]
    assigned = ops.reshape(weights, integers(k, 1, h, w), False)
    for start in range(0, len(bias), _COLUMNS):
        block = weight[start : start + _COLUMNS].reshape(-1, k, c).transpose(1, 0, 2)  # (K, d, C)
        offsets = np.einsum("kdc,kc->kd", block, centroids)[:, :, None, None]
        projected = ops.matmul(constant(block.reshape(-1, c), x.get_element_type()), x, False, False)
        maps = ops.reshape(ops.convert(projected, "f32"), integers(k, -1, h, w), False)
        residuals = ops.multiply(ops.subtract(maps, constant(offsets)), assigned)
        for found, scale, window in zip(parts, scales, windows, strict=True):
            scaled = ops.multiply(_window_means(residuals, *window), scale)
            found.append(ops.reduce_sum(scaled, integers(0), True))  # (1, d, rows, cols)
    rows = []
    for found, scale in zip(parts, scales, strict=True):
        touched = ops.convert(ops.greater(ops.reduce_max(scale, integers(0), True), constant(0.0)), "f32")
        vectors = ops.multiply(_unit(ops.add(ops.concat(found, 1), constant(bias[None, :, None, None])), 1), touched)
        rows.append(ops.transpose(ops.reshape(vectors, integers(len(bias), -1), False), integers(1, 0)))
    return rows
