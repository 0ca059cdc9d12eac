"""ROS parameters generated from the declarations in Config and NodeConfig."""

import difflib
import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.exceptions import InvalidParameterValueException
from rclpy.node import Node
from rclpy.parameter import Parameter

from pnv_core.config import Config
from pnv_core.errors import ConfigError
from pnv_core.settings import Setting, settings_of
from pnv_ros.node_config import NodeConfig

RECOGNISER = settings_of(Config)
NODE = settings_of(NodeConfig)
DECLARED: dict[str, Setting] = RECOGNISER | NODE


@dataclass(frozen=True)
class Settings:
    """The settings of recogniser and node at one moment."""

    recogniser: Config
    node: NodeConfig


class Parameters:
    """The node's parameters: checked together, changed together.

    `running` says whether a model is loaded, when only settings declared live may change; `changed` gets the new
    Settings after each accepted change.
    """

    def __init__(self, node: Node, running: Callable[[], bool], changed: Callable[[Settings], None]) -> None:
        self._node, self._running, self._changed = node, running, changed
        self._defaults = preset_defaults(self._declare(RECOGNISER["preset"], RECOGNISER["preset"].default))
        for name, setting in DECLARED.items():
            if name != "preset":
                self._declare(setting, self._defaults[name])
        self.settings = self._read({})
        self._name_unknown(node._parameter_overrides)
        node.add_on_set_parameters_callback(self._check)
        node.add_post_set_parameters_callback(self._take)

    def _declare(self, setting: Setting, default: Any) -> Any:
        try:
            given = self._node._parameter_overrides.get(setting.name)
            # an empty list of a parameter file has no type and arrives as nothing
            empty = setting.many and given is not None and given.value is None
            wanted = [] if empty else _to_ros(default)
            value = self._node.declare_parameter(setting.name, wanted, descriptor_of(setting), empty).value
        except InvalidParameterValueException as error:
            raise ConfigError(f"{error}; allowed: {setting.allowed()}") from None
        return setting.check(_from_ros(value))

    def _name_unknown(self, given: Iterable[str]) -> None:
        """Warn of parameters given at the start that the node does not have, with the nearest one it has."""
        for name in given:
            if not (name in DECLARED or name.startswith("qos_overrides.") or self._node.has_parameter(name)):
                near = difflib.get_close_matches(name, DECLARED, 1, 0.6)
                meant = f"did you mean {near[0]}?" if near else "`place_recognizer --help` lists those it has"
                self._node.get_logger().warning(f"no parameter {name}; {meant}")

    def _read(self, changes: dict[str, Any]) -> Settings:
        """The settings with `changes` on top. Raises ConfigError for what is not allowed."""
        given = {n: changes[n] if n in changes else self._node.get_parameter(n).value for n in DECLARED}
        values = {n: DECLARED[n].check(_from_ros(v)) for n, v in given.items()}
        defaults = self._defaults
        if values["preset"] != defaults["preset"]:
            defaults = preset_defaults(values["preset"])
            values |= {n: defaults[n] for n in RECOGNISER if values[n] == self._defaults[n] and n != "preset"}
        own = {n: v for n, v in values.items() if n in RECOGNISER and v != defaults[n]}
        return Settings(
            recogniser=Config.make(values["preset"], **own),
            node=NodeConfig(**{n: values[n] for n in NODE}),
        )

    def _check(self, parameters: Sequence[Parameter]) -> SetParametersResult:
        changes = {p.name: p.value for p in parameters if p.name in DECLARED}
        fixed = [n for n in changes if not DECLARED[n].live]
        if fixed and self._running():
            live = ", ".join(n for n, s in DECLARED.items() if s.live)
            return SetParametersResult(
                successful=False,
                reason=f"{', '.join(fixed)} needs a restart (or clean-up and configure); allowed while running: {live}",
            )
        try:
            self._read(changes)
        except ConfigError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _take(self, parameters: Sequence[Parameter]) -> None:
        if any(p.name in DECLARED for p in parameters):
            self.settings = self._read({})
            self._changed(self.settings)


def preset_defaults(preset: str) -> dict[str, Any]:
    """What every setting is under a preset when nobody says otherwise."""
    config = Config.make(preset)
    return {n: getattr(config, n) for n in RECOGNISER} | {n: s.default for n, s in NODE.items()}


def descriptor_of(setting: Setting) -> ParameterDescriptor:
    """Description, constraints and range of a setting. Types are checked by the setting: a whole number is a number."""
    descriptor = ParameterDescriptor(description=setting.doc, dynamic_typing=True)
    descriptor.additional_constraints = setting.allowed() + ("" if setting.live else "; needs a restart")
    if not setting.many and setting.low is not None:
        if setting.kind is int:
            high = 2**63 - 1 if setting.high is None else int(setting.high)
            descriptor.integer_range = [IntegerRange(from_value=int(setting.low), to_value=high)]
        elif setting.kind is float:
            high_value = sys.float_info.max if setting.high is None else setting.high
            descriptor.floating_point_range = [FloatingPointRange(from_value=float(setting.low), to_value=high_value)]
    return descriptor


def _to_ros(value: Any) -> Any:
    return list(value) if isinstance(value, tuple) else value


def _from_ros(value: Any) -> Any:
    return value if isinstance(value, str | bytes) or not hasattr(value, "__len__") else tuple(value)
