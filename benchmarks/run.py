"""The benchmarks: product against a plain implementation of the authors' formulation, alternating in one process.

python -m benchmarks.run [--rounds N] [--threads N] [--out DIR]    prints a table, writes DIR/benchmarks.json and plots

Every row is the median over rounds in which both sides took turns, so that a busy machine burdens both; the processor
time of both is given beside the wall time. A row of the machine says what a large product and a large copy reach; where
a row's arithmetic is counted, the last column says which share of that its side reaches (1.0: the physical limit).
"""

import argparse
import json
import platform
import time
from collections.abc import Callable
from copy import deepcopy
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np

import pnv_core.openmp  # noqa: F401 - before torch is loaded  # isort: skip
import openvino as ov
import torch
import torch.nn.functional as F

from benchmarks import baseline
from benchmarks.growth import measured_growth, plotted
from pnv_core.config import Config
from pnv_core.describe.describer import load_describer
from pnv_core.describe.model_files import Model, ModelInfo, build_model
from pnv_core.describe.openvino_describing import head
from pnv_core.describe.patches import patch_descriptors
from pnv_core.describe.torch_model import TorchTrunk
from pnv_core.describe.trunks.lite import lite_trunk
from pnv_core.describe.trunks.trunk import Trunk
from pnv_core.describe.trunks.vgg16 import vgg16_trunk
from pnv_core.files import atomic_write
from pnv_core.networks.layers import Add, Block, Concat, Conv, Network, Shape, shape_after
from pnv_core.networks.openvino_backend import Compiled, build, fast_precisions, image_input
from pnv_core.threads import workers
from pnv_core.types import PatchGrid, PlaceDescriptor
from pnv_core.verify.homography import homography_inliers
from pnv_core.verify.reranker import Reranker

SIZES, WEIGHTS = (2, 5, 8), (0.45, 0.15, 0.4)
CELLS = (30, 40)  # of 640x480
CHANNELS = 512


def timed(function: Callable[[], Any]) -> tuple[float, float]:
    """Wall and processor milliseconds of one call."""
    wall, cpu = time.perf_counter(), time.process_time()
    function()
    return (time.perf_counter() - wall) * 1e3, (time.process_time() - cpu) * 1e3


def compared(name: str, sides: dict[str, Callable[[], Any]], rounds: int) -> dict[str, Any]:
    """One row: the median milliseconds of each side over rounds in which they take turns, and ratios to the first."""
    for side, function in sides.items():
        if side != "baseline":
            function()  # compiles and allocates
    taken: dict[str, list[tuple[float, float]]] = {side: [] for side in sides}
    for _ in range(rounds):
        for side, function in sides.items():
            taken[side].append(timed(function))
    first = next(iter(sides))
    medians = {side: np.median(times, axis=0) for side, times in taken.items()}
    ratios = {
        side: np.median([np.divide(a, b) for a, b in zip(taken[first], times, strict=True)], axis=0)
        for side, times in taken.items()
    }
    row = {"name": name, "rounds": rounds, "sides": {}}
    for side in sides:
        row["sides"][side] = {
            "ms": round(float(medians[side][0]), 2),
            "cpu_ms": round(float(medians[side][1]), 2),
            "ratio": round(float(ratios[side][0]), 2),
            "cpu_ratio": round(float(ratios[side][1]), 2),
        }
    print(row_text(row), flush=True)
    return row


def row_text(row: dict[str, Any]) -> str:
    parts = [
        f"{s} {v['ms']:.1f} ms ({v['ratio']:.1f}x; processor {v['cpu_ms']:.1f} ms, {v['cpu_ratio']:.1f}x)"
        for s, v in row["sides"].items()
    ]
    return f"{row['name']}: " + ", ".join(parts)


def smooth_features(rng: np.random.Generator, cells: tuple[int, int], channels: int) -> torch.Tensor:
    """(1, C, h, w): features whose neighbours resemble one another, as those of a network do."""
    coarse = torch.from_numpy(rng.standard_normal((1, channels, 5, 6), np.float32))
    fine = torch.from_numpy(rng.standard_normal((1, channels, *cells), np.float32))
    return F.interpolate(coarse, cells, mode="bicubic") + 0.5 * fine


