"""Runs an evaluation part by part, and puts its results together."""

from __future__ import annotations

import json
import logging
import os
import platform
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from functools import cached_property
from typing import Any, Self

import numpy as np
from lerobot_env_cronos import CronosEnvConfig, SequentialVectorEnv, check_environment_id, get_scene, gymnasium_id
from tqdm import tqdm

from cronos_lerobot.evaluation.actors import NOT_REPEATED, Actor, ExpertActor, load_actor
from cronos_lerobot.evaluation.chains import ChainResult, ChainRunner
from cronos_lerobot.evaluation.config import CronosEvalConfig
from cronos_lerobot.evaluation.film import film_best_and_worst, note_drawings
from cronos_lerobot.evaluation.plan import Part, first_name
from cronos_lerobot.evaluation.policy_env import reads_privileged_state, warn_of_privileged_state
from cronos_lerobot.evaluation.results import independent_results, sequential_results
from cronos_lerobot.evaluation.store import (
    ANEW,
    FORMAT,
    RESULTS,
    ResultStore,
    chain_key,
    chain_records,
    write_json,
)
from cronos_lerobot.locks import FolderLock
from cronos_lerobot.provenance import git_commit, package_versions

MAKERS = ("environment", "benchmark", "policy")
"""Fields of an evaluation's identity that every part carries."""

MakeActor = Callable[[SequentialVectorEnv], Actor]


