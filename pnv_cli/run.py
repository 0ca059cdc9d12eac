"""pnv run PATH: the loop closures of a folder of images, a video or a bag."""

import argparse
import csv
import io
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass, field
from datetime import datetime
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pnv_cli.common import ALWAYS_SHOWN, add_config_flags, config_from, writable
from pnv_cli.sources import FrameSource, add_source_flags, named_source, source_of
from pnv_core.errors import ConfigError, PnvError

if TYPE_CHECKING:
    from pnv_cli.tally import Tally
    from pnv_core.recognizer import PlaceRecognizer
    from pnv_core.types import ImageRef, LoopClosure
    from pnv_lab.evaluation.run_report import RunRecorder
    from pnv_lab.poses import Poses, PoseTruth
    from pnv_lab.recording import Recording

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
_FILES = ("csv", "report", "rrd", "pairs", "g2o", "tum", "rtabmap")  # flags that name a file to write
_SHOWN = (*ALWAYS_SHOWN, "accept_score", "exclude_recent_s", "min_interval_s", "candidates")


def add_parser(subparsers: argparse._SubParsersAction) -> None:
    parser = subparsers.add_parser(
        "run",
        description="Finds the loop closures of a folder of images, a video or a bag. Without --csv or --out, "
        "closures.csv and report.html go to out/NAME-DATE/.",
    )
    add_source_flags(parser)
    out = parser.add_argument_group("what is written")
    out.add_argument("--out", metavar="DIR", help="folder for closures.csv and report.html; default out/NAME-DATE")
    out.add_argument("--csv", metavar="OUT.csv", help="one row per accepted closure; alone: no folder, no report")
    out.add_argument("--all", action="store_true", help="also the best candidate of every query without a closure")
    out.add_argument("--report", metavar="FILE.html", help="scores, pictures and path of the run as one page")
    out.add_argument("--rrd", metavar="FILE", help="a recording for the rerun viewer: images, scores, path over time")
    out.add_argument("--pairs", metavar="FILE", help="accepted closures as image pairs, in hloc's format")
    out.add_argument("--g2o", metavar="FILE", help="pose graph of --poses and closures; with --intrinsics their poses")
    out.add_argument("--tum", metavar="FILE", help="poses of the keyframes as a TUM trajectory")
    out.add_argument("--rtabmap", metavar="FILE.graph", help="as --g2o, in TORO's format, which RTAB-Map reads")
    out.add_argument("--timing", action="store_true", help="print the time of each stage")
    given = parser.add_argument_group("what is known")
    given.add_argument(
        "--poses", metavar="FILE", help="true poses: csv (frame or timestamp, x, y, ...), TUM or EuRoC; for report, g2o"
    )
    given.add_argument("--radius-m", type=float, default=5.0, help="with --poses: right within; default 5")
    given.add_argument("--angle-deg", type=float, default=45.0, help="with --poses: right if turned less; default 45")
    given.add_argument("--intrinsics", metavar="FX,FY,CX,CY", help="of the camera, in pixels of its images; for --g2o")
    maps = parser.add_argument_group("maps")
    maps.add_argument("--save-map", nargs="?", const="", metavar="DIR", help="save the map; default in the out folder")
    maps.add_argument("--load-map", metavar="DIR", help="begin with this map: places of an earlier run are found again")
    maps.add_argument("--localize", action="store_true", help="with --load-map: find its places, add nothing")
    add_config_flags(parser, shown=_SHOWN)
    parser.set_defaults(run=run)


@dataclass(frozen=True)
class Targets:
    """Where everything is written; None: it is not."""

    folder: Path | None
    csv: Path | None
    report: Path | None
    rrd: Path | None
    pairs: Path | None
    g2o: Path | None
    tum: Path | None
    rtabmap: Path | None
    map: Path | None


