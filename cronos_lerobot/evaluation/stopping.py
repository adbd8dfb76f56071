"""`cronos-eval --stop_at_error`: an evaluation that ends as soon as a policy is told apart from another one."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from lerobot_env_cronos import gymnasium_id
from lerobot_env_cronos.benchmark.benchmark import SUITES
from lerobot_env_cronos.benchmark.configurations import SPLITS
from tqdm import tqdm

from cronos_lerobot.evaluation.chains import Chain
from cronos_lerobot.evaluation.config import CronosEvalConfig
from cronos_lerobot.evaluation.outcomes import Episode, Outcomes, shared_episodes
from cronos_lerobot.evaluation.plan import Part
from cronos_lerobot.evaluation.runner import Evaluation, MakeActor
from cronos_lerobot.evaluation.sign_flip import SequentialSignTest
from cronos_lerobot.evaluation.store import COMPARISON

LOOK_EVERY = 32
"""Chains between two looks, which run together. With looks after each the test would stop 5 to 15 chains earlier,
and leave all environments but one idle."""
DECISIONS = {1: "better", -1: "worse", 0: "not separated"}
FORMAT = 1
"""Version of comparison.json."""


def planned_outcomes(config: CronosEvalConfig) -> Outcomes:
    """The episodes that an evaluation would run, as if none had succeeded yet.

    Args:
        config: validated.
    """
    benchmark = config.benchmark()
    episodes = {
        Episode(part.suite, part.split, chain.number, chain.configuration, config.seed + part.repetition): 0
        for part in config.make_parts()
        for chain in part.chains
    }
    setting = {
        "scene": benchmark.scene.name,
        "environment": gymnasium_id(benchmark.scene.name),
        "benchmark": benchmark.fingerprint,
        "advance": config.advance,
        "end_effector_reset": config.end_effector_reset,
    }
    return Outcomes(config.policy_name, config.policy_fingerprint, setting, episodes)


def check_pairs(reference: Outcomes, config: CronosEvalConfig) -> None:
    """Check that every suite and split to be evaluated has episodes that the reference has.

    Raises:
        ValueError: one has none; the sentence names what differs.
    """
    planned = planned_outcomes(config)
    for pair in planned.suites:
        shared_episodes(reference, planned, *pair)


class StoppingEvaluation(Evaluation):
    """An evaluation of the episodes of another one, in a random order, until it is decided which did better.

    Each suite and split is a test of its own (`SequentialSignTest`). The order is random, or the first episodes
    would be those of one task; it is that of the seed, so an evaluation goes on after a kill. The test is of the
    episodes of the benchmark, each as likely as any other.

    Args:
        config: validated, with `stop_at_error`.
        reference: what the other policy did.
        make_actor: as of Evaluation.

    Raises:
        ValueError: the episodes cannot be paired, or as Evaluation.
        FileExistsError: as Evaluation.
    """

    file = COMPARISON

    def __init__(self, config: CronosEvalConfig, reference: Outcomes, make_actor: MakeActor | None = None) -> None:
        assert config.stop_at_error is not None
        self.reference, self.error = reference, config.stop_at_error
        super().__init__(config, make_actor)

    def _make_parts(self) -> list[Part]:
        chains: dict[tuple[str, str], list[Chain]] = {}
        for part in super()._make_parts():
            chains.setdefault((part.suite, part.split), []).extend(part.chains)
        return [block for (suite, split), some in chains.items() for block in self._blocks(suite, split, some)]

    def _blocks(self, suite: str, split: str, chains: Sequence[Chain]) -> Iterator[Part]:
        """The chains that the reference ran, too, in a random order, some for each look."""
        shared = [chain for chain in chains if self._episode(suite, split, chain) in self.reference.lengths]
        key = self.config.seed, SUITES.index(suite), SPLITS.index(split)
        order = np.random.default_rng(key).permutation(len(shared))
        for block, start in enumerate(range(0, len(shared), LOOK_EVERY)):
            some = tuple(shared[i] for i in order[start : start + LOOK_EVERY])
            yield Part(f"compared_{suite}_{split}_{start:05d}", suite, split, some, block=block)

    def _episode(self, suite: str, split: str, chain: Chain) -> Episode:
        return Episode(suite, split, chain.number, chain.configuration, self.config.seed)

    def _identity(self) -> dict[str, Any]:
        outcomes = sorted((*episode, length) for episode, length in self.reference.lengths.items())
        digest = hashlib.sha256(json.dumps(outcomes).encode()).hexdigest()[:16]
        return super()._identity() | {"compared_with": digest, "stop_at_error": self.error}

    def _run(self, missing: Sequence[Part]) -> None:
        with tqdm(total=sum(len(part.chains) for part in self.parts), unit="chain", disable=None) as bar:
            for parts in self._by_test().values():
                test = self._test(parts)
                for part in parts:
                    if part in missing:
                        self._run_part(part, bar)
                    else:
                        bar.update(len(part.chains))
                    if test.look(self._differences(part)):
                        break

    def _by_test(self) -> dict[tuple[str, str], list[Part]]:
        found: dict[tuple[str, str], list[Part]] = {}
        for part in self.parts:
            found.setdefault((part.suite, part.split), []).append(part)
        return found

    def _test(self, parts: Sequence[Part]) -> SequentialSignTest:
        return SequentialSignTest(self.error, sum(len(part.chains) for part in parts))

    def _lengths(self, part: Part) -> tuple[np.ndarray, np.ndarray]:
        """Tasks completed by the reference and by this policy, of each chain of a finished part."""
        content = self.store.read(part.name)
        assert content is not None
        own = [record["length"] for record in content["chains"]]
        theirs = [self.reference.lengths[self._episode(part.suite, part.split, chain)] for chain in part.chains]
        return np.array(theirs), np.array(own)

    def _differences(self, part: Part) -> list[int]:
        theirs, own = self._lengths(part)
        return (own - theirs).tolist()

    def results(self) -> dict[str, Any]:
        """What was decided, see docs/evaluation.md."""
        config, contents = self.config, [self.store.read(part.name) for part in self.parts]
        finished = [content for content in contents if content is not None]
        return {
            "format": FORMAT,
            "policy": config.policy_name,
            "policy_fingerprint": config.policy_fingerprint,
            "reference": {"policy": self.reference.policy, "policy_fingerprint": self.reference.fingerprint},
            "stop_at_error": self.error,
            "date": max(content["date"] for content in finished),
            "seconds": round(sum(content["seconds"] for content in finished), 1),
            "made_by": self._makers(),
            "config": config.to_dict(),
            "identity": self._identity(),
            "tests": [self._decision(*key, parts) for key, parts in self._by_test().items()],
        }

    def _decision(self, suite: str, split: str, parts: Sequence[Part]) -> dict[str, Any]:
        test, lengths = self._test(parts), []
        for part in parts:
            lengths.append(self._lengths(part))
            if test.look(self._differences(part)):
                break
        theirs, own = (np.concatenate(some) for some in zip(*lengths, strict=True))
        return {
            "suite": suite,
            "split": split,
            "decision": DECISIONS[test.decision],
            "episodes": test.n,
            "planned": test.planned,
            "policy": float(own.mean()),
            "reference": float(theirs.mean()),
            "policy_ahead": int((own > theirs).sum()),
            "reference_ahead": int((own < theirs).sum()),
            "error_spent": test.spent,
        }


def decision_text(results: dict[str, Any]) -> str:
    """A line for each test of comparison.json."""
    reference, lines = results["reference"]["policy"], []
    for test in results["tests"]:
        words = f"{test['decision']} {'from' if test['decision'] == DECISIONS[0] else 'than'} {reference}"
        number = "success" if test["suite"] == "independent" else "chain length"
        lines.append(
            f"{test['suite']} {test['split']}: {words}, after {test['episodes']} of {test['planned']} episodes"
            f" at an error of {results['stop_at_error']} ({number} {test['policy']:.3f} against"
            f" {test['reference']:.3f}; {test['policy_ahead']} episodes for it, {test['reference_ahead']} against)"
        )
    if any(test["decision"] != DECISIONS[0] for test in results["tests"]):
        lines.append(
            "A test that stops at a decision says who is better; by how much takes the whole evaluation, without"
            " --stop_at_error."
        )
    return "\n".join(lines)