def vocabulary(rng: np.random.Generator, clusters: int, dim: int) -> tuple[torch.Tensor, ...]:
    """Random centroids (K, C), assignment (K, C), projection (D, K * C), bias (D,)."""
    centroids = F.normalize(torch.from_numpy(rng.standard_normal((clusters, CHANNELS), np.float32))) * 0.3
    projection = torch.from_numpy(rng.standard_normal((dim, clusters * CHANNELS), np.float32)) / 8
    return (
        centroids,
        F.normalize(centroids) * 40,
        projection,
        torch.from_numpy(rng.standard_normal(dim, np.float32)) / 50,
    )


def patches_row(clusters: int, dim: int, threads: int, rounds: int) -> dict[str, Any]:
    rng = np.random.default_rng(0)
    features = smooth_features(rng, CELLS, CHANNELS)
    centroids, assignment, projection, bias = vocabulary(rng, clusters, dim)
    trunk = {f"trunk.{name}": np.zeros(shape) for name, shape in vgg16_trunk().tensor_shapes().items()}
    tensors = {
        "netvlad.centroids": centroids,
        "netvlad.assignment": assignment,
        "global_projection.weight": projection,
        "global_projection.bias": bias,
    }
    model = build_model(ModelInfo("vgg16"), trunk | {name: t.numpy() for name, t in tensors.items()}, "benchmark")
    graph = Compiled(lambda: head(model, CELLS, [(size, 1) for size in SIZES]), threads)
    maps, cells = features.numpy(), np.ones((1, 1, *CELLS), np.float32)

    def eager() -> list[torch.Tensor]:
        x = F.normalize(features[0].flatten(1), dim=0)
        weights = torch.softmax(assignment @ x, dim=0)
        return patch_descriptors(x, weights, centroids, projection, bias, CELLS, SIZES, (1, 1, 1))

    def plain() -> list[torch.Tensor]:
        return baseline.patch_descriptors(features, assignment, centroids, projection, bias, SIZES)

    row = compared(
        f"patches 2, 5, 8 at 640x480, K={clusters}, D={dim}",
        {"baseline": plain, "openvino": lambda: graph(maps, maps, cells), "torch": eager},
        rounds,
    )
    return row | {"gflop": 2e-9 * clusters * (dim + 1) * CHANNELS * CELLS[0] * CELLS[1]}


def places(rng: np.random.Generator, count: int, dim: int) -> list[PlaceDescriptor]:
    """Patch grids of 640x480: the first two show one place with noise, the others places of their own."""
    found = []
    shared = rng.standard_normal((*CELLS, dim)).astype(np.float32)
    for number in range(count):
        own = shared if number < 2 else rng.standard_normal((*CELLS, dim)).astype(np.float32)
        cells = torch.from_numpy(own + 0.7 * rng.standard_normal(own.shape).astype(np.float32)).permute(2, 0, 1)
        grids = []
        for size in SIZES:
            rows = F.normalize(F.avg_pool2d(cells, size, 1).flatten(1).T, dim=1).numpy().astype(np.float16)
            grids.append(PatchGrid(size, CELLS[0] - size + 1, CELLS[1] - size + 1, rows))
        found.append(PlaceDescriptor(np.zeros(dim, np.float32), tuple(grids)))
    return found


def plain_reranking(query: PlaceDescriptor, references: list[PlaceDescriptor], scorer: str) -> list[float]:
    """One candidate and one patch size at a time; larger is better."""
    scores = []
    for reference in references:
        total = 0.0
        for q, r, weight in zip(query.patches, reference.patches, WEIGHTS, strict=True):
            ours, theirs = (torch.from_numpy(g.descriptors.astype(np.float32).T.copy()) for g in (q, r))
            matched_q, matched_r = baseline.mutual_matches(ours, theirs)
            if scorer == "rapid":
                total -= weight * baseline.rapid_score(q.indices()[matched_q], r.indices()[matched_r], q.rows, q.cols)
            else:
                total -= weight * baseline.ransac_score(
                    q.keypoints()[matched_q], r.keypoints()[matched_r], q.rows * q.cols
                )
        scores.append(total)
    return scores


def reranking_row(dim: int, scorer: str, candidates: int, threads: int, rounds: int) -> dict[str, Any]:
    query, *references = places(np.random.default_rng(1), candidates + 1, dim)
    sides: dict[str, Callable[[], Any]] = {"baseline": lambda: plain_reranking(query, references, scorer)}
    settings = Config.make(
        patch_sizes=SIZES,
        patch_strides=(1, 1, 1),
        patch_weights=WEIGHTS,
        scorer=scorer,
        threads=threads,
    )
    sides["product"] = partial(Reranker(settings).scores, query, references)
    return compared(f"re-ranking {candidates} candidates, sizes 2, 5, 8, {scorer}, D={dim}", sides, rounds)


