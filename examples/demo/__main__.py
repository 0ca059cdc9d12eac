"""make demo: a sequence through the real node, over the real middleware; closures as they come, then a table.

Without arguments a rendered place is visited twice, the second time under other light and from other viewpoints.
Writes loop_closures.csv, match.png and closures.png. Ends with 1 where nothing was found or most of it is wrong.
"""

import argparse
import csv
import io
import sys
import time
from pathlib import Path

import rclpy
from rclpy.executors import ExternalShutdownException

from examples.demo.report import LIGHT_AND_LINE, Run, Shown, plot, print_table, rows, write_match
from examples.listener import listen
from examples.processes import Process, isolated_environment, node_process, publisher_process
from examples.publisher import IMAGE_TOPIC
from examples.sources import add_source_flags, is_file_source, named_frames, source_flags, world_sequence
from pnv_cli.run import COLUMNS
from pnv_core.errors import PnvError
from pnv_core.files import atomic_write

_START_S, _SETTLE_S = 120.0, 30.0


def main() -> int:
    parser = argparse.ArgumentParser(prog="make demo", description=__doc__.splitlines()[0])
    add_source_flags(parser)
    parser.add_argument("--playback", type=float, help="times faster than the stamps, at most; default 2, own input 1")
    parser.add_argument("--exclude-recent-s", type=float, default=30.0, help="least age of a match; default 30")
    parser.add_argument("--parameter", action="append", default=[], metavar="NAME:=VALUE", help="of the node")
    parser.add_argument("--out", type=Path, default=Path("out"), help="folder of what is written; default out")
    parser.add_argument("--node-log", action="store_true", help="show what the node says")
    args = parser.parse_args()
    try:
        args.out.mkdir(parents=True, exist_ok=True)
        run = play(args)
        return report(args, run)
    except PnvError as error:
        print(f"demo: {error}", file=sys.stderr)
        return 2
    except (KeyboardInterrupt, ExternalShutdownException):
        print("demo: interrupted", file=sys.stderr)
        return 130


def play(args: argparse.Namespace) -> Run:
    """Start node and publisher, listen until the last frame is dealt with. Raises PnvError where either fails."""
    environment = isolated_environment()
    own = is_file_source(args)
    if own and next(named_frames(args), None) is None:  # said at once, before anything is started
        raise PnvError("no frame of the input could be read")
    playback = args.playback or (1.0 if own else 2.0)
    run = Run(truth=None if own else world_sequence(args))
    if run.truth is not None:
        print(f"{args.world}, {len(run.truth)} rendered frames, {args.laps:g} laps; {LIGHT_AND_LINE}", flush=True)
    rclpy.init(args=[])
    listener = rclpy.create_node("demo_listener")
    shown = Shown(run)
    run.heard = listen(listener, shown.closures, run.knows)
    parameters = {"image_topics": [IMAGE_TOPIC], "exclude_recent_s": args.exclude_recent_s}
    log = sys.stderr if args.node_log else None
    try:
        with (
            node_process(environment, parameters, args.parameter, log) as node,
            publisher_process(environment, [*source_flags(args), "--playback", str(playback)]) as publisher,
        ):
            _follow(listener, run, node, publisher, shown)
    finally:
        listener.destroy_node()
        rclpy.try_shutdown()
    return run


def _follow(listener: rclpy.node.Node, run: Run, node: Process, publisher: Process, shown: Shown) -> None:
    started, ended, statuses = time.monotonic(), 0.0, 0
    while True:
        rclpy.spin_once(listener, timeout_sec=0.1)
        now = time.monotonic()
        shown.progress(len(publisher.lines), bool(node.lines), publisher.return_code is not None)
        if node.return_code is not None:
            raise PnvError(f"the node ended with {node.return_code}; its last words:\n" + "\n".join(node.lines[-15:]))
        if not publisher.lines and publisher.return_code is None and now - started > _START_S:
            raise PnvError(
                f"no frame was published within {_START_S:.0f} s; the node's last words:\n"
                + "\n".join(node.lines[-15:])
            )
        if publisher.return_code is not None and not ended:
            ended, statuses = now, run.heard.counted
        if ended and ((run.heard.settled and run.heard.counted >= statuses + 2) or now - ended > _SETTLE_S):
            break
    shown.clear()
    if publisher.return_code:
        raise PnvError("\n".join(line for line in publisher.lines if not line.startswith("{"))[-2000:])
    run.take(publisher.json_lines())


def report(args: argparse.Namespace, run: Run) -> int:
    """Table and files; the exit code."""
    print_table(run)
    text = io.StringIO()
    writer = csv.DictWriter(text, [*COLUMNS, "right"], lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows(run))
    with atomic_write(args.out / "loop_closures.csv") as file:
        file.write(text.getvalue().encode())
    plot(run, args.out / "closures.png")
    written = ["loop_closures.csv", "closures.png"]
    if run.heard.closures:
        write_match(run, args, args.out / "match.png")
        written.append("match.png")
    print("written: " + ", ".join(str(args.out / name) for name in written))
    if run.heard.closures:
        print(run.sentence())
    if run.truth is not None:
        print("your own: make demo BAG=DIR (or IMAGES=DIR, VIDEO=FILE), and without ROS: .venv/bin/pnv run PATH")
    if not run.heard.closures:
        span = run.span_s
        print(
            f"nothing found: the input spans {span:.0f} s, and a match is at least {args.exclude_recent_s:g} s older "
            '(a folder of images taken once a second: make demo IMAGES=DIR ARGS="--fps 1")',
            file=sys.stderr,
        )
        return 1
    if run.truth is not None and sum(map(bool, run.verdicts)) < 0.5 * len(run.verdicts):
        print("most closures are wrong", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
