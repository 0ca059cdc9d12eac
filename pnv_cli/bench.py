"""pnv bench [--rate HZ]: a short speed test of this machine, and the settings it can keep up with."""

import argparse
import json
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pnv_cli.common import add_config_flags, config_from
from pnv_cli.progress import bar
from pnv_core.config import Config
from pnv_core.errors import ConfigError

_SHARES = (1.0, 0.75, 0.5)  # of the size the model was made for; larger ones gain nothing without another model
_SCORERS = ("usac", "rapid")
_CANDIDATES = (50, 25, 10, 5, 3)
_LEAST_CANDIDATES = 5  # fewer lose places that retrieval ranks lower
_LOAD = 0.7  # share of the time between keyframes; the rest is for decoding, publishing and other processes
_DATABASE = 2000  # keyframes a search is timed with


@dataclass(frozen=True)
class Measured:
    """Median milliseconds of the stages at one image size and scorer."""

    width: int
    height: int
    scorer: str
    describe_ms: float
    retrieve_ms: float
    candidate_ms: float
    keyframe_kb: float

    def total_ms(self, candidates: int) -> float:
        return self.describe_ms + self.retrieve_ms + candidates * self.candidate_ms


def add_parser(subparsers: Any) -> None:
    parser = subparsers.add_parser(
        "bench",
        help="how fast this machine is, and which settings keep up with a rate",
        description="Times describing and matching, and proposes image size, scorer and candidates for a wished rate.",
        allow_abbrev=False,
    )
    parser.add_argument("--rate", type=float, default=2.0, metavar="HZ", help="wished keyframes per second (default 2)")
    parser.add_argument("--seconds", type=float, default=2.0, help="spent on each measurement (default 2)")
    parser.add_argument("--images", metavar="DIR", help="measure with these images; by default rendered ones")
    parser.add_argument("--json", action="store_true", help="one JSON object instead of a table")
    add_config_flags(parser, sections=("Describing", "Re-ranking"))
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    for name, value in (("--rate", args.rate), ("--seconds", args.seconds)):
        if not 0.001 <= value <= 1000:
            raise ConfigError(f"{name} {value:g} is out of range; allowed: 0.001 to 1000")
    config = config_from(args)
    images = _images(args.images)
    measured: list[Measured] = []
    for width, height in bar(_sizes(config), desc="timing", unit="size", leave=False):
        measured += _measure(config.replace(image_width=width, image_height=height), images, args.seconds)
    best = proposal(measured, args.rate)
    if args.json:
        held = [m.__dict__ for m in measured]
        print(json.dumps({"measured": held, "rate": args.rate, "proposal": best and _as_settings(*best)}))
        return 0
    print(f"{'image':<10}{'scorer':<8}{'describe':>10}{'retrieve':>10}{'candidate':>11}{'with 10':>10}{'keyframe':>11}")
    for m in measured:
        times = f"{m.describe_ms:>7.1f} ms{m.retrieve_ms:>7.1f} ms{m.candidate_ms:>8.2f} ms{m.total_ms(10):>7.0f} ms"
        print(f"{m.width}x{m.height:<6}{m.scorer:<8}{times}{m.keyframe_kb:>8.0f} kB")
    if best is None:
        fastest = min(m.total_ms(_LEAST_CANDIDATES) for m in measured)
        print(f"\nNothing here keeps up with {args.rate:g} Hz; the fastest takes {1000 * _LOAD / fastest:.2f} Hz. Set:")
        slowest_rate = 1000 * _LOAD / fastest
        print(f"  min_interval_s: {1 / slowest_rate:.2f}   (the node drops what it cannot process; it never queues)")
        return 0
    chosen, candidates = best
    total = chosen.total_ms(candidates)
    print(
        f"\nFor {args.rate:g} keyframes per second ({total:.0f} ms each, {total * args.rate / 10:.0f} % of the time):"
    )
    for name, value in {"preset": config.preset, **_as_settings(chosen, candidates)}.items():
        print(f"  {name}: {value}")
    return 0