def homography_row(share: float, rounds: int, matches: int = 140) -> dict[str, Any]:
    """OpenCV's RANSAC and ours on matches of a grid, a share of which are shifted alike and the others random."""
    rng = np.random.default_rng(0)
    grid = np.stack(np.meshgrid(np.arange(23), np.arange(17)), -1).reshape(-1, 2) * 16 + 15.5
    source, target = (grid[rng.permutation(len(grid))[:matches]].astype(np.float32) for _ in range(2))
    agreeing = int(share * matches)
    target[:agreeing] = source[:agreeing] + np.float32([16, 0])
    sides: dict[str, Callable[[], Any]] = {
        "baseline": lambda: cv2.findHomography(source, target, cv2.RANSAC, 24.0),
        "product": lambda: homography_inliers(source, target, 24.0),
    }
    return compared(f"homography of {matches} matches, {share:g} of them inliers", sides, rounds)


def gflop(network: Network, shape: Shape) -> float:
    """Multiplications and additions of the convolutions for an image of (channels, height, width)."""
    total = 0.0
    for layer in network:
        after = shape_after((layer,), shape)
        match layer:
            case Conv(kernel=k, groups=groups):
                total += 2e-9 * np.prod(after) * k * k * shape[0] / groups
            case Block(layers=layers):
                total += gflop(layers, shape)
            case Add(branches=branches) | Concat(branches=branches):
                total += sum(gflop(branch, shape) for branch in branches)
        shape = after
    return float(total)


def trunk_gflop(trunk: Trunk, size: tuple[int, int]) -> float:
    """Of all its parts, for an image of (width, height)."""
    shape = 3, size[1], size[0]
    wide = shape_after(trunk.layers, shape)
    return gflop(trunk.layers, shape) + gflop(trunk.neck, wide) + gflop(trunk.deep, wide)


def describing_gflop(model: Model, size: tuple[int, int]) -> float:
    """Of the trunk, the assignment and the projection of the patches' residuals."""
    _, h, w = model.trunk.shape(*size)
    heads = 2e-9 * h * w * model.trunk.channels * model.clusters * (1 + model.patch_dim)
    return trunk_gflop(model.trunk, size) + heads


def trunk_row(name: str, trunk: Trunk, size: tuple[int, int], threads: int, rounds: int) -> dict[str, Any]:
    torch.manual_seed(0)
    eager = TorchTrunk(trunk).eval().requires_grad_(False)
    for parameter in eager.parameters():
        if parameter.ndim == 4:
            torch.nn.init.kaiming_normal_(parameter)
    weights = {name: tensor.numpy() for name, tensor in eager.state_dict().items()}
    rgb = np.random.default_rng(0).integers(0, 256, (1, *size, 3), np.uint8)
    image = torch.from_numpy(rgb[0]).permute(2, 0, 1)[None].float() / 255
    packed = image.contiguous(memory_format=torch.channels_last)
    channels_last = deepcopy(eager).to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    sides: dict[str, Callable[[], Any]] = {
        "baseline": lambda: eager.maps(image),
        "channels last": lambda: channels_last.maps(packed),
    }
    for precision, said in (("float32", "FP32"), ("bfloat16", "BF16")):
        if said in fast_precisions():
            pixels, scaled = image_input(size[1], size[0])
            wide = build(trunk.layers, weights, scaled)
            outputs = [build(after, weights, wide) for after in (trunk.neck, trunk.deep) if after] or [wide]
            compiled = Compiled(partial(ov.Model, outputs, [pixels], name), threads, precision)
            sides[f"openvino {precision}"] = partial(compiled, rgb)
    row = compared(f"{name} at {size[1]}x{size[0]}", sides, rounds)
    return row | {"gflop": trunk_gflop(trunk, (size[1], size[0]))}


def describing_row(size: tuple[int, int], threads: int, rounds: int) -> dict[str, Any]:
    """Describer.describe of the default model: torch, and OpenVINO in both precisions."""
    rgb = np.random.default_rng(0).integers(0, 256, (size[1], size[0], 3), np.uint8)
    sides = {}
    for backend, precision in (("torch", "float32"), ("openvino", "float32"), ("openvino", "bfloat16")):
        describer = load_describer(
            image_width=size[0], image_height=size[1], threads=threads, backend=backend, trunk_precision=precision,
            verify=0,
        )  # fmt: skip
        sides[f"{backend} {precision}"] = partial(describer.describe, rgb)
    row = compared(f"describe() at {size[0]}x{size[1]}", sides, rounds)
    return row | {"gflop": describing_gflop(describer.model, size)}


