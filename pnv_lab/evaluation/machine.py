"""What a report says about where and with what it was made."""

import os
import platform
from datetime import datetime
from pathlib import Path

import pnv_core
from pnv_core.config import Config
from pnv_core.settings import settings_of


def machine() -> str:
    """The processor and how many cores this process may use."""
    name = platform.processor() or platform.machine()
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                name = line.partition(":")[2].strip()
                break
    except OSError:
        pass
    return f"{len(os.sched_getaffinity(0))} cores of {name}"


def about(command: str, given: Config, completed: Config) -> list[tuple[str, str]]:
    """Command, date, version, machine, model, and the given settings that are not the preset's."""
    preset = Config.make(given.preset)
    changed = [f"{n} {getattr(given, n)}" for n in settings_of(Config) if getattr(given, n) != getattr(preset, n)]
    sizes = ", ".join(map(str, completed.patch_sizes))
    return [
        ("Command", command),
        (
            "Made",
            f"{datetime.now().astimezone():%Y-%m-%d %H:%M %Z} on {platform.node()}, pnv_ros {pnv_core.__version__}",
        ),
        ("Machine", machine()),
        ("Model", f"{completed.weights}, {completed.image_width}x{completed.image_height} px, patch sizes {sizes}"),
        ("Settings", f"preset {given.preset}; " + (", ".join(changed) or "nothing changed")),
    ]