def run(args: argparse.Namespace) -> int:
    from pnv_core.decide.calibration import why_conservative

    targets, poses = _targets(args), _poses(args)
    config = config_from(args)
    source = source_of(args)
    recognizer = _recognizer(args, config)
    if why := why_conservative(recognizer.describer.model.info.calibration, recognizer.describer.config):
        print(f"pnv: {why}", file=sys.stderr)
    if targets.folder:
        targets.folder.mkdir(parents=True, exist_ok=True)
    with ExitStack() as open_until_the_end:
        recorder = _recorder(recognizer) if targets.report or targets.rrd else None
        if recorder:
            open_until_the_end.enter_context(closing(recorder))
        recording = _recording(targets.rrd, config.accept_score) if targets.rrd else None
        if recording:
            open_until_the_end.enter_context(closing(recording))
        found = _driven(source, recognizer, targets, args.all, recorder, recording)
        truth = _truth(args, poses, found.names)
        facts = _facts(found, recognizer, truth)
        print(facts[0][1] + (f" -> {targets.csv}" if args.csv else ""))
        for title, words in facts[1:]:
            print(f"  {title:<9}{words}")
        if args.timing:
            for stage, (median, late, latest) in recognizer.timer.summary_ms().items():
                print(f"{stage:<10} median {median:7.1f} ms   95 % {late:7.1f} ms   99 % {latest:7.1f} ms")
        if recorder and targets.report:
            _write_report(targets.report, recorder, args, recognizer, facts, truth)
        if recording and truth:
            _record_path(recording, found, truth)
    _export(targets, recognizer, found, poses, _cameras(args, found))
    _save_map(targets, recognizer)
    written = [path for name in (*_FILES, "map") if (path := getattr(targets, name))]
    print(f"  {'written':<9}{', '.join(map(str, written))}")
    return 0


@dataclass
class Found:
    """What a run came to."""

    names: "Names"
    tally: "Tally"
    accepted: "list[LoopClosure]" = field(default_factory=list)
    keyframes: int = 0  # that the run added
    seconds: float = 0.0
    width: int = 0  # of the images, in pixels


def _driven(
    source: FrameSource,
    recognizer: "PlaceRecognizer",
    targets: Targets,
    best_of_every_query: bool,
    recorder: "RunRecorder | None",
    recording: "Recording | None",
) -> Found:
    """Every frame through the recogniser. Raises PnvError where no frame can be read."""
    from pnv_cli.progress import bar
    from pnv_cli.tally import Tally

    found = Found(Names(recognizer.database.session), Tally())
    loaded, started = len(recognizer.database), time.perf_counter()
    rows: list[dict[str, Any]] = []
    try:
        for name, frame in bar(source.frames, total=source.count or None, unit="frame"):
            found.width = frame.rgb.shape[1]
            found.names.add(name, frame.camera, frame.stamp_ns)
            closures = recognizer.process(frame)
            found.tally.add(frame, closures)
            found.accepted += [c for c in closures if c.accepted]
            rows += [_row(c, found.names) for c in _reported(closures, best_of_every_query)]
            if recorder:
                recorder.add(name, frame, closures)
            if recorder and recording:
                recording.add(frame, closures, recorder.pair(closures[0]) if closures else None)
    finally:  # an interrupted run keeps what it found
        if targets.csv:
            _write_csv(targets.csv, rows)
    if not found.tally.frames:
        raise PnvError("no frame of the input could be read")
    found.keyframes, found.seconds = len(recognizer.database) - loaded, time.perf_counter() - started
    return found


def _facts(found: Found, recognizer: "PlaceRecognizer", truth: "PoseTruth | None") -> list[tuple[str, str]]:
    """What terminal and report say of a run, by title."""
    tally, names = found.tally, found.names
    stages = ", ".join(f"{stage} {median:.1f}" for stage, (median, _, _) in recognizer.timer.summary_ms().items())
    facts = [("counts", tally.sentence(found.keyframes))]
    if not tally.closures:
        facts.append(("nothing", tally.why_nothing(recognizer.config)))
    if truth:
        pairs = [(names.frame(c.query), names.frame(c.match)) for c in found.accepted]
        facts.append(("truth", truth.counted(pairs)))
    facts.append(("refused", f"{tally.refusals()}   (candidates)"))
    facts.append(("time", f"{stages} ms (medians); {tally.frames / found.seconds:.1f} frames/s"))
    return facts


class Names:
    """What the frames of this run are called; those of a loaded map have their stamps only."""

    def __init__(self, session: int) -> None:
        self._session = session
        self._known: dict[tuple[str, int], str] = {}

    def add(self, name: str, camera: str, stamp_ns: int) -> None:
        self._known[camera, stamp_ns] = name

    def frames(self) -> list[tuple[str, int]]:
        """(name, stamp) of every frame."""
        return [(name, stamp) for (_, stamp), name in self._known.items()]

    def frame(self, ref: "ImageRef") -> tuple[str, int]:
        """(name, stamp)"""
        return self.of(ref), ref.stamp_ns

    def of(self, ref: "ImageRef") -> str:
        if ref.session == self._session:
            return self._known[ref.camera, ref.stamp_ns]
        return f"map:{ref.session}:{_seconds(ref.stamp_ns)}"


