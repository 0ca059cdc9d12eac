"""The services: save, load, reset, pause. Each answers with what it did, or why not."""

from collections.abc import Callable
from typing import Any, Protocol

from rclpy.node import Node
from std_srvs.srv import SetBool, Trigger

from pnv_core.errors import PnvError


class Controls(Protocol):
    """What a service may do to the node. Each gives a sentence or raises PnvError or OSError."""

    def save(self) -> str: ...
    def load(self) -> str: ...
    def reset(self) -> str: ...
    def pause(self, on: bool) -> str: ...


def create_services(node: Node, controls: Controls) -> None:
    """Offer ~/save, ~/load, ~/reset (std_srvs/Trigger) and ~/pause (std_srvs/SetBool)."""

    def answer(response: Any, act: Callable[[], str]) -> Any:
        try:
            response.success, response.message = True, act()
            node.get_logger().info(response.message)
        except (PnvError, OSError, MemoryError) as error:
            response.success, response.message = False, str(error)
            node.get_logger().error(response.message)
        return response

    node.create_service(Trigger, "~/save", lambda _, response: answer(response, controls.save))
    node.create_service(Trigger, "~/load", lambda _, response: answer(response, controls.load))
    node.create_service(Trigger, "~/reset", lambda _, response: answer(response, controls.reset))

    def pause(request: Any, response: Any) -> Any:
        return answer(response, lambda: controls.pause(request.data))

    node.create_service(SetBool, "~/pause", pause)
