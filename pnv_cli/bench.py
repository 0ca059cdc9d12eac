"""pnv bench [--rate HZ]: times whole frames on this machine, proposes settings for a rate, and runs the proposal."""

import argparse
import itertools
import json
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pnv_cli.common import add_config_flags, config_from
from pnv_cli.progress import bar
from pnv_core.config import Config
from pnv_core.errors import ConfigError
from pnv_core.types import Frame

if TYPE_CHECKING:
    from pnv_core.recognizer import PlaceRecognizer

_SHARES = (1.0, 0.75, 0.5)  # of the size the model was made for; larger ones gain nothing without another model
_SCORERS = ("usac", "rapid")
_CANDIDATES = (50, 25, 10, 5)  # fewer lose places that retrieval ranks lower
_TIMED = (5, 25)  # candidates of the two timings that tell what one costs
_LOAD = 0.7  # share of the time between keyframes; the rest is for receiving, publishing and other processes
_KEYFRAMES = 1000
_MOST_MB = 200.0  # of keyframes, for large ones
_CHECKS = 3  # proposals that are run
_CHECKED = 50  # frames of each, at most
_LONGEST_WAIT_S = 0.2  # between two of them
_JPEG_QUALITY = 90


@dataclass(frozen=True)
class Measured:
    """Median milliseconds of a frame at one image size and scorer, from JPEG to closures.

    `frame_ms` is what does not depend on the candidates; `keyframe_kb` what a keyframe takes.
    """

    width: int
    height: int
    scorer: str
    frame_ms: float
    candidate_ms: float
    keyframe_kb: float

    def total_ms(self, candidates: int) -> float:
        return self.frame_ms + candidates * self.candidate_ms


@dataclass(frozen=True)
class Check:
    """A proposal as it ran: milliseconds of its frames, and whether 95 of 100 were done before the next."""

    median_ms: float
    p95_ms: float
    keeps_up: bool


