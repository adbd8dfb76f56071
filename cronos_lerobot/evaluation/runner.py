"""Runs an evaluation, suite by suite and split by split; what has its results.json is done."""

from __future__ import annotations

import logging
import os
import platform
import time
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from lerobot_env_cronos import CronosVectorEnv
from tqdm import tqdm

from cronos_lerobot.agents.base import Actor
from cronos_lerobot.evaluation.actors import ExpertActor, load_actor
from cronos_lerobot.evaluation.chains import Chain, ChainResult, ChainRunner
from cronos_lerobot.evaluation.config import CronosEvalConfig, check_same
from cronos_lerobot.evaluation.eval_info import EVAL_INFO, write_eval_info
from cronos_lerobot.evaluation.policy_env import warn_of_inputs
from cronos_lerobot.evaluation.results import (
    RESULTS,
    describe_episodes,
    folder_name,
    numbers_of,
    read_results,
    result_files,
    write_json,
)
from cronos_lerobot.evaluation.suites import (
    STREAM,
    benchmark_of,
    classify_starts,
    rules_of,
    sampling_seed,
)
from cronos_lerobot.locks import FolderLock
from cronos_lerobot.protocol.streams import Draws, Streams, create_eval_streams, steps_per_task
from cronos_lerobot.provenance import git_commit, package_versions

Render = Callable[[np.ndarray], np.ndarray]
Draw = Callable[[Path, dict[str, Any], Sequence[ChainResult], Render, int, float], None]
"""Draws videos and pictures, see `film.suites.draw_suite`."""


@dataclass(frozen=True)
class Film:
    """How chains are filmed: what is kept of them, and how it becomes frames."""

    states: Callable[[np.ndarray], np.ndarray]
    render: Render
    num_kept: int | None = None
    """Frames take space: of a world that keeps them only the first chains are filmed."""


class Evaluation:
    """An evaluation in its output folder.

    Args:
        config: resolved.
        draw: draws videos and pictures of a suite and split into its folder; None draws nothing.

    Raises:
        ValueError: a results.json in the output folder is of another policy or setting, or damaged.
        FileExistsError: the output folder has an eval_info.json of `lerobot-eval`.
    """

    def __init__(self, config: CronosEvalConfig, draw: Draw | None = None) -> None:
        assert config.output_dir is not None
        self.config, self.folder, self._draw = config, config.output_dir, draw
        pairs = [(suite, split) for suite in config.eval.suites for split in config.eval.splits]
        # What the world is; more streams of it are made where they are needed.
        self.world: Streams = create_eval_streams(config.env, 1)
        config.check_world(self.world)
        # A world that writes files of its own has them here.
        self.world.folder = self.folder  # ty: ignore[missing-attribute]
        self.benchmark = benchmark_of(self.world)
        self.chains = {pair: config.chains(self.benchmark, *pair) for pair in dict.fromkeys(pairs)}
        done = [self._check(file) for file in result_files(self.folder) if file.is_file()]
        if not done and (self.folder / EVAL_INFO).exists():
            raise FileExistsError(f"{self.folder} has an evaluation of lerobot-eval: choose another --output_dir")
        self.missing = [pair for pair in self.chains if pair not in done]

    def _check(self, file: Path) -> tuple[str, str]:
        """Check that results in the output folder are of this evaluation; returns their suite and split."""
        results = read_results(file)
        pair = results["suite"], results["split"]
        n = len(self.chains[pair]) if pair in self.chains else results["n"]
        check_same(results, self.config.header(self.world, *pair) | {"n": n}, file)
        return pair

    def _file(self, suite: str, split: str) -> Path:
        return self.folder / folder_name(suite, split) / RESULTS

    def run(self) -> list[dict[str, Any]]:
        """Run what is missing; returns the results of all suites and splits.

        Raises:
            FolderInUseError: another process evaluates into the output folder.
            ValueError, OSError: a file of the policy is damaged or missing.
        """
        with FolderLock(self.folder), closing(self.world):
            if self.missing:
                self._run_missing()
            results = [read_results(self._file(*pair)) for pair in self.chains]
            write_eval_info(self.folder)
        return results

    def _run_missing(self) -> None:
        config = self.config
        num_envs = min(config.eval.batch_size, max(len(self.chains[pair]) for pair in self.missing))
        # A robot is there once.
        env = self.world if num_envs == 1 else create_eval_streams(config.env, num_envs)
        with closing(env):
            actor = self._load_actor(env)
            for suite, split in self.missing:
                results = self._run_suite(env, actor, suite, split)
                write_json(self._file(suite, split), results)

    def _load_actor(self, env: Streams) -> Actor:
        config = self.config
        if config.policy is None:
            assert isinstance(env, CronosVectorEnv)
            return ExpertActor(env)
        warn_of_inputs(config.policy, config.env)
        return load_actor(config.policy, config.env, config.eval.temperature, config.rename_map)

    def _run_suite(self, env: Streams, actor: Actor, suite: str, split: str) -> dict[str, Any]:
        config, chains = self.config, self.chains[suite, split]
        start = time.perf_counter()
        is_stream, film = suite == STREAM, self._film(env)
        runner = ChainRunner(
            env,
            actor,
            rules_of(suite, steps_per_task(config.env), config.advance, config.end_effector_reset),
            look=classify_starts if is_stream and isinstance(env, CronosVectorEnv) else None,
            states=film.states if film else None,
            num_kept=film.num_kept if film else None,
        )
        actor.seed(config.seed)
        ended = _run_with_bar(runner, chains, split, sampling_seed(config.seed, suite, split), f"{suite} {split}")
        episodes = describe_episodes(ended, config.seed, of_streams=is_stream)
        results = config.header(env, suite, split) | {"temperature": actor.temperature}
        results |= _provenance(time.perf_counter() - start)
        results |= numbers_of(suite, episodes, self.benchmark, split) | {"episodes": episodes}
        if film is not None and self._draw is not None:
            folder = self._file(suite, split).parent
            try:
                self._draw(folder, results, ended, film.render, config.eval.videos, env.fps)
            except RuntimeError as error:
                # Policies that read the state run on machines without OpenGL.
                logging.warning("no videos: %s", error)
        return results

    def _film(self, env: Streams) -> Film | None:
        """How the chains are filmed; None if they are not."""
        count = self.config.eval.videos
        if not count or self._draw is None:
            return None
        if isinstance(env, CronosVectorEnv):
            return Film(
                lambda ids: env.positions(ids).astype(np.float32),
                lambda q: env.render_positions(q.astype(np.float64)),
            )
        if isinstance(env, Draws):
            return Film(env.render_streams, lambda frames: frames, count)
        return None


def _provenance(seconds: float) -> dict[str, Any]:
    return {
        "versions": {"python": platform.python_version()} | package_versions(),
        "opengl_platform": os.environ.get("MUJOCO_GL"),
        "commit": git_commit(),
        "date": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        "seconds": round(seconds, 1),
    }


def _run_with_bar(
    runner: ChainRunner, chains: Sequence[Chain], split: str, seed: tuple[int, ...], name: str
) -> list[ChainResult]:
    lengths: list[int] = []
    with tqdm(total=len(chains), unit="chain", desc=name, disable=None, smoothing=0.1) as bar:

        def show(result: ChainResult) -> None:
            lengths.append(result.length)
            bar.set_postfix_str(f"tasks completed {np.mean(lengths):.2f}", refresh=False)
            bar.update()

        results = runner.run(chains, split, seed, show)
    logging.info("%s: %d chains, tasks completed %.2f", name, len(chains), np.mean(lengths))
    return results
