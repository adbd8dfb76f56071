"""Who may take over: experts by name, the scripted one among them, open to users."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any

import numpy as np
from lerobot_env_cronos.expert.expert import ScriptedExpert


class Expert(ABC):
    """Plays whole segments of some streams in the policy's place (`--protocol.takeover_after`).

    Each process makes its own, of its environment, and numbers its own streams from 0. It keeps nothing from one
    segment to the next: a run is saved between two, and resumed without what an expert remembers.
    """

    capacity: int | None = None
    """How many streams it can play at once, in all processes together; None is any number. A person has 1."""

    @abstractmethod
    def begin(self, ids: np.ndarray) -> None:
        """Segments of the streams `ids` (k,) begin, from wherever arm and bodies are; those before are over."""
        ...

    @abstractmethod
    def act(self, o_t: dict[str, Any], tau: list[str]) -> np.ndarray:
        """Return actions (k, A) of the streams that it plays, in physical units, in the order of `ids`.

        It is asked once a control step, also after a stream's scene was put back inside the segment.

        Args:
            o_t: the raw observation of all this process's streams.
            tau: their instructions.
        """
        ...


ExpertFactory = Callable[[Any], Expert]

EXPERTS: dict[str, ExpertFactory] = {}
"""Experts by name."""


def register_expert(name: str) -> Callable[[ExpertFactory], ExpertFactory]:
    """Make an expert selectable as `--protocol.takeover_expert=name`.

    It decorates a class whose constructor, or a function that, takes this process's environment.

    Raises:
        ValueError: the name is taken.
    """

    def register(factory: ExpertFactory) -> ExpertFactory:
        if name in EXPERTS:
            raise ValueError(f"there is an expert {name!r} already; taken names: {sorted(EXPERTS)}.")
        EXPERTS[name] = factory
        return factory

    return register


def check_expert(name: str) -> None:
    """Raise a ValueError that lists the valid names, unless `name` is one of them."""
    if name not in EXPERTS:
        raise ValueError(
            f"protocol.takeover_expert must be one of {sorted(EXPERTS)}, got {name!r}. Register your own with "
            "cronos_lerobot.protocol.experts.register_expert, in a module named by "
            "--protocol.discover_packages_path."
        )


@register_expert("scripted")
class ScriptedTakeover(Expert):
    """The expert of the demonstrations. It sees the simulation's state, whatever the policy sees.

    Args:
        env: a CronosVectorEnv.
    """

    def __init__(self, env: Any) -> None:
        self._env = env

    def begin(self, ids: np.ndarray) -> None:
        """Look at these streams anew, as if there had been none before."""
        self._expert = ScriptedExpert(self._env, streams=ids)

    def act(self, o_t: dict[str, Any], tau: list[str]) -> np.ndarray:
        """What it does in the simulation's state as it is now, under the tasks that the environment has."""
        return self._expert.act()
