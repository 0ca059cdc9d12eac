"""pnv run --images DIR | --video FILE | --bag DIR  --csv OUT.csv [--all]"""

import argparse
import csv
import io
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from tqdm import tqdm

from pnv_cli.common import add_config_flags, config_from, writable
from pnv_cli.sources import add_source_flags, source_of
from pnv_core.decide.calibration import CONSERVATIVE
from pnv_core.describe.describer import describer_from
from pnv_core.errors import ConfigError, PnvError
from pnv_core.files import atomic_write
from pnv_core.recognizer import PlaceRecognizer
from pnv_core.timing import StageTimer
from pnv_core.types import LoopClosure

if TYPE_CHECKING:
    from pnv_lab.evaluation.run_report import RunRecorder

COLUMNS = (
    "query",
    "match",
    "query_stamp",
    "match_stamp",
    "score",
    "similarity",
    "spatial",
    "inliers",
    "accepted",
    "reason",
)

Names = dict[tuple[str, int], str]  # of a frame, by camera and stamp


def add_parser(subparsers: argparse._SubParsersAction) -> None:
    parser = subparsers.add_parser("run", help="loop closures of a sequence", allow_abbrev=False)
    add_source_flags(parser)
    parser.add_argument("--csv", required=True, metavar="OUT.csv", help="one row per accepted closure")
    parser.add_argument("--all", action="store_true", help="also the best candidate of every query without a closure")
    parser.add_argument("--report", metavar="FILE.html", help="scores, pictures and path of the run as one page")
    parser.add_argument("--poses", metavar="CSV", help="positions for the report: columns timestamp,x,y,z")
    parser.add_argument("--timing", action="store_true", help="print the time of each stage")
    add_config_flags(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    output = writable(args.csv)
    report = writable(args.report) if args.report else None
    if args.poses and not report:
        raise ConfigError("--poses is shown in the report; allowed: together with --report FILE.html")
    config = config_from(args)
    source = source_of(args)
    timer = StageTimer(time.perf_counter)
    recognizer = PlaceRecognizer(describer_from(config), timer=timer)
    if recognizer.judge.calibration is CONSERVATIVE:
        print("pnv: no calibration fits this model and these settings: a conservative score decides", file=sys.stderr)
    recorder = _recorder(recognizer) if report else None
    names: Names = {}
    rows: list[dict] = []
    done = 0
    try:
        for name, frame in tqdm(
            source.frames, total=source.count or None, unit="frame", disable=not sys.stderr.isatty()
        ):
            names[frame.camera, frame.stamp_ns] = name
            closures = recognizer.process(frame)
            rows += [_row(c, names) for c in _reported(closures, args.all)]
            if recorder:
                recorder.add(name, frame, closures)
            done += 1
    finally:  # an interrupted run keeps what it found
        _write(output, rows)
    if not done:
        raise PnvError("no frame of the input could be read")
    if recorder and report:
        _write_report(report, recorder, args, names)
    accepted = sum(row["accepted"] for row in rows)
    print(f"{done} frames, {len(recognizer.database)} keyframes, {accepted} closures -> {output}")
    if args.timing:
        for stage, (median, late, latest) in timer.summary_ms().items():
            print(f"{stage:<10} median {median:7.1f} ms   95 % {late:7.1f} ms   99 % {latest:7.1f} ms")
    return 0


def _recorder(recognizer: PlaceRecognizer) -> "RunRecorder":
    from pnv_lab.evaluation.run_report import RunRecorder

    return RunRecorder(recognizer.describer.image_size)


def _write_report(target: Path, recorder: "RunRecorder", args: argparse.Namespace, names: Names) -> None:
    from pnv_lab.evaluation.run_report import read_positions

    positions = read_positions(Path(args.poses), [stamp for _, stamp in names]) if args.poses else None
    taken = Path(args.images or args.video or args.bag).name
    with atomic_write(target) as file:
        file.write(recorder.html([("Input", taken)], positions).encode())
    recorder.close()
    print(f"report: {target}")


def _reported(closures: list[LoopClosure], best_of_every_query: bool) -> Iterator[LoopClosure]:
    accepted = [c for c in closures if c.accepted]
    yield from accepted or (closures[:1] if best_of_every_query else [])


def _row(closure: LoopClosure, names: Names) -> dict:
    return {
        "query": names[closure.query.camera, closure.query.stamp_ns],
        "match": names[closure.match.camera, closure.match.stamp_ns],
        "query_stamp": _seconds(closure.query.stamp_ns),
        "match_stamp": _seconds(closure.match.stamp_ns),
        "score": f"{closure.score:.6f}",
        "similarity": f"{closure.similarity:.6f}",
        "spatial": f"{closure.spatial:.6f}",
        "inliers": closure.inliers,
        "accepted": int(closure.accepted),
        "reason": str(closure.reason),
    }


def _seconds(stamp_ns: int) -> str:
    return f"{stamp_ns // 10**9}.{stamp_ns % 10**9:09d}"


def _write(path, rows: list[dict]) -> None:
    text = io.StringIO()
    writer = csv.DictWriter(text, COLUMNS, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    with atomic_write(path) as file:
        file.write(text.getvalue().encode())