def roofline(threads: int) -> dict[str, Any]:
    """What this machine reaches in this run: GFLOP/s of large products, GB/s of a large copy (read and written)."""
    n = 2048
    a = torch.randn(n, n)
    half, byte = a.bfloat16(), torch.randint(-100, 100, (n, n), dtype=torch.int8)
    source = np.ones(1 << 26, np.float32)
    target = np.empty_like(source)
    parts = [(i * len(source) // threads, (i + 1) * len(source) // threads) for i in range(threads)]

    def copy() -> None:
        workers(threads).map(lambda p: np.copyto(target[p[0] : p[1]], source[p[0] : p[1]]), parts)

    def best(function: Callable[[], Any]) -> float:
        return min(timed(function)[0] for _ in range(5)) / 1e3

    found = {
        "float32_gflops": 2 * n**3 / best(lambda: a @ a) / 1e9,
        "bfloat16_gflops": 2 * n**3 / best(lambda: half @ half) / 1e9,
        "int8_gops": 2 * n**3 / best(lambda: torch._int_mm(byte, byte)) / 1e9,
        "copy_gbytes": 2 * source.nbytes / best(copy) / 1e9,
    }
    print("machine: " + ", ".join(f"{name} {value:.0f}" for name, value in found.items()), flush=True)
    return {name: round(value, 1) for name, value in found.items()}


def machine() -> dict[str, Any]:
    text = Path("/proc/cpuinfo").read_text() if Path("/proc/cpuinfo").exists() else ""
    model = next(
        (line.split(":", 1)[1].strip() for line in text.splitlines() if line.startswith("model name")),
        platform.processor(),
    )
    return {"processor": model, "cores": torch.get_num_threads(), "torch": torch.__version__, "numpy": np.__version__}


def table(rows: list[dict[str, Any]], peak: dict[str, float]) -> str:
    lines = [
        "| what | " + " | ".join(["side", "ms", "ratio", "processor ms", "processor ratio", "of the limit"]) + " |",
        "|---|---|---:|---:|---:|---:|---:|",
    ]
    for row in rows:
        for side, v in row["sides"].items():
            figures = [f"{v[key]:.1f}" for key in ("ms", "ratio", "cpu_ms", "cpu_ratio")]
            most = peak["bfloat16_gflops" if "bfloat16" in side else "float32_gflops"]
            share = f"{row['gflop'] / most / v['ms'] * 1e3:.2f}" if "gflop" in row and side != "baseline" else ""
            lines.append("| " + " | ".join([row["name"], side, *figures, share]) + " |")
    return "\n".join(lines)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--out", type=Path, default=Path("out/benchmarks"))
    parser.add_argument("--quick", action="store_true", help="one row of each kind, no growth")
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    with torch.inference_mode():
        peak = roofline(args.threads)
        settings = [(16, 512)] if args.quick else [(16, 512), (64, 512), (16, 4096)]
        rows = [patches_row(k, d, args.threads, args.rounds) for k, d in settings]
        count = 10 if args.quick else 100
        rows.append(reranking_row(512, "rapid", count, args.threads, 1 if args.quick else args.rounds))
        rows += [homography_row(share, 5 * args.rounds) for share in (0.0, 0.2, 0.4, 0.6, 0.8)]
        for scorer in ("ransac", "usac"):
            rows.append(reranking_row(128, scorer, count, args.threads, 1 if args.quick else args.rounds))
        rows.append(trunk_row("lite trunk", lite_trunk(0, deep=True), (288, 384), args.threads, 5 * args.rounds))
        sizes = ((384, 288),) if args.quick else ((320, 240), (384, 288), (640, 480))
        rows += [describing_row(size, args.threads, 5 * args.rounds) for size in sizes]
        if not args.quick:
            rows.append(trunk_row("VGG16", vgg16_trunk(), (480, 640), args.threads, args.rounds))
        growth = {} if args.quick else measured_growth(args.threads)
    report = {"machine": machine(), "roofline": peak, "rows": rows, "growth": growth}
    args.out.mkdir(parents=True, exist_ok=True)
    with atomic_write(args.out / "benchmarks.json") as file:
        file.write((json.dumps(report, indent=1) + "\n").encode())
    if growth:
        plotted(growth, args.out / "growth.png")
    print(table(rows, peak))
    print(f"written to {args.out}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
