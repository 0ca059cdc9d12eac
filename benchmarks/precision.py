"""The default network's arithmetic: what it costs in recall and in time, and the same trunk in other libraries.

    python -m benchmarks.precision --data ../shared/data --train ../shared/train [--quick]
    python -m benchmarks.precision --data ../shared/data --train ../shared/train --first viewpoint tower --draws 4

`--first`: how often the recogniser has a true place first, in float32 and in bfloat16, on sets of benchmarks.closures.
Draw 0 is the images as they are; in each other one every pixel has up to a grey level of noise, the same in both.

Recall@1 by the global vector, by patches and re-ranked on the sets of benchmarks.recall_table, with queries and
references in one precision, and with queries in another one than the map. bfloat16 leaves the trunk's first layers and
what follows the trunk in float32, as the product does. int8: convolutions quantised by NNCF on
training photographs. Times are those of the trunk in turns on one image; ONNX Runtime has no bfloat16 convolutions.
int8 needs nncf, ONNX Runtime onnx and onnxruntime, which the product does not need (pip install 'pnv_ros[benchmarks]');
without them they are left out.
"""

import argparse
import importlib.util
import io
import random
import tempfile
import zlib
from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from benchmarks.closure_sets import FALSE, TRUE, sequence
from benchmarks.closures import judged
from benchmarks.recall_table import described, opened, orders
from benchmarks.run import compared
from pnv_core import Describer, load_describer
from pnv_core.describe.openvino_describing import describing, trunk_maps
from pnv_core.describe.torch_model import TorchTrunk
from pnv_core.networks.openvino_backend import Compiled
from pnv_core.types import LoopClosure, PlaceDescriptor
from pnv_lab.fit import image_files, read_rgb

_DEPTH = 10
_NOT_QUANTISED = ["MatMul", "AvgPool", "Multiply", "Subtract", "Power", "ReduceSum", "NormalizeL2", "SoftMax", "Divide"]


def photographs(describer: Describer, folder: Path, count: int) -> list[NDArray[np.uint8]]:
    """Training photographs at the network's size, drawn."""
    files = image_files([folder])
    return [read_rgb(f, *describer.image_size) for f in random.Random(0).sample(files, min(count, len(files)))]


def int8(graph: Any, inputs: list[tuple]) -> Any:
    """The graph with its convolutions quantised, ranges from these inputs."""
    import nncf

    ignored = nncf.IgnoredScope(types=_NOT_QUANTISED, validate=False)
    samples = nncf.Dataset([dict(enumerate(arrays)) for arrays in inputs])
    return nncf.quantize(
        graph, samples, preset=nncf.QuantizationPreset.MIXED, subset_size=len(inputs), ignored_scope=ignored
    )


def int8_describer(describer: Describer, images: list[NDArray[np.uint8]]) -> Describer:
    """The default describer with a quantised trunk."""
    made = load_describer(trunk_precision="float32", threads=describer.config.threads)
    windows = [(size, 1) for size in made.config.patch_sizes]
    every = np.ones((1, 1, *made.cells), np.float32)
    graph = int8(describing(made.model, made.image_size, windows), [(i[None], every) for i in images])
    made._describing._graph = Compiled(lambda: graph, made.config.threads)  # type: ignore[attr-defined]
    return made


def in_onnxruntime(describer: Describer, threads: int) -> Callable[[], Any]:
    """The trunk in ONNX Runtime, as torch writes it."""
    import onnxruntime

    trunk = TorchTrunk(describer.model.trunk).eval()
    trunk.load_state_dict({n: torch.from_numpy(t) for n, t in describer.model.part("trunk").items()})
    width, height = describer.image_size
    image = torch.rand(1, 3, height, width)
    file = io.BytesIO()
    torch.onnx.export(trunk, (image,), file, dynamo=False)
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")  # as OpenVINO's threads
    session = onnxruntime.InferenceSession(file.getvalue(), options, providers=["CPUExecutionProvider"])
    pixels = {session.get_inputs()[0].name: image.numpy()}
    return lambda: session.run(None, pixels)


def _installed(*names: str) -> bool:
    return all(importlib.util.find_spec(name) is not None for name in names)


