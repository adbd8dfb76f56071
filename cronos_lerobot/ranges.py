"""Config fields that say which values they take, and the one function that checks them."""

from __future__ import annotations

import math
import operator
from collections.abc import Callable
from dataclasses import field, fields, is_dataclass
from typing import Any

TESTS: dict[str, tuple[str, Callable[[Any, Any], bool]]] = {
    "minimum": (">=", operator.ge),
    "above": (">", operator.gt),
    "maximum": ("<=", operator.le),
    "below": ("<", operator.lt),
    "choices": ("one of", lambda value, choices: value in choices),
}


def limits(**tests: Any) -> dict[str, Any]:
    """Metadata of a dataclass field whose values `check_ranges` checks.

    Args:
        tests: `minimum`, `above`, `maximum`, `below` or `choices`; of a list they hold for each element.
    """
    assert tests.keys() <= TESTS.keys()
    return {"limits": tests}


def ranged(default: Any, **tests: Any) -> Any:
    """A dataclass field with a default and the `limits` of its values."""
    return field(default=default, metadata=limits(**tests))


def check_ranges(config: Any, prefix: str = "") -> None:
    """Check every field of a config and of the configs in it.

    Args:
        config: a dataclass.
        prefix: of its flags, such as `eval.`.

    Raises:
        ValueError: a value is out of its range, not finite, or null where its type is not `... | None`.
    """
    for one in fields(config):
        flag, value = f"{prefix}{one.name}", getattr(config, one.name)
        if is_dataclass(value):
            check_ranges(value, f"{flag}.")
        elif (tests := _limits(type(config), one.name)) and not (value is None and "None" in str(one.type)):
            _check(flag, value, tests)


def _limits(config: type, name: str) -> dict[str, Any]:
    """Those of a field, also where a subclass gives it another default."""
    found = (getattr(base, "__dataclass_fields__", {}).get(name) for base in config.__mro__)
    return next((one.metadata["limits"] for one in found if one and "limits" in one.metadata), {})


def _check(flag: str, value: Any, tests: dict[str, Any]) -> None:
    values = value if isinstance(value, list) else [value]
    fits = all(one is not None and (isinstance(one, str) or math.isfinite(one)) for one in values)
    fits = fits and all(TESTS[name][1](one, limit) for one in values for name, limit in tests.items())
    if not fits:
        wanted = " and ".join(f"{TESTS[name][0]} {limit}" for name, limit in tests.items())
        raise ValueError(f"--{flag} must be {wanted}, got {value!r}.")