def _targets(args: argparse.Namespace) -> Targets:
    """Where the flags want what. Raises ConfigError for a place that cannot be written, before any work."""
    alone = [getattr(args, name) for name in _FILES]
    folder = Path(args.out) if args.out else None
    if folder is None and not any(alone):
        stem = Path(named_source(args)[1]).resolve()
        name = f"{stem.parent.name}-{stem.name}" if stem.name == "images" else stem.stem
        folder = Path("out") / f"{name}-{datetime.now():%Y-%m-%d_%H-%M-%S}"
    if folder and folder.exists() and not folder.is_dir():
        raise ConfigError(f"--out {folder}: is a file; allowed: a folder")
    if args.rrd and find_spec("rerun") is None:
        raise ConfigError("--rrd needs the rerun SDK; allowed: after pip install rerun-sdk (extra rerun)")
    if (args.g2o or args.tum or args.rtabmap) and not args.poses:
        raise ConfigError("--g2o, --rtabmap and --tum write poses; allowed: together with --poses FILE")
    if not (args.radius_m > 0 and args.angle_deg > 0):
        raise ConfigError(f"--radius-m {args.radius_m:g} --angle-deg {args.angle_deg:g}; allowed: more than 0")
    if args.localize and not args.load_map:
        raise ConfigError("--localize finds the places of a map; allowed: together with --load-map DIR")
    if args.save_map == "" and folder is None:
        raise ConfigError("--save-map needs a folder; allowed: --save-map DIR, or together with --out DIR")
    asked = {name: Path(value) for name in _FILES if (value := getattr(args, name))}
    named = {name: path if path.parent == folder else writable(path) for name, path in asked.items()}
    if folder:  # it is made when everything else is known to be right
        named = {"csv": folder / "closures.csv", "report": folder / "report.html"} | named
        (folder.parent).mkdir(parents=True, exist_ok=True)
        writable(folder.parent / "x" if not folder.exists() else folder / "x")
    saved = None if args.save_map is None else Path(args.save_map) if args.save_map else Path(folder or "") / "map"
    return Targets(folder, map=saved, **{name: named.get(name) for name in _FILES})


def _recognizer(args: argparse.Namespace, config: Any) -> "PlaceRecognizer":
    from pnv_core.database import KeyframeDatabase
    from pnv_core.describe.describer import describer_from
    from pnv_core.maps import MapStore
    from pnv_core.recognizer import PlaceRecognizer
    from pnv_core.timing import StageTimer

    describer = describer_from(config)
    database = KeyframeDatabase.for_describer(describer, read_only=args.localize)
    if args.load_map:
        MapStore(args.load_map, describer.map_fingerprint).load(database)
        print(f"{args.load_map}: {len(database)} keyframes loaded")
    return PlaceRecognizer(describer, database, timer=StageTimer(time.perf_counter))


def _save_map(targets: Targets, recognizer: "PlaceRecognizer") -> None:
    from pnv_core.maps import MapStore

    if targets.map:
        store = MapStore(targets.map, recognizer.describer.map_fingerprint)
        print(f"  {'map':<9}{store.save(recognizer.database.snapshot())}")


def _poses(args: argparse.Namespace) -> "Poses | None":
    if not args.poses:
        return None
    from pnv_lab.poses import read_poses

    poses = read_poses(args.poses)
    if (args.g2o or args.tum or args.rtabmap) and poses.quaternions is None:
        raise ConfigError(f"{args.poses}: has no orientations; allowed for the graph: yaw, or qx, qy, qz, qw")
    return poses


def _recorder(recognizer: "PlaceRecognizer") -> "RunRecorder":
    from pnv_core.verify.feature_codes import picture_of
    from pnv_lab.evaluation.run_report import RunRecorder

    def kept_picture(ref: "ImageRef") -> bytes:
        return picture_of(recognizer.database.picture(ref.id))

    return RunRecorder(recognizer.describer.image_size, recognizer.database.session, kept_picture)


def _recording(target: Path, accept_score: float) -> "Recording":
    from pnv_lab.recording import Recording

    return Recording(target, accept_score)


