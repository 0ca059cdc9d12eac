"""The real node and the publisher as processes of their own, ended whatever happens."""

import json
import os
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import IO, Any

from pnv_core.errors import PnvError

_STOP_S = 10.0


def isolated_environment() -> dict[str, str]:
    """This machine only, and a domain of its own unless one is chosen, so that examples meet no other robot.

    Sets the same in this process; call it before rclpy.init.
    """
    os.environ.setdefault("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))  # 1 to 101 are safe with Linux' port range
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    return {**os.environ, "PYTHONUNBUFFERED": "1"}


class Process:
    """A child process whose standard output is read line by line; `lines` grows while it runs."""

    def __init__(self, name: str, command: Sequence[str], environment: dict[str, str], echo: IO[str] | None) -> None:
        self.name = name
        self.lines: list[str] = []
        self._echo = echo
        self._process = subprocess.Popen(
            list(command), env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
        )
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            self.lines.append(line.rstrip("\n"))
            if self._echo is not None:
                print(f"[{self.name}] {line}", end="", file=self._echo, flush=True)

    @property
    def return_code(self) -> int | None:
        return self._process.poll()

    def json_lines(self) -> list[dict[str, Any]]:
        return [json.loads(line) for line in list(self.lines) if line.startswith("{")]

    def __enter__(self) -> "Process":
        return self

    def __exit__(self, *_: object) -> None:
        """Ctrl-C, then a firmer word if it does not end."""
        for word in (signal.SIGINT, signal.SIGTERM, signal.SIGKILL):
            if self._process.poll() is not None:
                break
            self._process.send_signal(word)
            try:
                self._process.wait(_STOP_S)
            except subprocess.TimeoutExpired:
                continue
        self._reader.join(_STOP_S)


def node_process(
    environment: dict[str, str],
    parameters: dict[str, Any],
    assignments: Sequence[str],
    echo: IO[str] | None,
    namespace: str = "",
    executable: str = "place_recognizer",
) -> Process:
    """An installed executable with ROS parameters, and more of them as `name:=value`.

    Raises PnvError where it is not installed.
    """
    beside = Path(sys.executable).parent / executable
    path = str(beside) if beside.exists() else shutil.which(executable)
    if path is None:
        raise PnvError(f"no {executable} beside {sys.executable} or on the PATH; allowed: after `make install`")
    given = [f"{name}:={_yaml(value)}" for name, value in parameters.items()] + list(assignments)
    flags = [flag for assignment in given for flag in ("-p", assignment)]
    if namespace:
        flags += ["-r", f"__ns:={namespace}"]
    return Process("node" if executable == "place_recognizer" else executable, [path, "--ros-args", *flags],
                   environment, echo)  # fmt: skip


def publisher_process(environment: dict[str, str], flags: Sequence[str]) -> Process:
    root = str(Path(__file__).resolve().parent.parent)
    paths = os.pathsep.join(filter(None, [root, environment.get("PYTHONPATH")]))
    command = [sys.executable, "-m", "examples.publisher", *flags]
    return Process("publisher", command, {**environment, "PYTHONPATH": paths}, None)


def _yaml(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(_yaml(item) for item in value) + "]"
    return f"'{value}'" if isinstance(value, str) else str(value)
