"""Runs an evaluation part by part, and puts its results together."""

from __future__ import annotations

import logging
import os
import platform
import time
from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any

import numpy as np
from lerobot.envs.factory import make_env_pre_post_processors
from lerobot.policies import make_policy, make_pre_post_processors
from lerobot.policies.factory import get_policy_class
from lerobot_env_cronos import CronosEnvConfig, SequentialVectorEnv, get_scene, gymnasium_id
from tqdm import tqdm

from cronos_lerobot.agents.processing import make_processors
from cronos_lerobot.evaluation.actors import Actor, ExpertActor, make_actor
from cronos_lerobot.evaluation.chains import ChainResult, ChainRunner
from cronos_lerobot.evaluation.config import EXPERT, CronosEvalConfig
from cronos_lerobot.evaluation.film import film_best_and_worst
from cronos_lerobot.evaluation.plan import Part, make_parts
from cronos_lerobot.evaluation.results import independent_results, sequential_results
from cronos_lerobot.evaluation.store import RESULTS, ResultStore, chain_key, chain_records, write_json
from cronos_lerobot.provenance import git_commit, package_versions

FORMAT = 1
"""Version of results.json."""

MakeActor = Callable[[SequentialVectorEnv], Actor]


class Evaluation:
    """One evaluation and its folder.

    Args:
        config: validated.
        make_actor: makes who acts in an environment; by default what the config says.

    Raises:
        FileExistsError: the output folder holds something else.
        ValueError: the output folder is of another evaluation.
    """

    def __init__(self, config: CronosEvalConfig, make_actor: MakeActor | None = None) -> None:
        assert isinstance(config.env, CronosEnvConfig)
        assert config.output_dir is not None
        self.config, self.env_config = config, config.env
        self.scene = get_scene(config.env.scene)
        self.benchmark = config.benchmark()
        self._make_actor = make_actor or self._configured_actor
        self.parts = make_parts(
            self.benchmark, config.suites, config.splits, config.num_configurations, config.num_orderings
        )
        self.store = ResultStore(config.output_dir, config.identity())

    def run(self) -> dict[str, Any]:
        """Run the parts that are not there yet, write videos and results.json; returns the results."""
        missing = [part for part in self.parts if self.store.read(part.name) is None]
        try:
            self._run(missing)
        finally:
            self._close()
        results = self.results()
        write_json(self.store.folder / RESULTS, results)
        if self.config.eval.videos:
            results["videos"] = film_best_and_worst(
                self.store, self.parts, self.env_config, self.config.eval.videos
            )
            write_json(self.store.folder / RESULTS, results)
        return results

    def _run(self, missing: Sequence[Part]) -> None:
        total = sum(len(part.chains) for part in self.parts)
        done = total - sum(len(part.chains) for part in missing)
        with tqdm(total=total, initial=done, unit="chain", disable=None, smoothing=0.1) as bar:
            for part in missing:
                self._run_part(part, bar)

    def _run_part(self, part: Part, bar: tqdm) -> None:
        lengths: list[int] = []

        def summary() -> str:
            first = f"{np.mean([n > 0 for n in lengths]):.2f}"
            is_chain = part.suite == "sequential"
            return f"SEQ 0 {first}, chain length {np.mean(lengths):.2f}" if is_chain else f"success {first}"

        def show(result: ChainResult) -> None:
            lengths.append(result.length)
            bar.set_postfix_str(f"{part.suite} {part.split}: {summary()}", refresh=False)
            bar.update()

        start = time.perf_counter()
        env, actor = self._env_and_actor
        env.split = part.split
        # Every part begins like this, so that it ends the same whether others ran before it or not.
        actor.seed(self.config.seed)
        runner = ChainRunner(env, actor, keeps_states=self.config.eval.videos > 0)
        results = runner.run(part.chains, part.noise(self.config.seed), show)
        records = chain_records(results)
        content = {
            "suite": part.suite,
            "split": part.split,
            "date": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
            "seconds": time.perf_counter() - start,
            "chains": records,
        }
        kept = {
            chain_key(record): result.trajectory
            for record, result in zip(records, results, strict=True)
            if result.trajectory is not None
        }
        self.store.write(part.name, content, kept)
        if bar.disable:
            logging.info(f"{part.name}: {len(records)} chains, {summary()}, {content['seconds']:.0f} s")

    # Who acts where ---------------------------------------------------------------------------------------

    @cached_property
    def _env_and_actor(self) -> tuple[SequentialVectorEnv, Actor]:
        env = SequentialVectorEnv(
            min(self.config.eval.batch_size, max(len(part.chains) for part in self.parts)),
            self.scene.name,
            ordering=self.scene.tasks,
            advance=self.config.advance,
            end_effector_reset=self.config.end_effector_reset,
            **self.env_config.gym_kwargs,
        )
        return env, self._make_actor(env)

    def _configured_actor(self, env: SequentialVectorEnv) -> Actor:
        config = self.config
        if config.policy is None:
            return ExpertActor(env)
        policy: Any = make_policy(config.policy, env_cfg=config.env, rename_map=config.rename_map)
        processors = make_pre_post_processors(
            config.policy,
            str(config.policy.pretrained_path),
            preprocessor_overrides={
                "device_processor": {"device": str(policy.config.device)},
                "rename_observations_processor": {"rename_map": config.rename_map},
            },
        )
        env_processors = make_env_pre_post_processors(env_cfg=config.env, policy_cfg=config.policy)
        return make_actor(policy, make_processors(policy, *processors), config.eval.temperature, env_processors)

    def _close(self) -> None:
        if "_env_and_actor" in self.__dict__:
            self._env_and_actor[0].close()

    # What came of it --------------------------------------------------------------------------------------

    def results(self) -> dict[str, Any]:
        """Put all parts together; see docs/evaluation.md."""
        contents = [self.store.read(part.name) for part in self.parts]
        finished = [content for content in contents if content is not None]
        assert len(finished) == len(self.parts)
        config = self.config
        header = {
            "format": FORMAT,
            "policy": EXPERT if config.policy is None else str(config.policy.pretrained_path),
            "scene": self.scene.name,
            "benchmark": {
                "environment": gymnasium_id(self.scene.name),
                "fingerprint": self.benchmark.fingerprint,
                "source": self.benchmark.source,
            },
            "obs_type": self.env_config.obs_type,
            "temperature": config.eval.temperature if self._has_temperature() else None,
            "seed": config.seed,
            "advance": config.advance,
            "end_effector_reset": config.end_effector_reset,
            "renderer": self.env_config.renderer,
            "opengl_platform": os.environ.get("MUJOCO_GL"),
            "versions": {"python": platform.python_version()} | package_versions(),
            "commit": git_commit(),
            "date": max(content["date"] for content in finished),
            "seconds": round(sum(content["seconds"] for content in finished), 1),
            "config": config.to_dict(),
            "identity": config.identity(),
        }
        return header | {suite: self._suite_results(suite, finished) for suite in config.suites}

    def _has_temperature(self) -> bool:
        """Whether actions are sampled at the config's temperature, or at whatever the policy does by itself."""
        return self.config.policy is not None and hasattr(
            get_policy_class(self.config.policy.type), "sample_actions"
        )

    def _suite_results(self, suite: str, finished: Sequence[dict[str, Any]]) -> dict[str, Any]:
        found = {}
        for split in self.config.splits:
            records = [
                record
                for content in finished
                if (content["suite"], content["split"]) == (suite, split)
                for record in content["chains"]
            ]
            groups = self.benchmark.groups(suite, split)
            if suite == "independent":
                found[split] = independent_results(records, [group.tasks[0] for group in groups])
            else:
                found[split] = sequential_results(records, [group.tasks for group in groups])
        return found
