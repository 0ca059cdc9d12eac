"""What the fault tests tried, what survived and what was lost, as one table.

`make faults` runs them at full counts with PNV_FAULT_TABLE naming a file; python -m test.tally FILE prints it.
"""

import json
import os
import sys
from pathlib import Path

FULL = bool(os.environ.get("PNV_FULL_TESTS"))  # the counts of the acceptance figures instead of quick ones


def count(short: int, full: int) -> int:
    return full if FULL else short


def tally(item: str, tried: int, survived: int, lost: int = 0) -> None:
    """Note the outcome of an item. Survived: it went on, or was refused in one line with everything as it was."""
    if table := os.environ.get("PNV_FAULT_TABLE"):
        with open(table, "a") as file:
            file.write(json.dumps([item, tried, survived, lost]) + "\n")
    print(f"{item}: {tried} tried, {survived} survived, {lost} lost")


def main() -> None:
    sums: dict[str, list[int]] = {}
    for line in Path(sys.argv[1]).read_text().splitlines():
        item, *counts = json.loads(line)
        sums[item] = [a + b for a, b in zip(sums.get(item, (0, 0, 0)), counts, strict=True)]
    print("| item | tried | survived | lost |\n|---|---|---|---|")
    for item in sorted(sums):
        print(f"| {item} | " + " | ".join(f"{n:,}" for n in sums[item]) + " |")


if __name__ == "__main__":
    main()
