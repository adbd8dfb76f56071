"""What an evaluation consists of: parts that are run, kept and, after a kill, not run again."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from lerobot_env_cronos import load_orderings
from lerobot_env_cronos.configurations import SPLITS
from lerobot_env_cronos.scenes import STEPS_PER_TASK, get_scene

from cronos_lerobot.evaluation.chains import Chain, Noise, chain_noise

SUITES = ("independent", "sequential")
ORDERINGS_PER_PART = 2
"""Of the sequential suite: 128 chains, about a minute of work."""


@dataclass(frozen=True)
class Part:
    """Chains of one suite and split that are run together."""

    name: str
    suite: str
    split: str
    chains: tuple[Chain, ...]

    def noise(self, seed: int) -> Noise:
        """The randomness of its chains under the evaluation's seed."""
        return chain_noise(STEPS_PER_TASK, seed, SUITES.index(self.suite), SPLITS.index(self.split))


def make_parts(
    scene: str, suites: Sequence[str], splits: Sequence[str], num_configurations: int, num_orderings: int
) -> list[Part]:
    """Return the parts of an evaluation, suite by suite and split by split.

    Args:
        scene: its name.
        suites: some of `SUITES`.
        splits: some of `train`, `held_out`.
        num_configurations: the first ones of each split.
        num_orderings: the first ones of the scene.
    """
    configurations = range(num_configurations)
    parts = []
    for suite in suites:
        for split in splits:
            if suite == "independent":
                tasks = enumerate(get_scene(scene).tasks)
                chains = [Chain(i, (task,), c) for i, task in tasks for c in configurations]
                parts.append(Part(f"independent_{split}", suite, split, tuple(chains)))
                continue
            orderings = list(enumerate(load_orderings(scene)))[:num_orderings]
            for start in range(0, len(orderings), ORDERINGS_PER_PART):
                some = orderings[start : start + ORDERINGS_PER_PART]
                chains = [Chain(i, ordering, c) for i, ordering in some for c in configurations]
                parts.append(Part(f"sequential_{split}_{start}", suite, split, tuple(chains)))
    return parts
