"""Networks in OpenVINO: graphs built from layers and numpy weights, compiled for this processor, kept on disk.

C channels, H x W pixels; one image at a time. A graph computes in the types of its nodes: layers that are given
bfloat16 run in it, with weights rounded here.
"""

import functools
import hashlib
import mmap
import threading
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import openvino as ov
from numpy.typing import NDArray
from openvino import opset15 as ops

from pnv_core.files import atomic_write
from pnv_core.networks.layers import (
    Add,
    AvgPool,
    Block,
    Concat,
    Conv,
    Crop,
    InstanceNorm,
    Layer,
    MaxPool,
    Network,
    Relu,
    Resize,
    Scale,
    Sigmoid,
    SpaceToDepth,
    shape_after,
)

Node = Any  # what an operation gives
Weights = Mapping[str, NDArray[np.float32]]
_DIGEST = hashlib.sha256().digest_size
PRECISIONS = {"float32": "f32", "bfloat16": "bf16"}
_BEYOND = 1e30  # larger than anything a network gives


class Compiled:
    """A graph ready to run on this processor."""

    def __init__(
        self, graph: Callable[[], ov.Model], threads: int, precision: str = "float32", kept: Path | None = None
    ) -> None:
        """`graph` makes it; where its types are wider it computes in `precision`. `threads` 0 = all cores.

        `kept` is a file for what was compiled: its name must tell apart whatever shapes the graph; precision and
        threads are added to it. With another release of the library or damage it is made again.
        """
        settings: dict[str, Any] = {
            "PERFORMANCE_HINT": "LATENCY",
            "INFERENCE_PRECISION_HINT": PRECISIONS[precision],
            "INFERENCE_NUM_THREADS": threads,
            "ENABLE_CPU_PINNING": False,  # the camera's driver and the middleware want these cores as well
        }
        stamp = f"{ov.__version__} {settings}".encode()
        kept = kept and kept.with_name(f"{kept.name}_{precision}_{threads}")
        file, found = _kept(kept, stamp, settings) if kept is not None else (None, None)
        if found is None:
            found = ov.Core().compile_model(graph(), "CPU", settings)
            if kept is not None:
                _keep(kept, stamp, found.export_model().getvalue())
        self._request = found.create_infer_request()
        self._file = self._unread = file  # the library reads from it as long as it runs
        self._turn = threading.Lock()

    def __call__(self, *inputs: NDArray) -> list[NDArray[np.float32]]:
        """The outputs for contiguous inputs; arrays of the caller's own. Threads take turns."""
        with self._turn:
            self._request.infer(list(inputs), share_inputs=True)
            if self._unread is not None:  # the weights are laid out anew now; pages that are asked for again come back
                self._unread.madvise(mmap.MADV_DONTNEED)
                self._unread = None
            return [tensor.data.copy() for tensor in self._request.output_tensors]


def _kept(path: Path, stamp: bytes, settings: dict[str, Any]) -> tuple[mmap.mmap | None, ov.CompiledModel | None]:
    """What `_keep` wrote with the same stamp, and the file mapped into memory that it reads from; None for else."""
    try:
        with path.open("rb") as file:
            content = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_COPY)
    except (OSError, ValueError):  # none, or an empty one
        return None, None
    body = np.frombuffer(content, np.uint8)[_DIGEST:]
    digest = hashlib.sha256(stamp)
    digest.update(body.data)
    if digest.digest() != content[:_DIGEST]:
        return None, None
    try:
        return content, ov.Core().import_model(ov.Tensor(body, shared_memory=True), "CPU", settings)
    except (RuntimeError, TypeError):  # from a processor that differs, say; an older library takes no tensor
        return None, None


def _keep(path: Path, stamp: bytes, body: bytes) -> None:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_write(path) as file:
            file.write(hashlib.sha256(stamp + body).digest() + body)
    except OSError:
        pass  # a home that cannot be written to costs time at the next start, nothing else


def release() -> str:
    """The library's version."""
    return str(ov.__version__).partition("-")[0]


def fast_precisions() -> list[str]:
    """What this processor multiplies natively, by the library's account: FP32, BF16, INT8, ..."""
    return list(ov.Core().get_property("CPU", "OPTIMIZATION_CAPABILITIES"))


def native_precision() -> str:
    """'bfloat16' where this processor multiplies it natively, else 'float32'."""
    return "bfloat16" if "BF16" in fast_precisions() else "float32"


def image_input(width: int, height: int, scale: Scale | None = None) -> tuple[Node, Node]:
    """(1, H, W, 3) uint8 parameter, and the same as (1, 3, H, W) float32 in [0, 1], scaled where given.

    The library computes with channels last: scaled before the transposition, nothing is moved.
    """
    pixels = ops.parameter([1, height, width, 3], np.uint8)
    mean, std = (np.asarray(v, np.float64) for v in ((scale.mean, scale.std) if scale else (0.0, 1.0)))
    scaled = ops.subtract(ops.multiply(ops.convert(pixels, "f32"), constant(1 / (255 * std))), constant(mean / std))
    return pixels, ops.transpose(scaled, integers(0, 3, 1, 2))


