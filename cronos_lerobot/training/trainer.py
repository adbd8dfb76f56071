"""Runs Algorithm 1 and everything that watches it: logs, recordings, evaluations, checkpoints."""

from __future__ import annotations

import logging
from functools import cached_property
from typing import Any

import numpy as np

from cronos_lerobot.evaluation.independent import evaluate_independent
from cronos_lerobot.protocol.loop_state import Event, SegmentEnd, Step, Update
from cronos_lerobot.protocol.streams import steps_per_task
from cronos_lerobot.training.checkpoint import point_last_at, restore, save_checkpoint
from cronos_lerobot.training.logging import RunLogger, SilentLogger
from cronos_lerobot.training.recording import StreamObserver
from cronos_lerobot.training.rollout import RolloutStatistics
from cronos_lerobot.training.run import Run
from cronos_lerobot.training.run_folder import note_end, note_start
from cronos_lerobot.training.sharding import whole_step
from cronos_lerobot.training.stopping import StopRequest


class Schedule:
    """When something recurs: at the first chance after each multiple of `every` interaction steps.

    Args:
        every: interaction steps; 0 is never.
        last: interaction steps at the last time.
    """

    def __init__(self, every: int, last: int = 0) -> None:
        self.every, self.last = every, last

    def due(self, n: int) -> bool:
        """Whether it is due after `n` interaction steps."""
        return self.every > 0 and n // self.every > self.last // self.every


