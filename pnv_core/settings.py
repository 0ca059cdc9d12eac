"""How a setting is declared: once, with default, meaning, unit and limits."""

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from pnv_core.errors import ConfigError


class Section(str):
    """A heading in the body of a Config class: the settings after it belong to it."""


@dataclass(frozen=True)
class Setting:
    """The declaration of one setting, as drivers (ROS parameters, flags, tables) read it."""

    name: str
    kind: type  # bool, int, float, str
    many: bool  # a tuple of `kind`
    default: Any
    doc: str
    unit: str = ""
    low: float | None = None
    high: float | None = None
    choices: tuple[str, ...] = ()
    live: bool = False  # may change while running
    section: str = ""

    def check(self, value: Any) -> Any:
        """The value in its declared type. Raises ConfigError naming the value and what is allowed."""
        if self.many:
            if isinstance(value, str | bytes) or not isinstance(value, Sequence):
                raise ConfigError(f"{self.name} = {value!r} is not a list; allowed: {self.allowed()}")
            return tuple(self._check_one(item) for item in value)
        return self._check_one(value)

    def _check_one(self, value: Any) -> Any:
        if self.kind is float and isinstance(value, int) and not isinstance(value, bool):
            value = float(value)
        wrong_type = not isinstance(value, self.kind) or (self.kind is int and isinstance(value, bool))
        too_low = not wrong_type and self.low is not None and not value >= self.low
        too_high = not wrong_type and self.high is not None and not value <= self.high
        not_finite = not wrong_type and self.kind is float and not math.isfinite(value)
        no_choice = not wrong_type and bool(self.choices) and value not in self.choices
        if wrong_type or not_finite or too_low or too_high or no_choice:
            raise ConfigError(f"{self.name} = {value!r} is out of range; allowed: {self.allowed()}")
        return value

    def allowed(self) -> str:
        """The allowed values in words, for messages and tables."""
        what = {bool: "true or false", int: "whole number", float: "number", str: "text"}[self.kind]
        if self.choices:
            what = "one of " + ", ".join(self.choices)
        elif self.low is not None and self.high is not None:
            what += f" from {self.low:g} to {self.high:g}"
        elif self.low is not None:
            what += f" of at least {self.low:g}"
        elif self.high is not None:
            what += f" of at most {self.high:g}"
        if self.unit:
            what += f" [{self.unit}]"
        return f"list of {what}" if self.many else what


def setting(default: Any, doc: str, *, kind: type | None = None, **limits: Any) -> Any:
    """A dataclass field that declares a setting; a tuple default means a list of its items' type."""
    many = isinstance(default, tuple)
    item = kind or (type(default[0]) if many else type(default))
    return field(default=default, metadata={"setting": dict(kind=item, many=many, doc=doc, **limits)})


def settings_of(config_class: type) -> dict[str, Setting]:
    """Every setting a Config class declares, in order, by name; those it inherits first."""
    fields = {f.name: f for f in dataclasses.fields(config_class) if "setting" in f.metadata}
    found, section = {}, ""
    for name, value in (item for kind in reversed(config_class.__mro__) for item in vars(kind).items()):
        if isinstance(value, Section):
            section = str(value)
        elif name in fields:
            found[name] = Setting(
                name, default=fields[name].default, section=section, **fields[name].metadata["setting"]
            )
    return found


def checked(config: Any) -> None:
    """Validate every setting of a frozen config in place (for __post_init__)."""
    for name, declared in settings_of(type(config)).items():
        object.__setattr__(config, name, declared.check(getattr(config, name)))