def proposal(measured: Sequence[Measured], rate: float) -> tuple[Measured, int] | None:
    """The setting to take: larger images before RANSAC before more candidates, all within the time."""
    within = 1000.0 / rate * _LOAD
    ranked = sorted(measured, key=lambda m: (-m.width * m.height, m.scorer == "rapid"))
    for m in ranked:
        for candidates in _CANDIDATES:
            if candidates >= _LEAST_CANDIDATES and m.total_ms(candidates) <= within:
                return m, candidates
    return None


def _as_settings(chosen: Measured, candidates: int) -> dict[str, Any]:
    return {
        "image_width": chosen.width,
        "image_height": chosen.height,
        "scorer": chosen.scorer,
        "candidates": candidates,
    }


def _sizes(config: Config) -> list[tuple[int, int]]:
    """The size the user named, or the model's and smaller ones that still hold its patches."""
    from pnv_core.describe.describer import describer_from

    describer = describer_from(config)
    done, cell = describer.config, describer.cell
    own = (done.image_width, done.image_height)
    if config.image_width and config.image_height:
        return [own]
    sizes = [(int(own[0] * s) // cell * cell, int(own[1] * s) // cell * cell) for s in _SHARES]
    return [s for s in sizes if min(s) >= cell * (max(done.patch_sizes) + 1)] or [own]


def _images(folder: str | None) -> list[NDArray[np.uint8]]:
    """A few views of one place and of others."""
    if folder is not None:
        from pnv_core.images import list_images, read_image

        return [read_image(p) for p in list_images(folder)[:8]]
    from pnv_lab.worlds import World

    world = World(0, "street")
    return [world.render(world.pose_on_route(m), size=(640, 480)) for m in (0.0, 0.5, 10.0, 20.0)]


def _measure(config: Config, images: Sequence[NDArray[np.uint8]], seconds: float) -> list[Measured]:
    """Both scorers at one image size."""
    from pnv_core.describe.describer import describer_from
    from pnv_core.verify.reranker import Reranker

    describer = describer_from(config)
    described = [describer.describe(image) for image in images]
    describe = _median_ms(lambda i: describer.describe(images[i % len(images)]), seconds)
    rng = np.random.default_rng(0)
    stored = rng.normal(size=(_DATABASE, describer.model.global_dim)).astype(np.float32)
    retrieve = _median_ms(
        lambda i: np.argpartition(stored @ described[i % len(images)].global_vector, -10), seconds / 8
    )
    bytes_per_value = {"float32": 4, "float16": 2, "int8": 1}[describer.config.patch_precision]
    patches = sum(g.rows * g.cols for g in described[0].patches)
    kilobytes = (patches * describer.model.patch_dim * bytes_per_value + 4 * describer.model.global_dim) / 1e3
    results = []
    pairs = [(a, b) for a in range(len(images)) for b in range(len(images)) if a != b]
    scorers = _SCORERS if config.scorer != "rapid" else (config.scorer,)
    for scorer in scorers:
        reranker = Reranker(describer.config.replace(scorer=scorer))

        def score(i: int, reranker: Reranker = reranker) -> object:
            a, b = pairs[i % len(pairs)]
            return reranker.score(described[a], described[b])

        one = _median_ms(score, seconds) if pairs else float("nan")
        results.append(Measured(*describer.image_size, scorer, describe, retrieve, one, kilobytes))
    return results


def _median_ms(work: Callable[[int], object], seconds: float) -> float:
    """Median milliseconds of work(i), repeated for a while; the first call is not counted."""
    work(0)
    spent: list[float] = []
    start = time.perf_counter()
    while len(spent) < 3 or time.perf_counter() - start < seconds:
        before = time.perf_counter()
        work(len(spent))
        spent.append(time.perf_counter() - before)
    return float(np.median(spent)) * 1e3