def add_parser(subparsers: Any) -> None:
    parser = subparsers.add_parser(
        "bench",
        help="how fast this machine is, and which settings keep up with a rate",
        description="Times whole frames (decoding, describing, retrieval, re-ranking, local features) over 1,000 "
        "keyframes, proposes image size, scorer and candidates for a wished rate, and runs the proposal.",
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
    chosen, check = None, None
    for chosen in itertools.islice(proposals(measured, args.rate), _CHECKS):
        check = _run_proposal(_proposed(config, *chosen), images, args.rate)
        if check.keeps_up:
            break
    if args.json:
        proposal = chosen and _as_settings(*chosen)
        report = {"measured": [asdict(m) for m in measured], "rate": args.rate, "proposal": proposal}
        print(json.dumps(report | {"check": check and asdict(check)}))
        return 0
    print(f"{'image':<10}{'scorer':<8}{'frame':>10}{'candidate':>13}{'with 10':>10}{'keyframe':>11}")
    for m in measured:
        times = f"{m.frame_ms:>7.1f} ms{m.candidate_ms:>10.2f} ms{m.total_ms(10):>7.0f} ms"
        print(f"{m.width}x{m.height:<6}{m.scorer:<8}{times}{m.keyframe_kb:>8.0f} kB")
    if chosen is None or check is None:
        fastest = min(m.total_ms(_CANDIDATES[-1]) for m in measured)
        print(f"\nNothing here keeps up with {args.rate:g} Hz; the fastest takes {1000 * _LOAD / fastest:.2f} Hz. Set:")
        slowest_rate = 1000 * _LOAD / fastest
        print(f"  min_interval_s: {1 / slowest_rate:.2f}   (the node drops what it cannot process; it never queues)")
        return 0
    total = chosen[0].total_ms(chosen[1])
    print(
        f"\nFor {args.rate:g} keyframes per second ({total:.0f} ms each, {total * args.rate / 10:.0f} % of the time):"
    )
    for name, value in {"preset": config.preset, **_as_settings(*chosen)}.items():
        print(f"  {name}: {value}")
    verdict = "keeps up" if check.keeps_up else "does NOT keep up: other processes take the time; wish for less"
    print(f"run so: {check.median_ms:.0f} ms a frame, 95 of 100 within {check.p95_ms:.0f} ms: {verdict}")
    return 0


def proposals(measured: Sequence[Measured], rate: float) -> Iterator[tuple[Measured, int]]:
    """Settings within the time, best first: larger images before a geometry before more candidates."""
    within = 1000.0 / rate * _LOAD
    for m in sorted(measured, key=lambda m: (-m.width * m.height, m.scorer == "rapid")):
        yield from ((m, candidates) for candidates in _CANDIDATES if m.total_ms(candidates) <= within)


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
    """Every scorer at one image size."""
    results = []
    for scorer in _SCORERS if config.scorer != "rapid" else (config.scorer,):
        recognizer = filled_recogniser(config.replace(scorer=scorer), images)
        few, many = (_median_ms(_frames(recognizer, images, candidates), seconds) for candidates in _TIMED)
        each = max(many - few, 0.0) / (_TIMED[1] - _TIMED[0])
        kilobytes = recognizer.database.bytes_used / len(recognizer.database) / 1e3
        size = recognizer.describer.image_size
        results.append(Measured(*size, scorer, few - _TIMED[0] * each, each, kilobytes))
    return results


def filled_recogniser(config: Config, images: Sequence[NDArray[np.uint8]]) -> "PlaceRecognizer":
    """For which every frame is a keyframe, over a map of the images' descriptors, slightly turned."""
    from pnv_core.describe.describer import describer_from
    from pnv_core.recognizer import PlaceRecognizer

    recognizer = PlaceRecognizer(describer_from(config.replace(min_interval_s=0.0, min_change=0.0)))
    database, keep = recognizer.database, recognizer.judge.verifier.keep
    known = [recognizer.describer.describe(image) for image in images]
    if config.verify:
        known = [replace(d, thumbnail=keep(image, "0")) for d, image in zip(known, images, strict=True)]
    count = min(_KEYFRAMES, max(_TIMED[1], int(_MOST_MB * 1e6 // database.bytes_per_keyframe(known[0]))))
    rng = np.random.default_rng(0)
    for number in range(count):
        descriptor = known[number % len(known)]
        vector = descriptor.global_vector + rng.normal(0, 0.01, len(descriptor.global_vector)).astype(np.float32)
        database.add(number, "0", replace(descriptor, global_vector=vector / np.linalg.norm(vector)))
    recognizer.new_session()
    database.read_only = True
    return recognizer


def _frames(
    recognizer: "PlaceRecognizer", images: Sequence[NDArray[np.uint8]], candidates: int
) -> Callable[[int], object]:
    """Work on frame i, as the node does it: from JPEG to closures."""
    import cv2

    from pnv_core.images import decode_image

    recognizer.change(candidates=candidates)
    quality = [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY]
    jpegs = [cv2.imencode(".jpg", image[:, :, ::-1], quality)[1].tobytes() for image in images]

    def work(i: int) -> object:
        rgb = decode_image(jpegs[i % len(jpegs)], "frame", enough=recognizer.enough)
        return recognizer.process(Frame(time.monotonic_ns(), "0", rgb))

    return work


def _proposed(config: Config, chosen: Measured, candidates: int) -> Config:
    return config.replace(**_as_settings(chosen, candidates))


def _run_proposal(config: Config, images: Sequence[NDArray[np.uint8]], rate: float) -> Check:
    """Frames at the rate, or somewhat sooner where it is low."""
    work = _frames(filled_recogniser(config, images), images, config.candidates)
    work(0)
    spent: list[float] = []
    period = 1.0 / rate
    for number in range(max(5, min(_CHECKED, int(5 * rate)))):
        begun = time.perf_counter()
        work(number)
        spent.append(time.perf_counter() - begun)
        time.sleep(max(0.0, min(period, _LONGEST_WAIT_S) - spent[-1]))
    median, p95 = np.percentile(spent, (50, 95))
    return Check(1e3 * float(median), 1e3 * float(p95), bool(p95 <= period))


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
