"""Registries of what users may add by name."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

Factory = TypeVar("Factory", bound=Callable)


class Registry(dict[str, Factory]):
    """Factories by name.

    Args:
        flag: which chooses one of them, as `--protocol.task_order`.
        decorator: how users register theirs, as `cronos_lerobot.protocol.register_task_order`.
    """

    def __init__(self, flag: str, decorator: str) -> None:
        super().__init__()
        self._flag, self._decorator = flag, decorator

    def register(self, name: str) -> Callable[[Factory], Factory]:
        """Return a decorator that makes a factory selectable as `name`.

        Raises:
            ValueError: the name is taken.
        """

        def decorate(factory: Factory) -> Factory:
            if name in self:
                raise ValueError(f"{self._flag}={name} is registered already, as are {sorted(self)}.")
            self[name] = factory
            return factory

        return decorate

    def check(self, name: str) -> None:
        """Raise a ValueError that lists the valid names, unless `name` is one of them."""
        if name not in self:
            raise ValueError(
                f"{self._flag} must be one of {sorted(self)}, got {name!r}. Register your own with "
                f"{self._decorator}, in a module named by --protocol.discover_packages_path."
            )
