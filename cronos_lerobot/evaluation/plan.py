"""What an evaluation consists of: parts that are run, kept and, after a kill, not run again."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from lerobot_env_cronos import Benchmark, EpisodeGroup
from lerobot_env_cronos.benchmark.benchmark import SUITES
from lerobot_env_cronos.benchmark.configurations import SPLITS
from lerobot_env_cronos.scene.scenes import STEPS_PER_TASK

from cronos_lerobot.evaluation.chains import Chain, Noise, chain_noise

ORDERINGS_PER_PART = 2
"""Of the sequential suite: 128 chains, about a minute of work."""


@dataclass(frozen=True)
class Part:
    """Chains of one suite and split that are run together."""

    name: str
    suite: str
    split: str
    chains: tuple[Chain, ...]
    repetition: int = 0
    """How often the same chains come before it; each time they have the next seed."""
    block: int = 0
    """Of those that --stop_at_error runs of a suite and split, one after the other; 0 without it."""

    def noise(self, seed: int) -> Noise:
        """The randomness of its chains under its seed, the evaluation's plus `repetition`."""
        return chain_noise(STEPS_PER_TASK, seed, SUITES.index(self.suite), SPLITS.index(self.split))

    def actor_seed(self, seed: int) -> int:
        """What an actor with randomness of its own is seeded with, under the part's seed.

        Another one for each block: no two of them draw the same numbers.
        """
        return int(np.random.SeedSequence([seed, self.block]).generate_state(1)[0]) if self.block else seed


def make_parts(
    benchmark: Benchmark,
    suites: Sequence[str],
    splits: Sequence[str],
    num_configurations: int,
    num_orderings: int,
    repetitions: int = 1,
) -> list[Part]:
    """Return the parts of an evaluation, suite by suite and split by split.

    Args:
        benchmark: whose episodes and chains they are.
        suites: some of `SUITES`.
        splits: some of `train`, `held_out`.
        num_configurations: the first ones of each task and ordering.
        num_orderings: the first ones of each split.
        repetitions: of every episode of the independent suite.
    """
    parts = []
    for suite in suites:
        for split in splits:
            groups = benchmark.groups(suite, split)
            if suite == "independent":
                chains = _chains(groups, num_configurations)
                first = first_name(split)
                names = [first, *(f"{first}_again{i}" for i in range(1, repetitions))]
                parts += [Part(name, suite, split, chains, i) for i, name in enumerate(names)]
                continue
            groups = groups[:num_orderings]
            for start in range(0, len(groups), ORDERINGS_PER_PART):
                chains = _chains(groups[start : start + ORDERINGS_PER_PART], num_configurations)
                parts.append(Part(f"sequential_{split}_{start}", suite, split, chains))
    return parts


def first_name(split: str) -> str:
    """Name of the part that has a split's independent episodes for the first time."""
    return f"independent_{split}"


def _chains(groups: Sequence[EpisodeGroup], num_configurations: int) -> tuple[Chain, ...]:
    return tuple(
        Chain(group.number, group.tasks, configuration)
        for group in groups
        for configuration in group.configurations[:num_configurations]
    )
