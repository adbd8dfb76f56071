"""Runs Algorithm 1 and everything that watches it: logs, recordings, evaluations, checkpoints."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from lerobot.envs import EnvConfig

from cronos_lerobot.agents.base import Agent, LearningAgent
from cronos_lerobot.agents.processing import make_processors
from cronos_lerobot.agents.registry import AgentContext, make_agent
from cronos_lerobot.agents.state import agent_state, to_comparable
from cronos_lerobot.evaluation.independent import evaluate_independent
from cronos_lerobot.processes import Processes, bit_sum
from cronos_lerobot.protocol.loop_state import Event, SegmentEnd, Step, Update
from cronos_lerobot.protocol.own_state import own_states
from cronos_lerobot.protocol.resets import make_resets
from cronos_lerobot.protocol.rf_mtrl import rf_mtrl
from cronos_lerobot.protocol.takeovers import AssistedAgent, Takeover, make_expert
from cronos_lerobot.protocol.task_orders import TaskSet, bind_task_order, find_inner, make_task_order
from cronos_lerobot.protocol.task_values import RunContext
from cronos_lerobot.stopwatch import Stopwatch
from cronos_lerobot.training.checkpoint import (
    RunState,
    go_on_from,
    load_checkpoint,
    save_checkpoint,
    save_observers,
)
from cronos_lerobot.training.config import CronosTrainConfig
from cronos_lerobot.training.critic_log import CriticLog
from cronos_lerobot.training.logging import RunLogger, SilentLogger, write_manifest
from cronos_lerobot.training.recording import FilmedEnv, StreamObserver
from cronos_lerobot.training.rollout import RolloutStatistics, SmoothedSuccess
from cronos_lerobot.training.seeding import NamedGenerators
from cronos_lerobot.training.sharding import ShardedEnv, whole_step
from cronos_lerobot.training.stopping import StopRequest


class Trainer:
    """One training run.

    Args:
        config: validated; its output folder is made.
        env: the N streams, or those of this process; never reset by anyone but the run.
        make_eval_env: makes the evaluation's own environments, n of them (a `SequentialVectorEnv`), when first
            needed.
        policy: a LeRobot policy that the config's agent can train.
        preprocessor: the policy's LeRobot preprocessor.
        postprocessor: the policy's LeRobot postprocessor.
        processes: that train together, this one among them; each makes its own Trainer.

    Raises:
        ValueError: the policy cannot be trained by the config's agent, or there is no such agent.
    """

    def __init__(
        self,
        config: CronosTrainConfig,
        env: Any,
        make_eval_env: Callable[[int], Any],
        policy: Any,
        preprocessor: Any,
        postprocessor: Any,
        processes: Processes | None = None,
    ) -> None:
        self.config = config
        self.policy = policy
        self.processes = processes or Processes()
        self.stopwatch = Stopwatch()
        env.timer = self.stopwatch
        self.task_set = TaskSet.of(env.scene, config.protocol)
        self._make_eval_env = make_eval_env
        self._eval_env: Any = None
        self.generators = NamedGenerators(config.seed, str(next(policy.parameters()).device))
        self.processors = make_processors(policy, preprocessor, postprocessor)
        self.processes.copy_from_main([*policy.parameters(), *policy.buffers()])
        self._resets = make_resets(config.protocol, self.generators.for_numpy)
        task_rng = self.generators.for_numpy("task_order")
        self._task_order = make_task_order(config.protocol.task_order, task_rng, self.task_set)
        # Configurations and tasks are drawn alike in all processes; what an agent draws is each process's own.
        self._drawn_alike = set(self.generators.state_dict()["numpy"])
        # Every named generator exists before a checkpoint is loaded into them.
        self.agent = self._make_agent()
        if config.peft is not None and not any(param.requires_grad for param in policy.parameters()):
            raise ValueError(
                f"--peft.* puts adapters into the policy to train them, of which --algorithm.type="
                f"{config.algorithm.type} trains nothing: leave --peft.* out."
            )
        self.env = env if self.processes.count == 1 else ShardedEnv(env, self.processes)
        run = RunContext(self.env, self.agent, self.task_set.tasks, config.protocol, config.total_steps)
        bind_task_order(self._task_order, run)
        self._resets.bind(run)
        self.loop = self.task_set.new_loop(config.num_envs)
        self._expert = make_expert(config.protocol, env, self.agent, config.algorithm.type)
        if self._expert is not None:
            takeover = Takeover(config.protocol, config.total_steps, self._expert.capacity)
            self._resets = replace(self._resets, takeover=takeover)
        self._last_evaluation = 0
        self._last_interventions = 0
        recorded = config.record.num_streams
        self._num_recorded = config.num_envs if isinstance(recorded, str) else recorded
        self._observers: dict[str, Any] = {}
        self.logger: RunLogger | SilentLogger = SilentLogger()
        self.recorder = StreamObserver(None)
        self._is_open = False
        self.run_state = RunState(
            self.agent, self.loop, self.generators, self.env, preprocessor, postprocessor, self.processes,
            (find_inner(self._task_order), *self._resets.all),
        )  # fmt: skip
        # What no checkpoint can hold is told now, and not hours later.
        own_states(self.run_state.strategies)
        agent_state(self.agent)
        self.statistics = RolloutStatistics([t.instruction for t in self.task_set.all], len(self.task_set.tasks))
        self.critic_log = CriticLog(config.protocol)
        self._smoothed = SmoothedSuccess(config.protocol, len(self.task_set.tasks))

    def _make_agent(self) -> LearningAgent:
        own = self.processes.own
        return make_agent(
            AgentContext(
                config=self.config.algorithm,
                policy=self.policy,
                processors=self.processors,
                num_streams=self.config.num_envs,
                update_interval=self.config.protocol.update_interval,
                task_switch_interval=self.config.protocol.task_switch_interval,
                rng=lambda name: self.generators.for_numpy(own(name)),
                torch_rng=lambda name: self.generators.for_torch(own(name)),
                observation_shapes=_shapes(self.config.env),
                processes=self.processes,
                stopwatch=self.stopwatch,
            )
        )

    def load(self) -> None:
        """Go on from the config's checkpoint, if it has one.

        Raises:
            NotADirectoryError: it is no checkpoint of a run.
            ValueError: it does not fit the config, or is damaged.
        """
        if self.config.checkpoint_path is None:
            return
        self._observers = load_checkpoint(self.run_state, self.config, self.config.checkpoint_path)
        self._last_evaluation = self._observers["last_evaluation"]
        self._last_interventions = self._observers["last_interventions"]
        self.statistics.load_state_dict(self._observers["statistics"])
        if "critic" in self._observers:
            self.critic_log.load_state_dict(self._observers["critic"])
        budget = self.config.protocol.reset_budget
        if self.loop.n >= self.config.total_steps:
            logging.warning(f"The run has done its {self.loop.n} steps: --steps=<more> goes on.")
        elif budget is not None and self.loop.b >= budget:
            logging.warning(f"The run has spent its {self.loop.b} interventions: --protocol.reset_budget=<more>.")

    def train(self, stop: StopRequest | None = None) -> bool:
        """Run to the last step or the end of the budget, from the start or from the config's checkpoint.

        Args:
            stop: once it has a signal, the run ends after the update that it is in, with a checkpoint.

        Returns:
            Whether it came to its end.
        """
        if not self._observers:
            self.load()
        if not self._is_open:
            self.open()
        try:
            # A run that was told to stop has left an evaluation to the one that goes on from it; one that a budget
            # ended between two updates has not.
            if self.loop.t % self.config.protocol.update_interval == 0:
                if self.loop.t == 0 or self._is_evaluation_due():
                    self._evaluate()
                self._last_interventions = self.loop.b
            return self._run(stop or StopRequest())
        finally:
            self.recorder.close()
            self.logger.close()
            self._is_open = False

    def open(self) -> None:
        """Begin what the run writes, or continue it from a checkpoint: metrics, recordings, manifest.

        `train` does it where nobody has before, to tell errors of files from those of the work.

        Raises:
            ValueError: a file of the run is shorter than its checkpoint left it, or a recording is of another run.
            OSError: a file cannot be written, or another process has the recording.
        """
        if self.processes.is_main:
            states = self._observers
            # First what may be refused: the logger cuts the metrics to where the checkpoint left them.
            self.recorder = StreamObserver.open(
                self.config, self.env, states.get("recorder"), lambda why: self.logger.log("recording", why)
            )
            self.logger = RunLogger(self.config, self.loop, states.get("logger", {}).get("offset"))
            if self.config.checkpoint_path is not None:
                go_on_from(self.config.checkpoint_path)
            write_manifest(self.config, self.processes.count, self.loop.n)
        self._is_open = True

    def _run(self, stop: StopRequest) -> bool:
        last_save, has_checkpoint = self.loop.n, self.config.checkpoint_path is not None
        updated = False
        env_state: dict[str, np.ndarray] | None = None
        self._logged_steps = self.loop.n
        self.stopwatch.lap()
        for event in self._events():
            self._observe(event)
            updated |= isinstance(event, Update)
            if not isinstance(event, SegmentEnd):
                continue
            # Reading the simulations' state wakes sleeping bodies, so it is done at every switch: the run must
            # not depend on how often it is saved, nor on where its budget ended.
            env_state = self.env.get_state()
            if not updated:
                continue
            updated = False
            self._check_processes()
            self._log_update()
            ends = self._is_stopped(stop)
            is_evaluated = not ends and self._is_evaluation_due()
            if not (ends or is_evaluated):
                self._last_interventions = self.loop.b
            saves = self.config.save_checkpoint
            # Before the evaluation, which may take long: a kill in it loses the evaluation alone.
            if saves and (ends or _due(self.loop.n, last_save, self.config.save_freq)):
                self._save(env_state)
                last_save, has_checkpoint = self.loop.n, True
            if is_evaluated:
                self._evaluate()
                self._last_interventions = self.loop.b
                ends = self._is_stopped(stop)
                if saves and last_save == self.loop.n:
                    self._note_evaluation()
                elif saves and ends:
                    self._save(env_state)
            if ends:
                return False
        self._say_end()
        if self.config.save_checkpoint and (last_save < self.loop.n or not has_checkpoint):
            self._save(self.env.get_state() if env_state is None else env_state)
        # After the checkpoint: a run that goes on from it, with more steps or a larger budget, is as one that was
        # never ended, and has no evaluation here unless it was due.
        if self.loop.n % self.config.steps_per_update:
            # A budget ended it between two updates, whose records are else the latest.
            self.logger.log("end", {})
        if self._last_evaluation < self.loop.n:
            self._evaluate()
        if summary := self.critic_log.summary():
            self.logger.log("resets", summary)
        return True

    def _say_end(self) -> None:
        """A run that its budget ends early would look like one that broke off."""
        if self.processes.is_main and self.loop.n < self.config.total_steps:
            logging.warning(
                f"The run ends after {self.loop.n:,} of {self.config.total_steps:,} steps: its "
                f"{self.loop.b:,} interventions reach --protocol.reset_budget={self.config.protocol.reset_budget}."
            )

    def _is_stopped(self, stop: StopRequest) -> bool:
        """Whether any process was told to stop; all of them then do, but not where the run ends anyway."""
        asked = self.processes.concatenate(np.array([stop.number is not None])).any()
        return bool(asked) and self.loop.n < self.config.total_steps

    def _is_evaluation_due(self) -> bool:
        return _due(self.loop.n, self._last_evaluation, self.config.eval_freq) or bool(self._reached())

    def _events(self) -> Any:
        record = self.config.record
        filmed = record.filmed_streams if record.repo_id is not None and self.processes.is_main else 0
        agent: Agent = self.agent
        if self._expert is not None:
            mine = self.processes.share_of(self.config.num_envs)
            agent = AssistedAgent(self.agent, self._expert, self.loop, mine)
        return rf_mtrl(
            FilmedEnv(self.env, filmed) if filmed else self.env,
            self.task_set.all,
            agent,
            self._task_order,
            self._resets,
            self.config.protocol,
            self.loop,
            self.config.total_steps,
        )

    def _observe(self, event: Event) -> None:
        self.statistics.on_event(event)
        if isinstance(event, Step):
            self.agent.end_step(event.success)
            with self.stopwatch("record"):
                if self.config.record.repo_id is not None:
                    event = whole_step(event, self.processes, self._num_recorded)
                self.recorder.on_step(event)
        elif isinstance(event, Update):
            self._update_metrics = event.metrics
        elif isinstance(event, SegmentEnd):
            self.critic_log.on_segment(event, self.loop)
            self.agent.end_segment(event.success, event.found_complete)

    def _check_processes(self) -> None:
        if self.processes.count == 1:
            return
        states = self.generators.state_dict()["numpy"]
        self.processes.check_alike(
            {
                "the loop's state": self.loop.state_dict(),
                "the random numbers": {name: states[name] for name in sorted(self._drawn_alike)},
                "the strategies' own state": to_comparable(own_states(self.run_state.strategies)),
                "the policy": bit_sum(self.agent.shared_tensors()),
            }
        )

    def _log_update(self) -> None:
        wall, seconds = self.stopwatch.lap()
        shares = {name: spent / wall for name, spent in sorted(seconds.items())}
        # A run that goes on from between two updates has done a part of the first one's before.
        steps_per_s = (self.loop.n - self._logged_steps) / wall
        self._logged_steps = self.loop.n
        rollout = self.statistics.pop()
        record = {"rollout": rollout, "agent": self._update_metrics, "steps_per_s": steps_per_s}
        self.logger.log("update", record | self.critic_log.pop() | {"time_share": shares})
        rates = self._smoothed.add(rollout, self.loop.n)
        if self.loop.updates % self.config.log_freq == 0:
            self.logger.progress(rates | {"steps_per_s": steps_per_s})

    def _reached(self) -> list[int]:
        """Those of `eval_at_interventions` that were reached since the last policy update."""
        wanted = self.config.eval_at_interventions
        return [count for count in wanted if self._last_interventions < count <= self.loop.b]

    def _evaluate(self) -> None:
        self._last_evaluation = self.loop.n
        if not (self.config.eval_freq or self.config.eval_at_interventions):
            return
        options = self.config.eval
        if self._eval_env is None:
            num_episodes = -(-len(self.task_set.tasks) * options.n_episodes // self.processes.count)
            self._eval_env = self._make_eval_env(min(options.batch_size, num_episodes))
        result = evaluate_independent(
            self._eval_env,
            self.agent.acting,
            self.processors,
            n_episodes=options.n_episodes,
            repetitions=options.repetitions,
            split=options.split,
            temperature=options.temperature,
            seed=options.seed,
            processes=self.processes,
        )
        self.logger.log("evaluation", result | {"at_interventions": self._reached()})
        self.stopwatch.lap()

    def _save(self, env_state: dict[str, np.ndarray]) -> None:
        # Before the logger's, as a recording that fails in its flush is told there.
        recorder = self.recorder.state_dict()
        self._saved = self._evaluated() | {
            "recorder": recorder,
            "statistics": self.statistics.state_dict(),
            "critic": self.critic_log.state_dict(),
        }
        self._checkpoint = save_checkpoint(self.run_state, self.config, self._saved, env_state)
        self.logger.log_checkpoint(self._checkpoint)
        self.stopwatch.lap()

    def _evaluated(self) -> dict[str, Any]:
        return {
            "logger": self.logger.state_dict(),
            "last_evaluation": self._last_evaluation,
            "last_interventions": self._last_interventions,
        }

    def _note_evaluation(self) -> None:
        """Let the checkpoint of this moment know of the evaluation that came after it."""
        if self.processes.is_main:
            save_observers(self._checkpoint, self._saved | self._evaluated())


def _shapes(env: EnvConfig | None) -> dict[str, tuple[int, ...]]:
    """Of what the environment shows, by LeRobot's names."""
    return {} if env is None else {env.features_map[name]: tuple(f.shape) for name, f in env.features.items()}


def _due(n: int, last: int, frequency: int) -> bool:
    """Whether a multiple of `frequency` lies in (last, n]; 0 is never."""
    return frequency > 0 and n // frequency > last // frequency
