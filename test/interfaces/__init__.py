"""Twins of foreign message packages, built once per environment and importable in tests and the processes they start.

The fields are those the bridges use, by the names and types of the originals: rtabmap_msgs (introlab/rtabmap_ros),
pose_graph_tools_msgs (MIT-SPARK), cslam_common_interfaces (MISTLab), tf2_msgs (ros2/geometry2). Where a package is
installed, the installed one is used.
"""

import ctypes
import hashlib
import os
import subprocess
import sys
import sysconfig
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path

import pytest

HERE = Path(__file__).parent
ROOT = HERE.parents[1]


@contextmanager
def used(*packages: str) -> Iterator[None]:
    """The packages importable here and in processes started meanwhile. Skips where one cannot be built."""
    prefixes = [_built(package) for package in packages if find_spec(package) is None]
    library = os.path.relpath(sysconfig.get_path("purelib"), sys.prefix)
    before, paths = dict(os.environ), list(sys.path)
    for name, folders in (
        ("PYTHONPATH", [str(prefix / library) for prefix in prefixes]),
        ("LD_LIBRARY_PATH", [str(prefix / "lib") for prefix in prefixes]),
    ):
        os.environ[name] = os.pathsep.join([*folders, *filter(None, [os.environ.get(name)])])
    sys.path[:0] = [str(prefix / library) for prefix in prefixes]
    for prefix in prefixes:
        for path in sorted(prefix.glob("lib/*.so")):
            ctypes.CDLL(str(path))  # LD_LIBRARY_PATH is read when a process starts; what is loaded is found by name
    try:
        yield
    finally:
        sys.path[:] = paths
        for name in ("PYTHONPATH", "LD_LIBRARY_PATH"):
            os.environ.pop(name, None)
            os.environ.update({k: v for k, v in before.items() if k == name})


def _built(package: str) -> Path:
    sources = sorted(path for path in (HERE / package).rglob("*") if path.is_file())
    key = hashlib.sha256(b"".join(path.read_bytes() for path in sources)).hexdigest()[:12]
    prefix = Path(sys.prefix) / "test_interfaces" / f"{package}-{key}"
    if not (prefix / "built").exists():
        command = [sys.executable, str(ROOT / ".ci" / "build_interfaces.py"), str(HERE / package), "--prefix"]
        told = subprocess.run([*command, str(prefix)], capture_output=True, text=True)
        if told.returncode or not (prefix / "lib").is_dir():
            pytest.skip(f"{package} could not be built: {(told.stdout + told.stderr)[-200:]}")
        (prefix / "built").touch()
    return prefix
