"""Parts that are chosen by name: those of the package, loaded when first asked for, and those a program adds."""

from collections.abc import Callable
from importlib import import_module
from typing import Any, Generic, TypeVar

from pnv_core.errors import PnvError

T = TypeVar("T")


class Registry(Generic[T]):
    """Makers of one kind of part by name. `built_in` gives "module:attribute" of each."""

    def __init__(self, kind: str, built_in: dict[str, str], error: type[PnvError]) -> None:
        self._kind = kind
        self._makers: dict[str, str | Callable[..., T]] = dict(built_in)
        self._error = error

    def register(self, name: str, make: Callable[..., T]) -> None:
        """Add a part from outside, or replace one."""
        self._makers[name] = make

    def names(self) -> list[str]:
        return list(self._makers)

    def make(self, name: str, *args: Any, **options: Any) -> T:
        """The part of this name. Raises the registry's error for a name that nobody registered."""
        if name not in self._makers:
            raise self._error(f"{self._kind} = {name!r} is not known; allowed: one of {', '.join(self._makers)}")
        maker = self._makers[name]
        if isinstance(maker, str):
            module, _, attribute = maker.partition(":")
            maker = getattr(import_module(module), attribute)
        return maker(*args, **options)