def _truth(args: argparse.Namespace, poses: "Poses | None", names: Names) -> "PoseTruth | None":
    from pnv_lab.poses import PoseTruth

    return PoseTruth(poses, names.frames(), args.radius_m, args.angle_deg) if poses else None


def _record_path(recording: "Recording", found: Found, truth: "PoseTruth") -> None:
    """The way of the run and the closures between its places."""
    placed = {name: position for name in found.names.frames() if (position := truth.position(name)) is not None}
    way = sorted(((stamp_ns, position) for (_, stamp_ns), position in placed.items()), key=lambda at: at[0])
    recording.path(way, found.accepted, lambda ref: placed.get(found.names.frame(ref)))


def _write_report(
    target: Path,
    recorder: "RunRecorder",
    args: argparse.Namespace,
    recognizer: "PlaceRecognizer",
    facts: Sequence[tuple[str, str]],
    truth: "PoseTruth | None",
) -> None:
    from pnv_core.files import atomic_write
    from pnv_lab.evaluation.machine import about

    head = about(args.command_line, config_from(args), recognizer.describer.config)
    head.insert(1, ("Input", str(Path(named_source(args)[1]).resolve())))
    page = recorder.html([*head, *((title.capitalize(), words) for title, words in facts)], truth)
    with atomic_write(target) as file:
        file.write(page.encode())


def _cameras(args: argparse.Namespace, found: Found) -> dict[str, Any]:
    """--intrinsics for every camera that closed a loop; none without the flag."""
    if not args.intrinsics:
        return {}
    from pnv_core.pose.geometry import Intrinsics

    try:
        fx, fy, cx, cy = (float(text) for text in args.intrinsics.split(","))
    except ValueError:
        raise ConfigError(f"--intrinsics {args.intrinsics!r}; allowed: FX,FY,CX,CY in pixels") from None
    return dict.fromkeys({c.query.camera for c in found.accepted}, Intrinsics.of_pixels(fx, fy, cx, cy, found.width))


def _export(
    targets: Targets,
    recognizer: "PlaceRecognizer",
    found: Found,
    poses: "Poses | None",
    cameras: dict[str, Any],
) -> None:
    """The accepted closures, and the poses of the keyframes, for other programs."""
    from pnv_core.files import atomic_write
    from pnv_core.pose.export import OF_POSES, GraphPose, exported
    from pnv_core.pose.relative_poses import RelativePoses

    names = found.names
    asked = {kind: path for kind in ("pairs", *OF_POSES) if (path := getattr(targets, kind))}
    nodes: dict[ImageRef, GraphPose] = {}
    closures: list[Any] = [(c, None) for c in found.accepted]
    if poses is not None and poses.quaternions is not None and asked.keys() & set(OF_POSES):
        rows = poses.of_frames(names.frames())
        nodes = {
            ref: GraphPose(poses.positions[row], poses.quaternions[row])
            for ref in recognizer.database.refs()
            if ref.session == recognizer.database.session
            and (row := rows.get((names.of(ref), ref.stamp_ns))) is not None
        }
    if asked.keys() & {"g2o", "rtabmap"}:
        for ref, pose in sorted(nodes.items(), key=lambda node: node[0].stamp_ns):
            x, y, z = map(float, pose.position)
            recognizer.odometry.add(ref.stamp_ns, x, y, z)  # the run decided without it
        measured = RelativePoses(recognizer, cameras)
        closures = [(c, measured.estimate(c)) for c in found.accepted]
    for kind, path in asked.items():
        text = exported(kind, nodes, closures, names.of)
        with atomic_write(path) as file:
            file.write(text.encode())


def _reported(closures: "list[LoopClosure]", best_of_every_query: bool) -> "Iterator[LoopClosure]":
    accepted = [c for c in closures if c.accepted]
    yield from accepted or (closures[:1] if best_of_every_query else [])


def _row(closure: "LoopClosure", names: Names) -> dict[str, Any]:
    return {
        "query": names.of(closure.query),
        "match": names.of(closure.match),
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


def _write_csv(path: Path, rows: list[dict[str, Any]]) -> None:
    from pnv_core.files import atomic_write

    text = io.StringIO()
    writer = csv.DictWriter(text, COLUMNS, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    with atomic_write(path) as file:
        file.write(text.getvalue().encode())
