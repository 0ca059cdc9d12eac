"""Sequences for the examples, named on a command line: a rendered world, a folder of images, a video, a rosbag2."""

import argparse
from collections.abc import Iterator

from pnv_cli.sources import add_file_flags, bag, image_folder, video
from pnv_core.types import Frame
from pnv_lab.worlds import KINDS, Sequence, loop_sequence


def add_source_flags(parser: argparse.ArgumentParser) -> None:
    source = parser.add_mutually_exclusive_group()
    source.add_argument("--world", choices=tuple(KINDS), default="corridor", help="a rendered place; the default")
    add_file_flags(parser, source)
    parser.add_argument("--seed", type=int, default=1, help="of --world")
    parser.add_argument("--laps", type=float, default=2.0, help="rounds through --world")
    parser.add_argument("--speed", type=float, default=1.0, help="metres per second through --world")


def source_flags(args: argparse.Namespace) -> list[str]:
    """The flags that name the same source to another process."""
    flags = ["--fps", str(args.fps), "--seed", str(args.seed), "--laps", str(args.laps), "--speed", str(args.speed)]
    for name in ("images", "video", "bag"):
        if getattr(args, name):
            flags += [f"--{name}", getattr(args, name)]
    if not is_file_source(args):
        flags += ["--world", args.world]
    for name in ("topic", "timestamps"):
        if getattr(args, name):
            flags += [f"--{name}", getattr(args, name)]
    return flags


def is_file_source(args: argparse.Namespace) -> bool:
    return bool(args.images or args.video or args.bag)


def world_sequence(args: argparse.Namespace) -> Sequence:
    """Two frames a second through the rendered place; the second lap has its own light and line."""
    return loop_sequence(args.seed, args.world, laps=args.laps, speed_m_s=args.speed, fps=2.0)


def named_frames(args: argparse.Namespace) -> Iterator[tuple[str, Frame]]:
    """(name, frame) in order. Raises PnvError for a source that cannot be read."""
    if args.images:
        yield from image_folder(args.images, args.fps, args.timestamps).frames
    elif args.video:
        yield from video(args.video).frames
    elif args.bag:
        yield from bag(args.bag, args.topic).frames
    else:
        for number, frame in enumerate(world_sequence(args)):
            yield f"{number:04d}", frame
