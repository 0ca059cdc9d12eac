"""The node for a long time: memory, latency, threads and file handles as a plot, and beside it as a table.

python -m test.ros.soak --seconds 3600 --output out/soak.png
"""

import argparse
import csv
import os
import sys
import tempfile
import time
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
from matplotlib import pyplot as plt

from test.ros.camera import EPOCH_S, Health
from test.ros.processes import Listener, Process, own_domain, publisher, running_node

FIELDS = (
    "minutes", "memory [MB]", "threads", "file handles", "describe p99 [ms]", "rerank p99 [ms]", "keyframes",
    "frames processed", "map on disk [MB]",
)  # fmt: skip


def sample(node: Process, health: Health, began: float, folder: Path) -> tuple[float, ...]:
    values = health.values()
    late = [values.get(f"{stage} p50, p95, p99 [ms]", "0, 0, 0").split(", ")[-1] for stage in ("describe", "rerank")]
    handles = len(os.listdir(f"/proc/{node.child.pid}/fd"))
    disk = sum(entry.stat().st_size for entry in os.scandir(folder)) / 1e6 if folder.is_dir() else 0.0
    counts = (health.count("keyframes"), health.count("frames processed"))
    return (time.monotonic() - began) / 60, node.memory_mb(), node.threads(), handles, *map(float, late), *counts, disk


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=3600.0)
    parser.add_argument("--rate", type=float, default=5.0, help="frames per second")
    parser.add_argument("--output", type=Path, default=Path("out/soak.png"))
    args = parser.parse_args()
    rows: list[tuple[float, ...]] = []
    with own_domain(), tempfile.TemporaryDirectory() as folder, args.output.with_suffix(".csv").open("w") as table:
        stamps, place = Path(folder) / "stamps.csv", Path(folder) / "map"
        with stamps.open("w", newline="") as file:
            count = max(1, int(args.seconds * args.rate))
            csv.writer(file).writerows((EPOCH_S * 10**9 + int(i * 1e9 / args.rate), "") for i in range(count))
        listener = Listener()
        keep = {"map_path": place, "autosave": True, "autosave_interval_s": 60.0, "memory_budget_mb": 64.0}
        writer = csv.writer(table)
        writer.writerow(FIELDS)
        try:
            with running_node(**keep, min_change=0.0) as node:
                health, began = Health(listener), time.monotonic()
                camera = publisher("--stamps", str(stamps), "--rate", str(args.rate))
                while camera.child.poll() is None:
                    time.sleep(min(10.0, args.seconds / 10))
                    rows.append(sample(node, health, began, place))
                    writer.writerow([f"{value:.2f}" for value in rows[-1]])
                    table.flush()
                ending = time.monotonic()
                status = node.end(timeout=300.0)
                print(f"the end took {time.monotonic() - ending:.1f} s")
                said = [line for line in node.lines if "autosaved" not in line and "[INFO]" not in line]
        finally:  # a listener that still spins would abort the process at its end
            listener.close()
            if rows:
                _plot(rows, args.output)
    print(", ".join(FIELDS))
    for at in range(5):
        print(", ".join(f"{value:.1f}" for value in rows[(len(rows) - 1) * at // 4]))
    print(*said[-20:], sep="\n")
    print(f"exit status {status}; {args.output}")
    return status


def _plot(rows: list[tuple[float, ...]], output: Path) -> None:
    figure, axes = plt.subplots(len(FIELDS) - 1, 1, sharex=True, figsize=(8, 14))
    for axis, name, values in zip(axes, FIELDS[1:], list(zip(*rows, strict=True))[1:], strict=True):
        axis.plot([row[0] for row in rows], values)
        axis.set_ylabel(name, fontsize=8)
    axes[-1].set_xlabel(FIELDS[0])
    figure.savefig(output)


if __name__ == "__main__":
    sys.exit(main())
