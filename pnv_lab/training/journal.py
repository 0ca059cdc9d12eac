"""What a training leaves in its folder: a checkpoint to go on from, metrics as JSON lines, and their plots."""

import json
from pathlib import Path
from typing import Any

import torch

from pnv_core.errors import ModelError
from pnv_core.files import atomic_write


class Journal:
    """checkpoint.pt and metrics.jsonl in `folder`. `settings` must be the same when a training goes on."""

    def __init__(self, folder: Path, settings: str) -> None:
        self.folder, self.settings = folder, settings
        folder.mkdir(parents=True, exist_ok=True)
        self.checkpoint = folder / "checkpoint.pt"
        self.metrics = folder / "metrics.jsonl"

    def load(self, device: torch.device) -> dict[str, Any] | None:
        """The last checkpoint, or None. Metrics written after it are dropped: they will be written again.

        Raises ModelError where it was made with other settings.
        """
        if not self.checkpoint.exists():
            self.metrics.unlink(missing_ok=True)
            return None
        state: dict[str, Any] = torch.load(self.checkpoint, map_location=device, weights_only=True)
        if state["settings"] != self.settings:
            raise ModelError(
                f"{self.checkpoint} was made with other settings; allowed: the same ones, or another folder"
            )
        rows = [row for row in self.rows() if row["step"] <= state["step"]]
        with atomic_write(self.metrics) as file:
            file.write("".join(json.dumps(row) + "\n" for row in rows).encode())
        return state

    def save(self, state: dict[str, Any]) -> None:
        with atomic_write(self.checkpoint) as file:
            torch.save(state | {"settings": self.settings}, file)

    def log(self, row: dict[str, Any]) -> None:
        with self.metrics.open("a") as file:
            file.write(json.dumps({k: round(v, 5) if isinstance(v, float) else v for k, v in row.items()}) + "\n")

    def rows(self) -> list[dict[str, Any]]:
        """Every complete line of the metrics; a kill may have torn the last one."""
        found = []
        for line in self.metrics.read_text().splitlines() if self.metrics.exists() else []:
            try:
                found.append(json.loads(line))
            except json.JSONDecodeError:
                continue
        return found


def plot(journal: Journal, path: Path) -> None:
    """Losses and validation recall over the steps, as a PNG."""
    from matplotlib.figure import Figure

    rows = journal.rows()
    names = sorted({name for row in rows for name in row} - {"step", "rate", "epoch", "tuples"})
    figure = Figure(figsize=(9, 4), layout="constrained")
    for axes, chosen in zip(figure.subplots(1, 2), (False, True), strict=True):
        for name in (n for n in names if ("recall" in n) == chosen):
            points = [(row["step"], row[name]) for row in rows if name in row]
            axes.plot(*zip(*points, strict=True), label=name, marker="." if chosen else "")
        axes.set_xlabel("step")
        axes.set_ylabel("validation recall" if chosen else "loss")
        axes.grid(alpha=0.3)
        if axes.lines:
            axes.legend(fontsize=7)
    with atomic_write(path) as file:
        figure.savefig(file, format="png", dpi=120)
