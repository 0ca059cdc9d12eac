"""Progress on stderr: a bar on a terminal, elsewhere a line every ten seconds."""

import sys
from collections.abc import Iterable
from typing import Any

from tqdm import tqdm

_EVERY_S = 10.0


class _Lines:
    """A stream on which tqdm's redrawn bars become lines of their own."""

    def write(self, text: str) -> None:
        if line := text.strip("\r\n "):
            print(line, file=sys.stderr)

    def flush(self) -> None:
        sys.stderr.flush()


def bar(items: Iterable[Any] | None = None, **options: Any) -> Any:
    """tqdm with the given options."""
    if sys.stderr.isatty():
        return tqdm(items, file=sys.stderr, **{"mininterval": 0.2, "leave": False} | options)
    if said := options.get("desc"):
        options["desc"] = said.rstrip(": ") + ": "
    shape = "{desc}{n_fmt} of {total_fmt} {unit}s in {elapsed}"
    every = dict.fromkeys(("mininterval", "maxinterval", "delay"), _EVERY_S)
    plain = {"file": _Lines(), "leave": False, "bar_format": shape}
    return tqdm(items, **options | every | plain)
