"""What the fault tests tried, what survived and what was lost, as one table.

`make faults` runs them at full counts with PNV_FAULT_TABLE naming a file; python -m test.tally FILE prints it.
"""

import json
import os
import re
import sys
from pathlib import Path

FULL = bool(os.environ.get("PNV_FULL_TESTS"))  # the counts of the acceptance figures instead of quick ones


def count(short: int, full: int) -> int:
    return full if FULL else short


def tally(item: str, tried: int, survived: int, lost: int = 0) -> None:
    """Note the outcome of an item. Survived: it went on, or was refused in one line with everything as it was."""
    if table := os.environ.get("PNV_FAULT_TABLE"):
        with open(table, "a") as file:
            test = os.environ.get("PYTEST_CURRENT_TEST", "").split(" ")[0].split("[")[0]
            file.write(json.dumps([item, tried, survived, lost, test]) + "\n")
    print(f"{item}: {tried} tried, {survived} survived, {lost} lost")


def main() -> None:
    sums: dict[tuple[str, str], list[int]] = {}
    for line in Path(sys.argv[1]).read_text().splitlines():
        item, *counts, test = json.loads(line)
        row = sums.setdefault((item, test), [0, 0, 0])
        row[:] = [a + b for a, b in zip(row, counts, strict=True)]
    print("| item | tried | survived | lost | test |\n|---|---|---|---|---|")
    for item, test in sorted(sums, key=_by_number):
        print(f"| {item} | " + " | ".join(f"{n:,}" for n in sums[item, test]) + f" | `{test}` |")


def _by_number(row: tuple[str, str]) -> tuple[int, tuple[str, str]]:
    return int(re.match(r"\d*", row[0])[0] or 0), row  # type: ignore[index]


if __name__ == "__main__":
    main()
