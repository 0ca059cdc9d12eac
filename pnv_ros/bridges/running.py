"""What the bridges share: settings as parameters, foreign messages, and an end by signal."""

import signal
import sys
from collections.abc import Callable
from importlib import import_module
from typing import Any, TypeVar

import rclpy
from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from pnv_core.errors import ConfigError, PnvError
from pnv_core.settings import settings_of
from pnv_ros.parameters import descriptor_of

UNUSABLE_INPUT = 2
Config = TypeVar("Config")


def settings(node: Node, kind: type[Config]) -> Config:
    """The settings of `kind` as parameters of the node. Raises ConfigError for what is not allowed."""
    values = {}
    for name, setting in settings_of(kind).items():
        default = list(setting.default) if setting.many else setting.default
        try:
            value = node.declare_parameter(name, default, descriptor_of(setting)).value
        except (InvalidParameterValueException, InvalidParameterTypeException) as error:
            raise ConfigError(f"{error}; allowed: {setting.allowed()}") from None
        values[name] = tuple(value) if hasattr(value, "__len__") and not isinstance(value, str) else value
    return kind(**values)


def foreign(module: str) -> Any:
    """A module of messages that not every machine has, as `rtabmap_msgs.msg`. Raises PnvError naming its package."""
    try:
        return import_module(module)
    except ImportError:
        package = module.partition(".")[0]
        apt = package.replace("_", "-")
        raise PnvError(
            f"no {package} on this machine; allowed: after apt-get install ros-jazzy-{apt} where there is one, "
            f"or building {package} in the workspace and sourcing it"
        ) from None


def run(name: str, make: Callable[[], Any], args: list[str] | None = None) -> int:
    """Spin the node of `make` until SIGINT or SIGTERM, then its `end`; 2 with one line for unusable settings."""
    rclpy.init(args=args, signal_handler_options=SignalHandlerOptions.NO)
    ended: list[int] = []
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda number, _: ended.append(number))
    executor = SingleThreadedExecutor()
    try:
        node = make()
        executor.add_node(node)
        while not ended:
            executor.spin_once(timeout_sec=0.2)
        node.end()
        node.destroy_node()
    except PnvError as error:
        print(f"{name}: {error}", file=sys.stderr)
        return UNUSABLE_INPUT
    except ExternalShutdownException:
        pass
    finally:
        executor.shutdown()
        rclpy.try_shutdown()
    return 0
