"""A training run, assembled: environment, policy, agent, task order, resets, random numbers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from cronos_lerobot.agents.base import LearningAgent
from cronos_lerobot.agents.processing import make_processors
from cronos_lerobot.agents.registry import AgentContext, make_agent
from cronos_lerobot.agents.state import agent_state, to_comparable
from cronos_lerobot.protocol.loop_state import LoopState
from cronos_lerobot.protocol.own_state import own_states
from cronos_lerobot.protocol.resets import make_resets
from cronos_lerobot.protocol.rf_mtrl import rf_mtrl
from cronos_lerobot.protocol.run_context import RunContext
from cronos_lerobot.protocol.streams import KeepsState, Streams
from cronos_lerobot.protocol.task_orders import TaskSet, bind_task_order, find_inner, make_task_order
from cronos_lerobot.ranks import Ranks, bit_sum
from cronos_lerobot.stopwatch import Stopwatch
from cronos_lerobot.training.config import CronosTrainConfig
from cronos_lerobot.training.seeding import NamedGenerators
from cronos_lerobot.training.sharding import ShardedEnv


@dataclass
class Parts:
    """What a run is assembled from."""

    env: Streams
    """The N streams, or those of this process; never reset by anyone but the run."""
    make_eval_env: Callable[[int], Any]
    """Makes n streams for the periodic evaluation."""
    policy: Any
    """A LeRobot policy that the config's agent can train."""
    preprocessor: Any
    """The policy's LeRobot preprocessor."""
    postprocessor: Any
    """The policy's LeRobot postprocessor."""
    ranks: Ranks = field(default_factory=Ranks)
    """Those that train together, this one among them; each assembles its own run."""


class Run:
    """One training run between its segments: all that a checkpoint restores.

    Args:
        config: checked.
        parts: of the run.

    Raises:
        ValueError: the policy cannot be trained by the config's agent, or a part has a state that no checkpoint
            can hold.
    """

    def __init__(self, config: CronosTrainConfig, parts: Parts) -> None:
        self.config = config
        self.ranks = parts.ranks
        self.make_eval_env = parts.make_eval_env
        self.preprocessor, self.postprocessor = parts.preprocessor, parts.postprocessor
        env: Any = parts.env
        # A world that times its own work does it by this.
        self.stopwatch = env.timer = Stopwatch()
        # And one that writes files of its own has them in the run's folder.
        env.folder = config.output_dir
        self.keeps_state = isinstance(env, KeepsState)
        self.task_set = TaskSet.of(env, config.protocol)
        policy = parts.policy
        self.generators = NamedGenerators(config.seed, str(next(policy.parameters()).device))
        self.processors = make_processors(policy, parts.preprocessor, parts.postprocessor)
        self.ranks.copy_from_main([*policy.parameters(), *policy.buffers()])
        self.resets = make_resets(config.protocol, self.generators.for_numpy)
        task_rng = self.generators.for_numpy("task_order")
        self.task_order = make_task_order(config.protocol.task_order, task_rng, self.task_set)
        # Configurations and tasks are drawn alike in all processes; what an agent draws is each process's own.
        self._drawn_alike = sorted(self.generators.state_dict()["numpy"])
        # Every named generator exists before a checkpoint is loaded into them.
        self.agent = self._make_agent(policy)
        self.env: Any = env if self.ranks.count == 1 else ShardedEnv(env, self.ranks)
        context = RunContext(self.env, self.agent, self.task_set.tasks, config.protocol, config.total_steps)
        bind_task_order(self.task_order, context)
        self.resets.bind(context)
        self.loop: LoopState = self.task_set.new_loop(config.num_envs)
        # What no checkpoint can hold is told now, and not hours later.
        own_states(self.strategies)
        agent_state(self.agent)

    @property
    def strategies(self) -> tuple[Any, ...]:
        """Task order and resets: they may keep something of their own."""
        return (find_inner(self.task_order), *self.resets.all)

    def events(self) -> Any:
        """Algorithm 1 from here to its end."""
        return rf_mtrl(
            self.env,
            self.task_set.all,
            self.agent,
            self.task_order,
            self.resets,
            self.config.protocol,
            self.loop,
            self.config.total_steps,
        )

    def check_processes(self) -> None:
        """Check that all processes are still one run.

        Raises:
            RuntimeError: they are not.
        """
        if self.ranks.count == 1:
            return
        states = self.generators.state_dict()["numpy"]
        self.ranks.check_alike(
            {
                "the loop's state": self.loop.state_dict(),
                "the random numbers": {name: states[name] for name in self._drawn_alike},
                "the strategies' own state": to_comparable(own_states(self.strategies)),
                "the policy": bit_sum(self.agent.shared_tensors()),
            }
        )

    def _make_agent(self, policy: Any) -> LearningAgent:
        own, env = self.ranks.own, self.config.env
        shown = {} if env is None else {env.features_map[key]: f.shape for key, f in env.features.items()}
        agent = make_agent(
            AgentContext(
                config=self.config.algorithm,
                policy=policy,
                processors=self.processors,
                num_streams=self.config.num_envs,
                update_interval=self.config.protocol.update_interval,
                task_switch_interval=self.config.protocol.task_switch_interval,
                rng=lambda name: self.generators.for_numpy(own(name)),
                torch_rng=lambda name: self.generators.for_torch(own(name)),
                observation_shapes={name: tuple(shape) for name, shape in shown.items()},
                ranks=self.ranks,
                stopwatch=self.stopwatch,
            )
        )
        if self.config.peft is not None and not any(param.requires_grad for param in policy.parameters()):
            raise ValueError(
                f"--algorithm.type={self.config.algorithm.type} trains none of the adapters of --peft.*: leave "
                "--peft.* out."
            )
        return agent