class Evaluation:
    """One evaluation and its folder, which is this process's until `close` or the end of `with`.

    Args:
        config: validated.
        make_actor: makes who acts in an environment; by default what the config says.

    Raises:
        FolderInUseError: another process evaluates into the output folder.
        FileExistsError: the output folder holds something else.
        ValueError: the output folder or a part in it is of another evaluation, or of another version of the
            environments.
    """

    file = RESULTS
    """What came of it, in the output folder."""

    def __init__(self, config: CronosEvalConfig, make_actor: MakeActor | None = None) -> None:
        assert isinstance(config.env, CronosEnvConfig)
        assert config.output_dir is not None
        self.config, self.env_config = config, config.env
        self.scene = get_scene(config.env.scene)
        self.benchmark = config.benchmark()
        self._make_actor = make_actor or self._configured_actor
        self.parts = self._make_parts()
        self._maker = self._made_by()
        with ExitStack() as on_failure:
            # What is missing is known once nobody else can make it.
            self._lock = on_failure.enter_context(FolderLock(config.output_dir))
            self.store = ResultStore(config.output_dir, self._identity())
            self._missing = [part for part in self.parts if not self._is_kept(part)]
            self._leave_out_repeats()
            on_failure.pop_all()

    def _make_parts(self) -> list[Part]:
        return self.config.make_parts()

    def _identity(self) -> dict[str, Any]:
        """Everything that decides what is in the folder."""
        return self.config.identity()

    def prepare(self) -> None:
        """Load the policy, if there is anything left to run.

        Raises:
            ValueError, OSError: a file of it is damaged or missing; a folder without any part is free again.
        """
        if not self._missing:
            return
        try:
            _ = self._env_and_actor
        except Exception:
            self.store.forget_if_empty()
            raise

    def __enter__(self) -> Self:
        """The evaluation itself."""
        return self

    def __exit__(self, *error: object) -> None:
        """Close it."""
        self.close()

    def close(self) -> None:
        """Close the environment and give the folder back."""
        self._close_env()
        self._lock.release()

    def run(self) -> dict[str, Any]:
        """Run the parts that are not there yet, write videos and results.json, close; returns the results."""
        with self:
            return self._run_and_report()

    def _run_and_report(self) -> dict[str, Any]:
        if {part.name for part in self._missing} & set(self.store.names()):
            # Half of the parts that it names would not be those that it was made from.
            (self.store.folder / self.file).unlink(missing_ok=True)
        try:
            self._run(self._missing)
        finally:
            self._close_env()
        self._leave_out_repeats()
        results = self.results()
        note_drawings(self.store.folder, self.env_config)
        write_json(self.store.folder / self.file, results)
        if left_out := set(self.store.names()) - {part.name for part in self.parts}:
            logging.warning(
                "%s has what the flags name, and not %s, which the folder has too.",
                self.file, ", ".join(sorted(left_out)),
            )  # fmt: skip
        if self.config.eval.videos:
            results["videos"] = film_best_and_worst(
                self.store,
                [part for part in self.parts if self._is_filmed(part)],
                self.env_config,
                self.config.eval.videos,
            )
            write_json(self.store.folder / self.file, results)
        return results

    def _run(self, missing: Sequence[Part]) -> None:
        total = sum(len(part.chains) for part in self.parts)
        done = total - sum(len(part.chains) for part in missing)
        with tqdm(total=total, initial=done, unit="chain", disable=None, smoothing=0.1) as bar:
            for part in missing:
                if self._is_repeat(part):
                    bar.total -= len(part.chains)
                    continue
                if part.repetition == 0:
                    for outdated in self.store.folder.glob(f"videos/{part.suite}_{part.split}_*.mp4"):
                        outdated.unlink()
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
        seed = self.config.seed + part.repetition
        actor.seed(part.actor_seed(seed))
        runner = ChainRunner(env, actor, keeps_states=self._is_filmed(part))
        results = runner.run(part.chains, part.noise(seed), show)
        records = chain_records(results)
        content = {
            "suite": part.suite,
            "split": part.split,
            "seed": seed,
            "date": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
            "seconds": time.perf_counter() - start,
            "made_by": self._maker,
            "temperature": actor.temperature,
            "drew": actor.drew,
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

    def _is_filmed(self, part: Part) -> bool:
        return self.config.eval.videos > 0 and part.repetition == 0

    # What is there already ---------------------------------------------------------------------------------

    def _made_by(self) -> dict[str, Any]:
        """What a part made now is made by, and with."""
        identity = self.config.identity()
        return {name: identity[name] for name in MAKERS} | {
            "versions": {"python": platform.python_version()} | package_versions(),
            "opengl_platform": os.environ.get("MUJOCO_GL"),
            "commit": git_commit(),
        }

    def _is_kept(self, part: Part) -> bool:
        """Whether a part is there and need not be run again.

        It is run again if other packages made it, or if it has no states and videos are asked for now. A part of
        another commit is kept: results.json names them all.
        """
        what = f"part {part.name} in {self.store.folder}"
        try:
            content = self.store.read(part.name)
        except ValueError as error:
            logging.warning(f"{what} is damaged ({error}): it is made again")
            return False
        if content is None:
            return False
        there = content.get("made_by", {})
        check_environment_id(there.get("environment"), what, ANEW)
        for name in MAKERS:
            if there[name] != self._maker[name]:
                raise ValueError(
                    f"{what} was made by another {name}: {there[name]} there, {self._maker[name]} now; choose "
                    "another --output_dir, or delete it to have it made again"
                )
        if there["versions"] != self._maker["versions"]:
            changes = _changes(there["versions"], self._maker["versions"])
            logging.warning(f"{what} was made with other packages ({changes}): it is made again")
            return False
        if self._is_filmed(part) and not self.store.has_trajectories(part.name):
            logging.info(f"{what} has no states to draw videos from: it is run again")
            return False
        return True

    def _is_repeat(self, part: Part) -> bool:
        """Whether a part would be the one of repetition 0 once more, whose policy drew nothing."""
        # Parts of earlier commits do not say it.
        return part.repetition > 0 and not (self.store.read(first_name(part.split)) or {}).get("drew", True)

    def _leave_out_repeats(self) -> None:
        kept = [part for part in self.parts if not self._is_repeat(part)]
        if len(kept) < len(self.parts):
            logging.warning(NOT_REPEATED, self.config.eval.repetitions)
        self.parts, self._missing = kept, [part for part in self._missing if part in kept]

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
        warn_of_privileged_state(config.policy)
        return load_actor(config.policy, self.env_config, config.eval.temperature, config.rename_map)

    def _close_env(self) -> None:
        if "_env_and_actor" in self.__dict__:
            self._env_and_actor[0].close()

    # What came of it --------------------------------------------------------------------------------------

    def results(self) -> dict[str, Any]:
        """Put all parts together; see docs/evaluation.md."""
        contents = [self.store.read(part.name) for part in self.parts]
        finished = [content for content in contents if content is not None]
        assert len(finished) == len(self.parts)
        config = self.config
        makers = self._makers()
        commits = {maker["commit"] for maker in makers}
        header = {
            "format": FORMAT,
            "policy": config.policy_name,
            "policy_fingerprint": config.policy_fingerprint,
            "policy_files": config.policy_files,
            "policy_revision": config.source.revision if config.source else None,
            "scene": self.scene.name,
            "benchmark": {
                "environment": gymnasium_id(self.scene.name),
                "fingerprint": self.benchmark.fingerprint,
                "source": self.benchmark.source,
            },
            "obs_type": self.env_config.obs_type,
            "reads_privileged_state": config.policy is not None and reads_privileged_state(config.policy),
            # Parts of earlier commits do not say it.
            "temperature": finished[0].get("temperature", config.eval.temperature),
            "seed": config.seed,
            "repetitions": 1 + max(part.repetition for part in self.parts),
            "advance": config.advance,
            "end_effector_reset": config.end_effector_reset,
            "renderer": self.env_config.renderer,
            "versions": self._maker["versions"],
            "commit": commits.pop() if len(commits) == 1 else None,
            "made_by": makers,
            "date": max(content["date"] for content in finished),
            "seconds": round(sum(content["seconds"] for content in finished), 1),
            "config": config.to_dict(),
            "identity": config.identity(),
        }
        return header | {suite: self._suite_results(suite, finished) for suite in config.suites}

    def _makers(self) -> list[dict[str, Any]]:
        """Who made the parts: one entry, or more if the evaluation was gone on with after a change."""
        makers: dict[str, dict[str, Any]] = {}
        for part in self.parts:
            content = self.store.read(part.name)
            if content is None:
                # Stopped before it.
                continue
            maker = makers.setdefault(
                json.dumps(content["made_by"], sort_keys=True), content["made_by"] | {"parts": []}
            )
            maker["parts"].append(part.name)
        return list(makers.values())

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
                found[split] = sequential_results(records, [group.tasks for group in groups], self.scene)
        return found


def _changes(there: dict[str, str], here: dict[str, str]) -> str:
    names = [name for name in sorted(there | here) if there.get(name) != here.get(name)]
    return ", ".join(f"{name} {there.get(name)}, now {here.get(name)}" for name in names)
