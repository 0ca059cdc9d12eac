"""A frame of the default recogniser, stage by stage, over 1,000 keyframes with 10 candidates and local features.

    python -m benchmarks.stages [--frames N] [--images DIR] [NAME=VALUE ...]

Wall and processor milliseconds, means, in one process without ROS: what the node does between taking a message and
publishing. `look` is describing and features at once, each of which is also timed by itself; `rest` is what no stage
has: keyframe selection, consistency. The last row has the frames one after another as the node has them: one is looked
at while the one before is looked up. The last column is the time that the stage's multiplications and additions would
take at the rate of a large product in the same run.
"""

import argparse
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import yaml

from benchmarks.live_node import pictures
from benchmarks.run import describing_gflop, machine, roofline
from msg_adapters.images import message_to_frame
from pnv_cli.bench import filled_recogniser
from pnv_core.config import Config
from pnv_core.describe.describer import resized, texture
from pnv_core.recognizer import PlaceRecognizer, Seen
from pnv_core.timing import StageTimer

_STAGES = ("retrieve", "rerank")  # rerank compares the features, too


def means(functions: dict[str, Callable[[int], Any]], frames: int) -> dict[str, tuple[float, float]]:
    """Wall and processor milliseconds of each, in turns."""
    taken: dict[str, list[tuple[float, float]]] = {name: [] for name in functions}
    for number in range(-3, frames):
        for name, function in functions.items():
            wall, cpu = time.perf_counter(), time.process_time()
            function(number)
            spent = time.perf_counter() - wall, time.process_time() - cpu
            if number >= 0:
                taken[name].append(spent)
    return {name: tuple(1e3 * np.mean(times, axis=0)) for name, times in taken.items()}  # type: ignore[misc]


def flowing(recognizer: PlaceRecognizer, look: Callable[[int], Seen | None], frames: int) -> tuple[float, float]:
    """Wall and processor milliseconds a frame, of a row of them in two threads."""
    with ThreadPoolExecutor(1) as second:
        begun: Future[Any] | None = None
        wall, cpu = time.perf_counter(), time.process_time()
        for number in range(frames):
            seen = look(number)
            if begun is not None:
                begun.result()
            assert seen is not None
            begun = second.submit(recognizer.recognise, seen)
    return 1e3 * (time.perf_counter() - wall) / frames, 1e3 * (time.process_time() - cpu) / frames


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--images", type=Path)
    parser.add_argument("parameters", nargs="*", metavar="NAME=VALUE")
    args = parser.parse_args()
    given = {name: yaml.safe_load(value) for name, value in (item.split("=", 1) for item in args.parameters)}
    config = Config.make(**given)
    images = pictures(args.images, 640, 480)
    recognizer = filled_recogniser(config, images)
    describer, header = recognizer.describer, SimpleNamespace(stamp=SimpleNamespace(sec=0, nanosec=0))
    raw, jpeg, inputs = [], [], []
    for rgb in images:
        step = {"height": 480, "width": 640, "step": 3 * 640, "is_bigendian": 0}
        raw.append(SimpleNamespace(header=header, encoding="rgb8", data=rgb.tobytes(), **step))
        data = cv2.imencode(".jpg", rgb[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, 90])[1].tobytes()
        jpeg.append(SimpleNamespace(header=header, format="jpeg", data=data))
        inputs.append(resized(rgb, *describer.image_size))
    keep = recognizer.judge.verifier.keep
    timers = {"wall": StageTimer(time.perf_counter), "cpu": StageTimer(time.process_time)}

    def process(number: int, clock: str = "wall") -> None:
        recognizer.timer = timers[clock]
        recognizer.keyframes.forget()
        recognizer.process(message_to_frame(raw[number % len(raw)], "0"))

    def look(number: int) -> Seen | None:
        recognizer.timer = StageTimer()
        recognizer.keyframes.forget()
        return recognizer.look(message_to_frame(raw[number % len(raw)], "0"))

    together = flowing(recognizer, look, args.frames)  # first: after the stages by themselves it takes longer
    found = means(
        {
            "decode raw": lambda i: message_to_frame(raw[i % len(raw)], "0"),
            "decode JPEG": lambda i: message_to_frame(jpeg[i % len(jpeg)], "0", recognizer.enough),
            "resize": lambda i: resized(images[i % len(images)], *describer.image_size),
            "network": lambda i: describer._describing.describe(inputs[i % len(inputs)]),
            "texture": lambda i: texture(inputs[i % len(inputs)]),
            "features": lambda i: keep(images[i % len(images)], "0"),
            "decode raw, look": look,
            "whole frame, raw": process,
            "again": lambda i: process(i, "cpu"),
        },
        args.frames,
    )
    for stage in (s for s in _STAGES if s in timers["cpu"].durations):
        found[stage] = tuple(1e3 * float(np.mean(timers[c].durations[stage])) for c in ("wall", "cpu"))  # type: ignore
    parts = ("decode raw, look", *(s for s in _STAGES if s in found))
    whole = found["whole frame, raw"]
    found["rest"] = tuple(whole[i] - sum(found[p][i] for p in parts) for i in (0, 1))  # type: ignore[assignment]
    found["one after another"] = together
    peak = roofline(config.threads or 1)["float32_gflops"]
    limit = {"network": 1e3 * describing_gflop(describer.model, describer.image_size) / peak}
    print(f"{machine()}\n| stage | ms | processor ms | at the limit |\n|---|---:|---:|---:|")
    alone = ("decode JPEG", "decode raw", "resize", "network", "texture", *["features"] * bool(config.verify))
    for name in (*alone, *parts, "rest", "whole frame, raw", "one after another"):
        least = f"{limit[name]:.1f} ms" if name in limit else ""
        print(f"| {name} | {found[name][0]:.1f} | {found[name][1]:.1f} | {least} |")


if __name__ == "__main__":
    main()
