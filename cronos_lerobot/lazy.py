"""Public names of a package that are imported when they are first used: `import cronos_lerobot` costs nothing."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from typing import Any


def lazy_exports(package: str, modules: dict[str, str]) -> tuple[Callable[[str], Any], list[str]]:
    """Return a package's `__getattr__` (PEP 562) and `__all__`.

    Args:
        package: its name.
        modules: names, separated by spaces, by the module below the package that has them.
    """
    home = {name: module for module, names in modules.items() for name in names.split()}

    def get(name: str) -> Any:
        if name not in home:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        return getattr(import_module(f"{package}.{home[name]}"), name)

    return get, sorted(home)
