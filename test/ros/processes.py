"""The node and publishers as processes of their own, on a middleware domain that nobody else on the machine uses."""

import fcntl
import os
import signal
import subprocess
import sys
import sysconfig
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import rclpy
from rcl_interfaces.srv import GetParameters
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node

ROOT = Path(__file__).resolve().parents[2]
NODE = "/place_recognizer"
PATIENCE_S = 120.0  # of what comes at once on an idle machine


@contextmanager
def own_domain() -> Iterator[int]:
    """A ROS domain locked for this process; discovery stays on this machine."""
    for offset in range(100):
        number = 1 + (os.getpid() + offset) % 100  # 101 is the last whose ports are free on Linux
        lock = open(f"/tmp/pnv_ros_domain_{number}.lock", "w")  # noqa: SIM115
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            lock.close()
            continue
        before = {k: os.environ.get(k) for k in ("ROS_DOMAIN_ID", "ROS_AUTOMATIC_DISCOVERY_RANGE")}
        os.environ |= {"ROS_DOMAIN_ID": str(number), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
        try:
            yield number
        finally:
            for name, value in before.items():
                os.environ.pop(name) if value is None else os.environ.__setitem__(name, value)
            lock.close()
        return
    raise RuntimeError("no free ROS domain")


def executable() -> str:
    """The installed `place_recognizer`; PNV_ROS_EXECUTABLE names another one, as colcon builds it."""
    return os.environ.get("PNV_ROS_EXECUTABLE", str(Path(sysconfig.get_path("scripts")) / "place_recognizer"))


class Process:
    """A child process whose output is collected as it comes."""

    def __init__(self, *command: str, environment: dict[str, str] | None = None) -> None:
        self.started = time.monotonic()
        self.child = subprocess.Popen(
            command, cwd=ROOT, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
            env=os.environ | {"PYTHONUNBUFFERED": "1", "RCUTILS_COLORIZED_OUTPUT": "0"} | (environment or {}),
        )  # fmt: skip
        self.lines: list[str] = []
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self.child.stdout is not None
        for line in self.child.stdout:
            self.lines.append(line.rstrip("\n"))

    @property
    def output(self) -> str:
        return "\n".join(self.lines)

    def wait_for(self, words: str, timeout: float = PATIENCE_S, meanwhile: Callable[[], Any] = lambda: None) -> str:
        """The first line with these words. Fails if the process ends or says nothing of the kind.

        `meanwhile` sends, again and again: a publisher may know the process before the process knows it, and what is
        sent only once at best effort is lost between.
        """
        end = time.monotonic() + timeout
        while time.monotonic() < end:
            for line in list(self.lines):
                if words in line:
                    return line
            if self.child.poll() is not None:
                self._reader.join(5)
                if words not in self.output:
                    raise AssertionError(f"ended with {self.child.returncode} without {words!r}:\n{self.output}")
            meanwhile()
            time.sleep(0.02)
        raise AssertionError(f"no {words!r} within {timeout} s:\n{self.output}")

    def end(self, number: int = signal.SIGINT, timeout: float = PATIENCE_S) -> int:
        """Send the signal and give the exit status."""
        if self.child.poll() is None:
            self.child.send_signal(number)
        return self.wait(timeout)

    def wait(self, timeout: float = PATIENCE_S) -> int:
        try:
            status = self.child.wait(timeout)
        except subprocess.TimeoutExpired:
            self.child.kill()
            self.child.wait()
            raise AssertionError(f"did not end within {timeout} s:\n{self.output}") from None
        self._reader.join(5)
        return status

    def memory_mb(self) -> float:
        """Resident memory."""
        status = Path(f"/proc/{self.child.pid}/status").read_text()
        return int(status.split("VmRSS:")[1].split()[0]) / 1e3

    def threads(self) -> int:
        return len(os.listdir(f"/proc/{self.child.pid}/task"))

    def cpu_s(self) -> float:
        """Processor time used so far."""
        fields = Path(f"/proc/{self.child.pid}/stat").read_text().rsplit(")", 1)[1].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


@contextmanager
def running_node(*arguments: str, ready: str = "publishes", **parameters: Any) -> Iterator[Process]:
    """The node with these parameters, once it says that it is active."""
    process = Process(executable(), *ros_arguments(*arguments, **parameters))
    try:
        if ready:
            process.wait_for(ready)
        yield process
    finally:
        if process.child.poll() is None:
            process.child.kill()
            process.child.wait()


def ros_arguments(*arguments: str, **parameters: Any) -> list[str]:
    """--ros-args with remappings and the like first, then parameters."""
    flags = [part for name, value in parameters.items() for part in ("-p", f"{name}:={in_yaml(value)}")]
    return ["--ros-args", *arguments, *flags]


def in_yaml(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, list | tuple):
        return "[" + ", ".join(in_yaml(v) for v in value) + "]"
    return repr(str(value)) if isinstance(value, str | Path) else str(value)


def publisher(*arguments: str) -> Process:
    """`python -m test.ros.publish` with these arguments."""
    return Process(sys.executable, "-m", "test.ros.publish", *arguments)


class Listener:
    """An rclpy node of the test process, spun in a thread."""

    def __init__(self, name: str = "listener") -> None:
        self.context = rclpy.Context()
        rclpy.init(context=self.context)
        self.node = Node(name, context=self.context)
        self._executor = SingleThreadedExecutor(context=self.context)
        self._executor.add_node(self.node)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._spin, daemon=True)
        self._thread.start()

    def _spin(self) -> None:
        while not self._stop.is_set():
            self._executor.spin_once(timeout_sec=0.1)

    def collect(self, kind: type, topic: str, qos: Any = 10) -> list[Any]:
        """A list that grows with every message."""
        messages: list[Any] = []
        self.node.create_subscription(kind, topic, messages.append, qos)
        return messages

    def met_by(self, node: str) -> None:
        """Wait until a node knows every publisher, subscription and client that this one has.

        Each side learns of the other at a moment of its own, and what is sent between the two is lost. Discovery names
        endpoints in the order of their making: a node that answers a client made last knows those made before. It is
        asked again and again, since the answers are lost until then.
        """
        client, asked = self.node.create_client(GetParameters, f"{node}/get_parameters"), []
        assert client.wait_for_service(PATIENCE_S), f"no node {node}"

        def answered() -> bool:
            if len(asked) <= time.monotonic() - begin:  # once a second
                asked.append(client.call_async(GetParameters.Request()))
            return any(future.done() for future in asked)

        begin = time.monotonic()
        wait_until(answered, PATIENCE_S, f"an answer of {node}")
        self.node.destroy_client(client)

    def call(self, kind: type, name: str, request: Any, timeout: float = PATIENCE_S) -> Any:
        """The answer of a service of a node, NODE/SERVICE."""
        client = self.node.create_client(kind, name)
        assert client.wait_for_service(timeout), f"no service {name}"
        self.met_by(name.rpartition("/")[0])
        future = client.call_async(request)
        wait_until(future.done, timeout, f"an answer of {name}")
        self.node.destroy_client(client)
        return future.result()

    def close(self) -> None:
        self._stop.set()
        self._thread.join()
        self._executor.shutdown()
        self.node.destroy_node()
        self.context.shutdown()


def wait_until(condition: Callable[[], Any], timeout: float, what: str) -> Any:
    """The condition's first true value. Fails when there is none in time."""
    end = time.monotonic() + timeout
    while time.monotonic() < end:
        if value := condition():
            return value
        time.sleep(0.02)
    raise AssertionError(f"waited {timeout} s for {what}")
