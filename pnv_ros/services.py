"""The services: save, load, reset, pause, relocalize. Each answers with what it did, or why not."""

import threading
from collections.abc import Callable
from typing import Any, Protocol

from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.node import Node
from rclpy.task import Future
from std_srvs.srv import SetBool, Trigger

from pnv_core.errors import PnvError


class Controls(Protocol):
    """What a service may do to the node. Each gives a sentence or raises PnvError or OSError.

    save, load and reset are called from threads of their own, one at a time; the others from the callbacks' thread.
    """

    def save(self) -> str: ...
    def load(self) -> str: ...
    def reset(self) -> str: ...
    def pause(self, on: bool) -> str: ...
    def relocalize(self) -> str: ...


class Services:
    """~/save, ~/load, ~/reset, ~/relocalize (std_srvs/Trigger) and ~/pause (std_srvs/SetBool).

    The first three may take seconds. They run beside the executor, which goes on with images meanwhile.
    """

    def __init__(self, node: Node, controls: Controls) -> None:
        self._node = node
        self._pending = 0
        self._one_at_a_time = MutuallyExclusiveCallbackGroup()
        for name, act in (("save", controls.save), ("load", controls.load), ("reset", controls.reset)):
            self.serve(Trigger, name, _without_arguments(act))

        def pause(request: Any, response: Any) -> Any:
            return self._answered(response, _outcome(lambda: controls.pause(request.data)))

        def relocalize(_: Any, response: Any) -> Any:
            return self._answered(response, _outcome(controls.relocalize))

        node.create_service(SetBool, "~/pause", pause)
        node.create_service(Trigger, "~/relocalize", relocalize)

    @property
    def idle(self) -> bool:
        """Whether every call was answered."""
        return self._pending == 0

    def serve(self, kind: type, name: str, act: Callable[[Any, Any], str]) -> None:
        """A service ~/name: `act` gets request and response in a thread, and gives the sentence of the answer."""

        async def serve(request: Any, response: Any) -> Any:
            done, work = Future(), lambda: act(request, response)
            threading.Thread(target=self._run, args=(work, done), name="service", daemon=True).start()
            self._pending += 1
            try:
                return self._answered(response, await done)
            finally:
                self._pending -= 1

        self._node.create_service(kind, f"~/{name}", serve, callback_group=self._one_at_a_time)

    def _run(self, act: Callable[[], str], done: Future) -> None:
        done.set_result(_outcome(act))
        if self._node.executor is not None:
            self._node.executor.wake()

    def _answered(self, response: Any, outcome: str | Exception) -> Any:
        if isinstance(outcome, str):
            self._node.get_logger().info(outcome)
        elif isinstance(outcome, PnvError | OSError | MemoryError):
            self._node.get_logger().error(str(outcome))
        else:
            raise outcome
        response.success, response.message = isinstance(outcome, str), str(outcome)
        return response


def _without_arguments(act: Callable[[], str]) -> Callable[[Any, Any], str]:
    return lambda request, response: act()


def _outcome(act: Callable[[], str]) -> str | Exception:
    try:
        return act()
    except Exception as error:
        return error
