"""LighterGlue: matches features of XFeat in the light of all the others (Potje et al., CVPR 2024).

LightGlue (Lindenberger, Sarlin, Pollefeys, ICCV 2023), made smaller.

A transformer whose layers look at the features of one image (self) and of the other (cross) in turn. It finds the
same points where the viewpoint has changed so far that no descriptor by itself is nearest any more, and knows which
points have no partner. N = MOST features, of which an image may have fewer; D = 96 channels; 2 images in a batch.
"""

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import openvino as ov
from numpy.typing import NDArray
from openvino import opset15 as ops
from safetensors.numpy import load_file

from pnv_core.networks.openvino_backend import Compiled, Node, constant, integers
from pnv_core.verify.local_features import MOST, LocalFeatures
from pnv_core.verify.matching import mutual_maxima

WEIGHTS = Path(__file__).parents[1] / "models" / "lighterglue.safetensors"
LAYERS = 6
_CHANNELS, _DESCRIPTOR = 96, 64
_LEAST = 0.1  # probability of a match, the authors' filter
_ABSENT = -1e4  # added to what attends to a feature that an image does not have
_EPSILON = 1e-5  # of layer normalisation
_GRAPH = "1"  # to be counted up where the graph or its weights change: what older programs compiled is no longer read

Indices = NDArray[np.int64]


@cache
def _weights() -> dict[str, NDArray[np.float32]]:
    return {name: values.astype(np.float32) for name, values in load_file(str(WEIGHTS)).items()}


class LighterGlue:
    """The matcher, compiled when it is first asked. Threads take turns."""

    def __init__(self, threads: int = 0, precision: str = "float32", folder: Path | None = None) -> None:
        """Threads and precision as in Config; `folder` is for what is compiled."""
        kept = None if folder is None else folder / f"lighterglue_{_GRAPH}_{MOST}"
        self._compile = cache(lambda: Compiled(_graph, threads, precision, kept))

    def matches(
        self, query: LocalFeatures, query_aspect: float, reference: LocalFeatures, reference_aspect: float
    ) -> tuple[Indices, Indices, NDArray[np.float32]]:
        """Numbers of matched features (query, reference), (M,) each, and how probable each match is.

        An aspect is height / width of an image. Of more than MOST features the first are looked at.
        """
        count = [min(len(image.points), MOST) for image in (query, reference)]
        if not min(count):
            return np.empty(0, np.int64), np.empty(0, np.int64), np.empty(0, np.float32)
        points = np.zeros((2, MOST, 2), np.float32)
        descriptors = np.zeros((2, MOST, _DESCRIPTOR), np.float32)
        absent = np.full((2, 1, MOST), _ABSENT, np.float32)
        for number, (image, aspect) in enumerate(((query, query_aspect), (reference, reference_aspect))):
            own = slice(count[number])
            points[number, own] = (image.points[own] - (0.5, aspect / 2)) * (2 / max(1.0, aspect))
            descriptors[number, own], absent[number, 0, own] = image.descriptors[own], 0.0
        (probability,) = self._compile()(points, descriptors, absent)
        probability = np.ascontiguousarray(probability[0, : count[0], : count[1]])
        r, q = mutual_maxima(probability)
        found = probability[q, r]
        sure = found > _LEAST
        return q[sure], r[sure], found[sure]


lighterglue = cache(LighterGlue)
"""The one with these settings that the whole process shares: a fleet's lanes have judges of their own."""