def build(network: Network, weights: Weights, x: Node) -> Node:
    """The network's output for x (1, C, H, W)."""
    for layer in network:
        x = _step(layer, weights, x)
    return x


def _step(layer: Layer, weights: Weights, x: Node) -> Node:
    match layer:
        case Crop():
            _, height, width = shape_after((layer,), tuple(x.output(0).shape)[1:])
            return ops.slice(x, integers(0, 0), integers(height, width), integers(1, 1), integers(2, 3))
        case Scale(mean=mean, std=std):
            return ops.divide(ops.subtract(x, _per_channel(mean)), _per_channel(std))
        case Conv():
            return _convolution(layer, weights, x)
        case Relu(most=most):
            return ops.relu(x) if most is None else ops.clamp(x, 0.0, most)
        case MaxPool(kernel=k, stride=s, pads=(top, left, bottom, right), ceil=ceil):
            rounding = "ceil_torch" if ceil else "floor"
            return ops.max_pool(x, [s, s], [1, 1], [top, left], [bottom, right], [k, k], rounding).output(0)
        case AvgPool(kernel=k, stride=s):
            return ops.avg_pool(x, [s, s], [0, 0], [0, 0], [k, k], True)
        case InstanceNorm(epsilon=epsilon):
            return ops.mvn(x, integers(2, 3), True, epsilon, "inside_sqrt")
        case Resize(factor=factor):
            scales = constant([factor, factor])
            return ops.interpolate(x, scales, "linear_onnx", "scales", axes=integers(2, 3))  # half pixels, as torch
        case SpaceToDepth(block=block):
            return ops.space_to_depth(x, "depth_first", block)
        case Sigmoid():
            return ops.sigmoid(x)
        case Block(layers=layers):
            return build(layers, weights, x)
        case Add(branches=branches):
            return functools.reduce(ops.add, [build(branch, weights, x) for branch in branches])
        case Concat(branches=branches):
            return ops.concat([build(branch, weights, x) for branch in branches], 1)


def _convolution(conv: Conv, weights: Weights, x: Node) -> Node:
    kernel = weights[f"{conv.name}.weight"]
    (top, left, bottom, right), strides = conv.pads, [conv.stride] * 2
    if conv.groups > 1:
        kernel = kernel.reshape(conv.groups, -1, *kernel.shape[1:])
    convolve = ops.group_convolution if conv.groups > 1 else ops.convolution
    kind = x.get_element_type()
    half = kind == ov.Type.bf16
    if half and conv.groups > 1:
        kernel = _rounded_with_sums(kernel)
    y = convolve(x, constant(kernel, kind), strides, [top, left], [bottom, right], [1, 1])
    if not conv.bias:
        return y
    bias = np.reshape(weights[f"{conv.name}.bias"], (1, -1, 1, 1))
    if half:  # in two parts, or its error is the same in every cell; sums are float32 until they are kept
        y = ops.clamp(ops.add(y, constant(bias, kind)), -_BEYOND, _BEYOND)  # else the library adds the parts beforehand
        bias = bias - _rounded(bias)
    return ops.add(y, constant(bias, kind))


def _rounded(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """To the nearest bfloat16, ties to even; the library's conversion of constants cuts off."""
    bits = np.ascontiguousarray(values, np.float32).view(np.uint32)
    return ((bits + 0x7FFF + (bits >> 16 & 1)) & 0xFFFF0000).view(np.float32)


def _rounded_with_sums(kernels: NDArray[np.float32]) -> NDArray[np.float32]:
    """(C, ...) to bfloat16 such that the sum of each stays.

    Kernels that respond to contrast sum to nearly nothing; rounded one by one they would respond to brightness as well.
    From the largest weight to the smallest each takes over the error of those before it.
    """
    flat = kernels.reshape(len(kernels), -1)
    order = np.argsort(-np.abs(flat), axis=1, kind="stable")
    rounded, error = np.empty_like(flat), np.zeros((len(flat), 1), np.float32)
    for taps in order.T[:, :, None]:
        wanted = np.take_along_axis(flat, taps, 1) + error
        np.put_along_axis(rounded, taps, _rounded(wanted), 1)
        error = wanted - _rounded(wanted)
    return rounded.reshape(kernels.shape)


def _per_channel(values: Sequence[float] | NDArray[np.float32]) -> Node:
    return constant(np.asarray(values, np.float32).reshape(1, -1, 1, 1))


def constant(values: Any, kind: ov.Type = ov.Type.f32) -> Node:
    """A constant of the shape of the values, float32 or bfloat16."""
    found = np.ascontiguousarray(values, np.float32)
    return ops.constant(found) if kind == ov.Type.f32 else ops.convert(ops.constant(_rounded(found)), kind)


def integers(*values: int) -> Node:
    """A list of int64, as shapes and axes are given."""
    return ops.constant(np.array(values, np.int64))
