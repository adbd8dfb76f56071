"""What task orders and reset strategies keep besides `LoopState` and their generators, for a checkpoint."""

from __future__ import annotations

from collections.abc import Iterable
from copy import deepcopy
from typing import Any

from cronos_lerobot.agents.state import agent_state, as_it_was


def own_states(parts: Iterable[Any]) -> dict[str, dict[str, Any]]:
    """Return a copy of what each of `parts` says in `state_dict()`, by its class, of those that say anything.

    Raises:
        ValueError: one says what a checkpoint cannot hold; the part, the place and the type are named.
    """
    named = {name: part for name, part in _named(parts).items() if hasattr(part, "state_dict")}
    states = {name: as_it_was(agent_state(part)) for name, part in named.items()}
    return {name: deepcopy(state) for name, state in states.items() if state}


def load_own_states(parts: Iterable[Any], states: dict[str, dict[str, Any]]) -> None:
    """Let those of `parts` that `states`, of `own_states`, has something of continue from it."""
    named = _named(parts)
    for name, state in states.items():
        named[name].load_state_dict(state)


def _named(parts: Iterable[Any]) -> dict[str, Any]:
    """By their classes; of one class the second and later ones with a number."""
    named: dict[str, Any] = {}
    for part in parts:
        name = type(part).__name__
        same = sum(other.partition(" ")[0] == name for other in named)
        named[f"{name} {same + 1}" if same else name] = part
    return named