def times(describer: Describer, images: list[NDArray[np.uint8]], threads: int, rounds: int) -> None:
    """The trunk of the default model in every library and precision, in turns."""
    model, size, pixels = describer.model, describer.image_size, images[0][None]
    eager = TorchTrunk(model.trunk).eval()
    eager.load_state_dict({n: torch.from_numpy(t) for n, t in model.part("trunk").items()})
    batch = torch.from_numpy(pixels).permute(0, 3, 1, 2).float() / 255
    torch.set_num_threads(threads)
    sides: dict[str, Callable[[], Any]] = {
        "torch eager": lambda: eager(batch),
        "openvino float32": partial(Compiled(partial(trunk_maps, model, size), threads), pixels),
        "openvino bfloat16": partial(Compiled(partial(trunk_maps, model, size, True), threads), pixels),
    }
    if _installed("nncf"):
        graph = int8(trunk_maps(model, size), [(i[None],) for i in images])
        sides["openvino int8"] = partial(Compiled(lambda: graph, threads), pixels)
    if _installed("onnx", "onnxruntime"):
        sides["onnxruntime float32"] = in_onnxruntime(describer, threads)
    with torch.inference_mode():
        compared(f"trunk at {size[0]}x{size[1]}", sides, rounds)


def recalls(describers: dict[str, Describer], args: argparse.Namespace) -> None:
    """Hits at rank one per set, precision and ranking."""
    pairs = [(name, name) for name in describers]
    pairs += [("bfloat16", "float32"), ("float32", "bfloat16")]
    print("queries that are right at rank 1, by the global vector, by patches, and re-ranked")
    print(f"{'set':34}{'queries':>8}  {'queries in, map in':22}{'global':>8}{'patches':>9}{'re-ranked':>11}")
    for part in ("dev", "report"):
        for known in opened(SimpleNamespace(**vars(args), part=part)):  # type: ignore[arg-type]
            made = {n: [described(d, images) for images in (known.queries, known.references)]
                    for n, d in describers.items()}  # fmt: skip
            for asked, kept in pairs:
                found = orders(describers["float32"], made[asked][0], made[kept][1], known, _DEPTH)
                right = [int(np.take_along_axis(known.truth, o[:, :1], 1).sum()) for o in found.values()]
                row = f"{known.name:34}{len(known.queries):8}  {f'{asked}, {kept}':22}"
                print(row + f"{right[0]:8}{right[1]:9}{right[2]:11}", flush=True)


class Noisy:
    """A describer of images with up to a grey level of noise, another for each draw; none for draw 0."""

    def __init__(self, describer: Describer, draw: int) -> None:
        self.config, self.model = describer.config, describer.model
        self.cell, self.grids = describer.cell, describer.grids
        self.fingerprint = f"{draw}_{describer.config.trunk_precision[0]}_{describer.fingerprint}"  # a cache of its own
        self._describer, self._draw = describer, draw

    def describe(self, rgb: NDArray[np.uint8], valid: NDArray[np.bool_] | None = None) -> PlaceDescriptor:
        if self._draw:
            noise = np.random.default_rng((self._draw, zlib.crc32(rgb.tobytes()))).integers(-1, 2, rgb.shape)
            rgb = np.clip(rgb + noise, 0, 255).astype(np.uint8)
        return self._describer.describe(rgb, valid)


def first_places(describers: dict[str, Describer], args: argparse.Namespace) -> None:
    """Queries with a revisit whose first candidate, of those with a known truth, is true."""
    print(f"{'set':12}{'queries':>8}  first place per draw")
    for name in args.first:
        images, rows = sequence(name, args.data.parent), {}
        for precision, describer in describers.items():
            found = [judged(images, Noisy(describer, draw), args.cache) for draw in range(args.draws)]  # type: ignore[arg-type]
            rows[precision] = np.array([[_first(q) for q in f.queries] for f in found])[:, found[0].loops]
        (a, b), queries = rows.values(), rows["float32"].shape[1]
        for precision, right in rows.items():
            print(f"{name:12}{queries:8}  {precision:10}{right.sum(1)}, mean {right.sum(1).mean():.1f}")
        print(f"{'':20}  lost {(a & ~b).sum(1)}, won {(b & ~a).sum(1)}", flush=True)


def _first(query: list[tuple[LoopClosure, int]]) -> bool:
    return next((label == TRUE for _, label in query if label in (TRUE, FALSE)), False)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--train", type=Path, required=True)
    parser.add_argument("--queries", type=int, default=100)
    parser.add_argument("--references", type=int, default=400)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--rounds", type=int, default=30)
    parser.add_argument("--quick", action="store_true", help="times only")
    parser.add_argument("--first", nargs="+", default=[], metavar="SET", help="first places on these sets only")
    parser.add_argument("--draws", type=int, default=1)
    parser.add_argument("--cache", type=Path, default=Path(tempfile.gettempdir()) / "pnv_closures")
    args = parser.parse_args()
    describers = {p: load_describer(trunk_precision=p, threads=args.threads) for p in ("float32", "bfloat16")}
    if args.first:
        first_places(describers, args)
        return
    images = photographs(describers["float32"], args.train, 300)
    times(describers["float32"], images, args.threads, args.rounds)
    if not args.quick:
        if _installed("nncf"):
            describers["int8"] = int8_describer(describers["float32"], images)
        recalls(describers, args)


if __name__ == "__main__":
    main()