def _graph() -> ov.Model:
    """(2, N, 2) points about the middle of their image in halves of its longer side, unit descriptors (2, N, 64),
    (2, 1, N) zero, or _ABSENT -> (1, N, N) probability that two features are one point.
    """
    points, descriptors, absent = (
        ops.parameter(shape, np.float32) for shape in ([2, MOST, 2], [2, MOST, _DESCRIPTOR], [2, 1, MOST])
    )
    x = _linear(descriptors, "input_proj")
    angle = ops.matmul(points, constant(_weights()["posenc.Wr.weight"]), False, True)
    turn = ops.cos(angle), ops.sin(angle)
    for layer in range(LAYERS):
        ours, other = f"transformers.{layer}.self_attn", f"transformers.{layer}.cross_attn"
        x = _attended(x, ours, _self(x, ours, turn, absent), "out_proj")
        x = _attended(x, other, _cross(x, other, absent), "to_out")
    name = f"log_assignment.{LAYERS - 1}"
    ours, theirs = _halves(_linear(x, f"{name}.final_proj", scale=_CHANNELS**-0.25), 0)
    similarity = ops.matmul(ours, theirs, False, True)
    matchable, partner = _halves(ops.sigmoid(_linear(x, f"{name}.matchability")), 0)
    row, column = _halves(absent, 0)
    forward = ops.softmax(ops.add(similarity, column), 2)
    backward = ops.softmax(ops.add(similarity, _transposed(row)), 1)
    both = ops.multiply(ops.multiply(forward, backward), ops.multiply(matchable, _transposed(partner)))
    return ov.Model([both], [points, descriptors, absent], "lighterglue")


def _self(x: Node, name: str, turn: tuple[Node, Node], absent: Node) -> Node:
    """What each feature hears of its own image, positions by rotation. Even and odd channels are turned as pairs; to
    have them in two halves instead changes no product.
    """
    channels = np.arange(_CHANNELS)
    halves = np.concatenate([channels[::2], channels[1::2]])
    query = _turned(_linear(x, f"{name}.Wqkv", 3 * halves, _CHANNELS**-0.5), turn)
    key = _turned(_linear(x, f"{name}.Wqkv", 3 * halves + 1), turn)
    heard = ops.softmax(ops.add(ops.matmul(query, key, False, True), absent), 2)
    return ops.matmul(heard, _linear(x, f"{name}.Wqkv", 3 * channels + 2), False, False)


def _cross(x: Node, name: str, absent: Node) -> Node:
    """What each feature hears of the other image."""
    key = _linear(x, f"{name}.to_qk", scale=_CHANNELS**-0.25)
    heard = ops.softmax(ops.add(ops.matmul(key, _exchanged(key), False, True), _exchanged(absent)), 2)
    return ops.matmul(heard, _exchanged(_linear(x, f"{name}.to_v")), False, False)


def _attended(x: Node, name: str, heard: Node, projection: str) -> Node:
    """Each feature with what it heard taken in."""
    weights = _weights()
    both = _linear(ops.concat([x, _linear(heard, f"{name}.{projection}")], 2), f"{name}.ffn.0")
    normal = ops.mvn(both, integers(2), True, _EPSILON, "inside_sqrt")
    gain, offset = (constant(weights[f"{name}.ffn.1.{kind}"]) for kind in ("weight", "bias"))
    return ops.add(x, _linear(ops.gelu(ops.add(ops.multiply(normal, gain), offset), "erf"), f"{name}.ffn.3"))


def _linear(x: Node, name: str, rows: Any = slice(None), scale: float = 1.0) -> Node:
    weight, bias = (_weights()[f"{name}.{kind}"][rows] * np.float32(scale) for kind in ("weight", "bias"))
    return ops.add(ops.matmul(x, constant(weight), False, True), constant(bias))


def _turned(x: Node, turn: tuple[Node, Node]) -> Node:
    cosine, sine = turn
    a, b = _halves(x, 2)
    one = ops.subtract(ops.multiply(a, cosine), ops.multiply(b, sine))
    return ops.concat([one, ops.add(ops.multiply(b, cosine), ops.multiply(a, sine))], 2)


def _halves(x: Node, axis: int) -> list[Node]:
    return list(ops.split(x, ops.constant(np.int64(axis)), 2).outputs())


def _exchanged(x: Node) -> Node:
    return ops.concat(_halves(x, 0)[::-1], 0)


def _transposed(x: Node) -> Node:
    return ops.transpose(x, integers(0, 2, 1))