class Trainer:
    """Trains a run, from its start or from a checkpoint.

    Args:
        run: just assembled; its output folder is free, or that of the checkpoint.
        state: of the config's checkpoint, see `read_state`; None starts the run.

    Raises:
        ValueError: the checkpoint does not fit the run, a file of the run is shorter than the checkpoint left it,
            or a recording is of another run.
        OSError: a file cannot be written, or another process has the recording.
    """

    def __init__(self, run: Run, state: dict[str, Any] | None = None) -> None:
        self.run, self.config, self.loop = run, run.config, run.loop
        observers = {} if state is None else restore(run, state)
        num_tasks = len(run.task_set.tasks)
        self.statistics = RolloutStatistics([task.instruction for task in run.task_set.all], num_tasks)
        if "statistics" in observers:
            self.statistics.load_state_dict(observers["statistics"])
        evaluated = observers.get("evaluated", {"steps": 0})
        self._evaluations = Schedule(self.config.eval_freq, evaluated["steps"])
        self._saves = Schedule(self.config.save_freq, self.loop.n)
        self._update: dict[str, Any] | None = None
        """Metrics of the latest update, until they are logged."""
        record = self.config.record
        self._num_recorded = record.count(self.config.num_envs) if record.repo_id is not None else 0
        # First what may be refused: the logger cuts the metrics to where the checkpoint left them.
        self.recorder = StreamObserver(
            run, observers.get("recorder"), lambda why: self.logger.log("recording", {"reason": why})
        )
        self.logger: RunLogger | SilentLogger = SilentLogger()
        if run.ranks.is_main:
            self.logger = RunLogger(self.config, self.loop, observers.get("logger"))
            if self.config.checkpoint_path is not None:
                point_last_at(self.config.checkpoint_path)
            note_start(self.config, run.env.identity, run.ranks.count, self.loop.n)

    def train(self, stop: StopRequest | None = None) -> bool:
        """Run to the last step or the end of the budget.

        Args:
            stop: once it has a signal, the run ends after the update that it is in, with a checkpoint.

        Returns:
            Whether it came to its end.

        Raises:
            OSError: a checkpoint or a metric cannot be written.
            FloatingPointError: a loss is not finite.
        """
        stop = stop or StopRequest()
        try:
            # A run that was told to stop has left an evaluation to this one. Between two updates, where a budget
            # ends a run, there is none.
            if self.loop.t == 0 or (self._is_between_rollouts and self._evaluations.due(self.loop.n)):
                self._evaluate()
            self._logged_steps = self.loop.n
            self.run.stopwatch.lap()
            env_state = None
            for event in self.run.events():
                self._observe(event)
                if isinstance(event, SegmentEnd):
                    # Reading the simulations' state wakes sleeping bodies, so it is done at every switch: the run
                    # must not depend on how often it is saved, nor on where its budget ended.
                    env_state = self._env_state()
                    if self._update is not None and self._end_update(env_state, stop):
                        return False
            self._end(env_state)
            return True
        finally:
            if "_eval_env" in self.__dict__:
                self._eval_env.close()
            self.recorder.close()
            self.logger.close()

    def _env_state(self) -> dict[str, np.ndarray] | None:
        return self.run.env.get_state() if self.run.keeps_state else None

    def _end_update(self, env_state: dict[str, np.ndarray] | None, stop: StopRequest) -> bool:
        """Log an update, save and evaluate if it is time; returns whether the run was told to stop."""
        self.run.check_processes()
        self._log_update()
        stopped = self._is_stopped(stop)
        # Before the evaluation, which may take long: a kill in it loses the evaluation alone.
        if stopped or self._saves.due(self.loop.n):
            self._save(env_state)
        if not stopped and self._evaluations.due(self.loop.n):
            self._evaluate()
            stopped = self._is_stopped(stop)
            if stopped:
                self._save(env_state)
        return stopped

    def _end(self, env_state: dict[str, np.ndarray] | None) -> None:
        """Save and evaluate a run that has come to its end.

        The evaluation comes after the checkpoint: a run that resumes from it, with more steps or a larger budget,
        is as one that never ended, and has no evaluation here unless it was due.
        """
        if self.loop.n < self.config.total_steps:
            logging.warning(
                f"The run ends after {self.loop.n:,} of {self.config.total_steps:,} steps: its "
                f"{self.loop.b:,} interventions reach --protocol.reset_budget={self.config.protocol.reset_budget}."
            )
        if self._saves.last < self.loop.n:
            self._save(self._env_state() if env_state is None else env_state)
        if not self._is_between_rollouts:
            # The latest records are of an earlier step.
            self.logger.log("end", {})
        if self._evaluations.last < self.loop.n:
            self._evaluate()
        if self.run.ranks.is_main:
            note_end(self.config)

    @property
    def _is_between_rollouts(self) -> bool:
        return self.loop.t % self.config.protocol.update_interval == 0

    def _is_stopped(self, stop: StopRequest) -> bool:
        """Whether any process was told to stop; all of them then do, but not where the run ends anyway."""
        asked = self.run.ranks.concatenate(np.array([stop.number is not None])).any()
        return bool(asked) and self.loop.n < self.config.total_steps

    def _observe(self, event: Event) -> None:
        self.statistics.on_event(event)
        if isinstance(event, Step):
            self.run.agent.end_step(event.success)
            with self.run.stopwatch("record"):
                if self._num_recorded:
                    self.recorder.on_step(whole_step(event, self.run.ranks, self._num_recorded))
        elif isinstance(event, Update):
            self._update = event.metrics
        elif isinstance(event, SegmentEnd):
            self.run.agent.end_segment(event.success, event.found_complete)

    def _log_update(self) -> None:
        wall, seconds = self.run.stopwatch.lap()
        # A run that resumes between two updates has done a part of the first one's steps before.
        steps_per_s = (self.loop.n - self._logged_steps) / wall
        self._logged_steps = self.loop.n
        rollout = self.statistics.pop()
        record = {"rollout": rollout, "agent": self._update, "steps_per_s": steps_per_s}
        shares = {name: spent / wall for name, spent in sorted(seconds.items())}
        self.logger.log("update", record | {"time_share": shares})
        self._update = None
        if self.loop.updates % self.config.log_freq == 0:
            rates = {name: rollout[name].rate for name in ("found_complete", "never_grasped") if name in rollout}
            self.logger.progress({"success": rollout["success"], **rates, "steps_per_s": steps_per_s})

    @cached_property
    def _eval_env(self) -> Any:
        options, run = self.config.eval, self.run
        per_task = options.n_episodes or run.env.num_starts[options.split]
        num_episodes = -(-len(run.task_set.tasks) * per_task // run.ranks.count)
        return run.make_eval_env(min(options.batch_size, num_episodes))

    def _evaluate(self) -> None:
        self._evaluations.last = self.loop.n
        if not self.config.eval_freq:
            return
        options, run = self.config.eval, self.run
        result = evaluate_independent(
            self._eval_env,
            run.agent.acting,
            run.processors,
            n_episodes=options.n_episodes,
            repetitions=options.repetitions,
            split=options.split,
            temperature=options.temperature,
            seed=options.seed,
            window=steps_per_task(self.config.env),
            ranks=run.ranks,
        )
        self.logger.log("evaluation", result)
        run.stopwatch.lap()

    def _save(self, env_state: dict[str, np.ndarray] | None) -> None:
        if not self.config.save_checkpoint:
            return
        # Before the logger's, as a recording that fails in its flush is told there.
        recorder = self.recorder.state_dict()
        observers = {
            "recorder": recorder,
            "logger": self.logger.state_dict(),
            "evaluated": {"steps": self._evaluations.last},
            "statistics": self.statistics.state_dict(),
        }
        self.logger.log_checkpoint(save_checkpoint(self.run, observers, env_state))
        self._saves.last = self.loop.n
        self.run.stopwatch.lap()
