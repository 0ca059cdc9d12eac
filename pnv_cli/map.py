"""`pnv map`: what to do with saved maps."""

import argparse
import json
from collections.abc import Callable
from dataclasses import asdict
from datetime import datetime, timezone
from pathlib import Path
from typing import TYPE_CHECKING

from pnv_cli.common import writable
from pnv_core.errors import ConfigError

KINDS = ("closures", "pairs", "tum", "g2o", "rtabmap")  # of pnv_core.pose.export, which takes time to import

if TYPE_CHECKING:
    from pnv_core.maps.manifest import Manifest


def add_parser(subparsers: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    parser = subparsers.add_parser("map", description="Inspects, checks, merges, thins out, recovers and exports maps.")
    actions = parser.add_subparsers(required=True, metavar="ACTION")

    info = _action(actions, "info", _info, "what a map holds, by its manifest")
    info.add_argument("map", type=Path)
    info.add_argument("--json", action="store_true", help="as one JSON object")

    verify = _action(actions, "verify", _verify, "read every byte and check it")
    verify.add_argument("map", type=Path)

    merge = _action(actions, "merge", _merge, "two maps in one; the second's ids and sessions are counted on")
    merge.add_argument("first", type=Path)
    merge.add_argument("second", type=Path)
    _output(merge, "the new map")

    export = _action(actions, "export", _export, "keyframes, closures and poses for other programs")
    export.add_argument("map", type=Path)
    _output(export, "a .csv or .npz file, or of --kind")
    export.add_argument("--patches", action="store_true", help="patch descriptors too (.npz)")
    export.add_argument("--kind", choices=KINDS, help="of --poses: tum, g2o, rtabmap; of --closures: closures, pairs")
    export.add_argument("--poses", type=Path, help="csv, TUM or EuRoC: where the keyframes were taken, found by stamp")
    export.add_argument("--closures", type=Path, metavar="CSV", help="closures between keyframes, as pnv run --csv")

    prune = _action(actions, "prune", _prune, "a smaller map: without some sessions, or thinned out")
    prune.add_argument("map", type=Path)
    _output(prune, "the new map")
    prune.add_argument("--keep", type=int, metavar="N", help="at most so many keyframes")
    prune.add_argument("--budget-mb", type=float, metavar="MB", help="so that it loads with this memory_budget_mb")
    prune.add_argument("--drop-session", type=int, action="append", default=[], metavar="S", help="may be repeated")
    prune.add_argument("--eviction", choices=("oldest", "densest"), default="densest", help="which go first")

    recover = _action(actions, "recover", _recover, "save what is whole of a damaged map")
    recover.add_argument("map", type=Path)
    _output(recover, "the new map")


def _action(
    actions: "argparse._SubParsersAction[argparse.ArgumentParser]",
    name: str,
    run: Callable[[argparse.Namespace], int],
    what: str,
) -> argparse.ArgumentParser:
    parser = actions.add_parser(name, help=what, description=what)
    parser.set_defaults(run=run)
    return parser


def _output(parser: argparse.ArgumentParser, what: str) -> None:
    parser.add_argument("-o", "--output", type=Path, required=True, help=what)


def _info(args: argparse.Namespace) -> int:
    from pnv_core.maps.manifest import read_manifest

    manifest = read_manifest(args.map)
    size = sum(segment.bytes for segment in manifest.segments)
    if args.json:
        facts = asdict(manifest) | {"bytes": size}
        del facts["segments"]
        print(json.dumps(facts))
        return 0
    print(f"map          {args.map}")
    print(f"model        {manifest.fingerprint}, vectors of {manifest.dim} dimensions")
    print(f"keyframes    {manifest.keyframes}, next id {manifest.next_id}")
    print(f"size         {size / 1e6:.1f} MB in {len(manifest.segments)} segments, save number {manifest.generation}")
    print(f"cameras      {', '.join(manifest.cameras) or 'none'}")
    for s in manifest.sessions:
        first, last = (_utc(stamp) for stamp in (s.first_stamp_ns, s.last_stamp_ns))
        print(f"session {s.session:<4} {s.keyframes} keyframes, {first} to {last}")
    return 0


def _utc(stamp_ns: int) -> str:
    try:
        return datetime.fromtimestamp(stamp_ns / 1e9, timezone.utc).strftime("%Y-%m-%d %H:%M:%S UTC")
    except (ValueError, OverflowError, OSError):
        return f"{stamp_ns} ns"


def _verify(args: argparse.Namespace) -> int:
    from pnv_core.maps import tools

    manifest = tools.verify(args.map)
    print(f"{args.map}: whole, {manifest.keyframes} keyframes in {len(manifest.sessions)} sessions")
    return 0


def _merge(args: argparse.Namespace) -> int:
    from pnv_core.maps import tools

    return _written(args.output, tools.merge(args.first, args.second, args.output))


def _export(args: argparse.Namespace) -> int:
    from pnv_core.maps import tools

    output = writable(args.output)
    if args.kind:
        return _exported(args, output)
    if output.suffix == ".csv" and not args.patches:
        rows = tools.export_csv(args.map, output)
    elif output.suffix == ".npz":
        rows = tools.export_npz(args.map, output, patches=args.patches)
    else:
        raise ConfigError(f"--output {output} given; allowed: a .csv (without --patches) or .npz file")
    print(f"{output}: {rows} keyframes")
    return 0


def _exported(args: argparse.Namespace, output: Path) -> int:
    """A file of one of the kinds that pnv run writes too."""
    from pnv_core.files import atomic_write
    from pnv_core.maps.exports import closures_of, refs_of
    from pnv_core.pose.export import OF_POSES, GraphPose, exported
    from pnv_lab.poses import read_poses

    needed = "--poses" if args.kind in OF_POSES else "--closures"
    if getattr(args, needed[2:]) is None:
        raise ConfigError(f"--kind {args.kind} given; allowed: together with {needed} FILE")
    refs, nodes = refs_of(args.map), {}
    closures, names = closures_of(args.closures, refs) if args.closures else ([], {})
    if args.kind in OF_POSES:
        poses = read_poses(args.poses)
        if poses.quaternions is None:
            raise ConfigError(f"{args.poses}: has no orientations; allowed: yaw, or qx, qy, qz, qw")
        frames = {ref: (names.get(ref.id, ""), ref.stamp_ns) for ref in refs}
        rows = poses.of_frames(frames.values())
        nodes = {
            ref: GraphPose(poses.positions[rows[frame]], poses.quaternions[rows[frame]])
            for ref, frame in frames.items()
            if frame in rows
        }
    text = exported(args.kind, nodes, [(c, None) for c in closures], lambda ref: names.get(ref.id, f"{ref.stamp_ns}"))
    with atomic_write(output) as file:
        file.write(text.encode())
    print(f"{output}: {len(nodes) or len(refs)} keyframes, {len(closures)} closures")
    return 0


def _prune(args: argparse.Namespace) -> int:
    from pnv_core.maps import tools

    if args.keep is None and args.budget_mb is None and not args.drop_session:
        raise ConfigError("nothing to prune by; allowed: --keep, --budget-mb or --drop-session")
    for name, value in (("--keep", args.keep), ("--budget-mb", args.budget_mb)):
        if value is not None and value < 0:
            raise ConfigError(f"{name} {value} given; allowed: at least 0")
    pruned = tools.prune(
        args.map,
        args.output,
        keep=args.keep,
        budget_mb=args.budget_mb,
        drop_sessions=args.drop_session,
        eviction=args.eviction,
    )
    return _written(args.output, pruned)


def _recover(args: argparse.Namespace) -> int:
    from pnv_core.maps import tools

    recovery = tools.recover(args.map, args.output)
    for problem in recovery.problems:
        print(problem)
    lost = "an unknown number" if recovery.lost is None else recovery.lost
    print(f"{args.output}: {recovery.keyframes} keyframes recovered, {lost} lost")
    return 0


def _written(output: Path, manifest: "Manifest") -> int:
    print(f"{output}: {manifest.keyframes} keyframes in {len(manifest.sessions)} sessions")
    return 0
