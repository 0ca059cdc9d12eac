"""What the recogniser says when it is given something it cannot use."""

import re
from typing import Any

MOST_SHOWN = 200  # characters of a value or path that a message repeats
_MOST_LINE = 1000  # characters of a message
_UNPRINTABLE = re.compile(r"[\x00-\x1f\x7f-\x9f\u2028\u2029\ud800-\udfff]")
_LONG_WORD = re.compile(rf"\S{{{MOST_SHOWN + 1},}}")


def one_line(text: str) -> str:
    """The text on one printable line of at most a thousand characters, long words and the whole cut in the middle."""
    text = _LONG_WORD.sub(lambda word: _cut(word.group(), MOST_SHOWN), _cut(text, 100 * _MOST_LINE))
    text = _UNPRINTABLE.sub(lambda c: c.group().encode("unicode_escape").decode(), text)
    return _cut(text, _MOST_LINE)


def shown(value: Any) -> str:
    """A value of any kind as a message repeats it."""
    try:
        return _cut(repr(value), MOST_SHOWN)
    except (RecursionError, ValueError):  # nested without end; a number of more digits than Python prints
        return f"a {type(value).__name__} that cannot be shown"


def _cut(text: str, most: int) -> str:
    return text if len(text) <= most else f"{text[: most // 2 - 3]} ... {text[3 - most // 2 :]}"


class PnvError(ValueError):
    """Unusable input. The message is one line: what was given, and what is allowed.

    However long or broken what was given is, the message stays one printable line of at most a thousand characters.
    """

    def __init__(self, message: str = "") -> None:
        super().__init__(one_line(message))


class ImageError(PnvError):
    """An image that cannot be decoded or described."""


class ModelError(PnvError):
    """A model or checkpoint file that is not one."""


class ConfigError(PnvError):
    """A setting outside its declared limits."""


class MapError(PnvError):
    """A saved map that is damaged, of another model, or not a map."""
