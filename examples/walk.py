"""python -m examples.walk DIR: a rendered walk as images and poses.csv, to try `pnv` where the truth is known."""

import argparse
import csv
import io
import sys
from pathlib import Path

import cv2

from examples.sources import world_sequence
from pnv_core.files import atomic_write
from pnv_lab.worlds import KINDS


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m examples.walk", description=__doc__)
    parser.add_argument("folder", type=Path, metavar="DIR")
    parser.add_argument("--world", choices=tuple(KINDS), default="corridor")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--laps", type=float, default=2.0)
    parser.add_argument("--speed", type=float, default=1.0, help="metres per second")
    args = parser.parse_args()
    walk = world_sequence(args)
    images = args.folder / "images"
    images.mkdir(parents=True, exist_ok=True)
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(("frame", "timestamp", "x", "y", "z", "yaw"))
    for number, (frame, pose) in enumerate(zip(walk, walk.poses, strict=True)):
        name = f"{number:04d}.jpg"
        cv2.imwrite(str(images / name), frame.rgb[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 95])
        numbers = (frame.stamp_ns / 1e9, pose.x, pose.y, pose.z, pose.yaw)
        table.writerow((name, *(f"{value:.4f}" for value in numbers)))
    with atomic_write(args.folder / "poses.csv") as file:
        file.write(text.getvalue().encode())
    print(f"pnv run {images} --poses {args.folder / 'poses.csv'} --timestamps {args.folder / 'poses.csv'}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
