"""One seed, many independent named random streams, all of which a checkpoint can hold."""

from __future__ import annotations

import zlib
from typing import Any

import numpy as np
import torch


class NamedGenerators:
    """Random generators by name. What one consumer draws never changes what another one gets.

    Args:
        seed: of the run.
        device: of the torch generators.
    """

    def __init__(self, seed: int, device: str | None = None) -> None:
        self.seed = seed
        self.device = device or "cpu"
        self._numpy: dict[str, np.random.Generator] = {}
        self._torch: dict[str, torch.Generator] = {}

    def for_numpy(self, name: str) -> np.random.Generator:
        """Return the NumPy generator `name`."""
        if name not in self._numpy:
            self._numpy[name] = np.random.default_rng(self._sequence(name))
        return self._numpy[name]

    def for_torch(self, name: str) -> torch.Generator:
        """Return the torch generator `name`."""
        if name not in self._torch:
            generator = torch.Generator(device=self.device)
            generator.manual_seed(self._torch_seed(name))
            self._torch[name] = generator
        return self._torch[name]

    def state_dict(self) -> dict[str, Any]:
        """Return the state of every generator made so far, JSON-ready."""
        return {
            "numpy": {name: rng.bit_generator.state for name, rng in self._numpy.items()},
            "torch": {name: rng.get_state().tolist() for name, rng in self._torch.items()},
        }

    def load_state_dict(self, state: dict[str, Any], step: int) -> None:
        """Continue every generator made so far where `state` has it; one that it does not know begins anew.

        Those of torch that another kind of device drew with cannot be continued: they begin with numbers that
        belong to `step`, so that what was drawn before does not come again.

        Args:
            state: of `state_dict`.
            step: that the run continues from.
        """
        for name, rng in self._numpy.items():
            if name in state["numpy"]:
                rng.bit_generator.state = state["numpy"][name]
        for name, generator in self._torch.items():
            if name not in state["torch"]:
                continue
            saved = torch.tensor(state["torch"][name], dtype=torch.uint8)
            # Each kind of device has a state of its own length.
            if len(saved) == len(generator.get_state()):
                generator.set_state(saved)
            else:
                generator.manual_seed(self._torch_seed(name, step))

    def _torch_seed(self, name: str, *entropy: int) -> int:
        return int(self._sequence(name, *entropy).generate_state(1, np.uint64)[0] >> 1)

    def _sequence(self, name: str, *entropy: int) -> np.random.SeedSequence:
        return np.random.SeedSequence([self.seed, zlib.crc32(name.encode()), *entropy])
