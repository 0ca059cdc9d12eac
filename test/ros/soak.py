"""The node for a long time: memory, latency, threads and file handles as a plot.

python -m test.ros.soak --minutes 60 --output out/soak.png
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
from test.ros.processes import Listener, own_domain, publisher, running_node

FIELDS = ("minutes", "memory [MB]", "threads", "file handles", "describe p99 [ms]", "keyframes")


def sample(node, health: Health, began: float) -> tuple[float, ...]:
    late = health.values().get("describe p50, p95, p99 [ms]", "0, 0, 0").split(", ")[-1]
    handles = len(os.listdir(f"/proc/{node.child.pid}/fd"))
    minutes = (time.monotonic() - began) / 60
    return minutes, node.memory_mb(), node.threads(), handles, float(late), health.count("keyframes")


def main() -> int:
    parser = argparse.ArgumentParser()
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--output", type=Path, default=Path("out/soak.png"))
    args = parser.parse_args()
    rows = []
    with own_domain(), tempfile.TemporaryDirectory() as folder:
        stamps = Path(folder) / "stamps.csv"
        with stamps.open("w", newline="") as file:
            count = int(args.minutes * 60 * 5)
            csv.writer(file).writerows((EPOCH_S * 10**9 + i * 10**9 // 5, "") for i in range(count))
        listener = Listener()
        keep = {"map_path": f"{folder}/map", "autosave": True, "autosave_interval_s": 60.0, "memory_budget_mb": 64.0}
        with running_node(**keep, min_change=0.0) as node:
            health, began = Health(listener), time.monotonic()
            camera = publisher("--stamps", str(stamps), "--rate", "5")
            while camera.child.poll() is None:
                time.sleep(min(10.0, args.minutes * 6))
                rows.append(sample(node, health, began))
            status = node.end()
        listener.close()
    figure, axes = plt.subplots(len(FIELDS) - 1, 1, sharex=True, figsize=(8, 10))
    for axis, name, values in zip(axes, FIELDS[1:], list(zip(*rows, strict=True))[1:], strict=True):
        axis.plot([row[0] for row in rows], values)
        axis.set_ylabel(name)
    axes[-1].set_xlabel(FIELDS[0])
    figure.savefig(args.output)
    print(", ".join(FIELDS))
    for row in (rows[0], rows[len(rows) // 2], rows[-1]):
        print(", ".join(f"{value:.1f}" for value in row))
    return status


if __name__ == "__main__":
    sys.exit(main())
