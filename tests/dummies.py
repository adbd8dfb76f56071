"""A tiny environment and a tiny policy with the interfaces of the real ones, for exact tests of the loop."""

from dataclasses import dataclass

import gymnasium as gym
import numpy as np
import torch
from lerobot.configs import FeatureType, PolicyFeature, PreTrainedConfig
from lerobot.policies.pretrained import PreTrainedPolicy
from lerobot.processor import make_policy_processor_pipelines
from lerobot_env_cronos import EnvIdentity

NUM_BINS = 3


@dataclass(frozen=True)
class DummyTask:
    goal: float
    object: str = ""

    @property
    def instruction(self) -> str:
        return f"go to {self.goal}"


BODIES = ("toy bear", "ketchup bottle", "yellow plate")
BEAR, BOTTLE, _ = BODIES
TASKS = (DummyTask(1.0, BEAR), DummyTask(-1.0, BEAR), DummyTask(2.0, BOTTLE), DummyTask(-2.0, BOTTLE))
RESET_TASKS = (DummyTask(0.0, BEAR), DummyTask(0.5, BOTTLE))


class DummyEnv:
    """Points on a line: action 0 moves stream i, and a task is complete within 0.3 of its goal.

    `calls` is the tape of everything that was asked of it; `diverge_at` are the (step, stream) that break down,
    `lost` the (stream, body) that have left the workspace.
    """

    fps, robot_type = 5, "dummy"
    tasks, reset_tasks = TASKS, RESET_TASKS
    identity = EnvIdentity("dummies/line-v1", "0" * 16, "dummies")
    num_starts = {"train": 64, "held_out": 64}  # noqa: RUF012
    state_names = tuple(f"s{i}" for i in range(13))
    action_names = tuple(f"a{i}" for i in range(7))
    single_observation_space = gym.spaces.Dict({"agent_pos": gym.spaces.Box(-9, 9, (13,), np.float32)})
    single_action_space = gym.spaces.Box(-1, 1, (7,), np.float32)

    def __init__(self, num_envs: int, diverge_at: set[tuple[int, int]] | None = None):
        self.num_envs = num_envs
        self.lost: set[tuple[int, int]] = set()
        self.current_tasks = [TASKS[0]] * num_envs
        self.x = np.zeros(num_envs)
        self.moved = 0
        self.t = 0
        self.diverge_at = diverge_at or set()
        self.calls: list = []

    @property
    def instructions(self):
        return [task.instruction for task in self.current_tasks]

    def step(self, actions):
        self.calls.append("step")
        reward, diverged = self.step_streams(actions, np.arange(self.num_envs))
        never = np.zeros(self.num_envs, bool)
        info = {"is_success": self.is_success, "diverged": diverged}
        return self._observation(), reward, never, never, info

    def step_streams(self, actions, ids):
        assert actions.shape == (self.num_envs, 7)
        self.x[ids] = np.clip(self.x[ids] + 0.2 * actions[ids, 0], -3, 3)
        self.moved += len(ids)
        diverged = np.array([(self.t, i) in self.diverge_at for i in range(self.num_envs)])
        self.t += 1
        return self.is_success.astype(np.float32), diverged

    @property
    def is_success(self):
        return np.abs(self.x - [task.goal for task in self.current_tasks]) < 0.3

    def observe(self, ids=None):
        self.calls.append("observe")
        observation = self._observation()
        return observation if ids is None else {"agent_pos": observation["agent_pos"][ids]}

    def observe_under(self, tasks):
        return [self._observation() for _ in tasks]

    def find_complete(self, tasks):
        return np.abs(self.x[:, None] - [task.goal for task in tasks]) < 0.3

    def _observation(self):
        agent_pos = np.zeros((self.num_envs, 13), np.float32)
        agent_pos[:, 0], agent_pos[:, 1] = self.x, 1
        return {"agent_pos": agent_pos}

    def set_task(self, ids, tasks):
        self.calls.append("set_task")
        for i, task in zip(ids, tasks, strict=True):
            self.current_tasks[i] = task

    def scene_reset(self, ids, configurations, split="train"):
        self.calls.append(("scene_reset", list(ids)))
        self.x[ids] = (np.asarray(configurations) % 8) / 8 - 0.5 + (0.01 if split == "held_out" else 0.0)

    def end_effector_reset(self, ids):
        self.calls.append(("end_effector_reset", list(ids)))

    def unsuitable_bodies(self):
        return np.array([[(i, k) in self.lost for k in range(3)] for i in range(self.num_envs)])

    def put_back(self, stream, body, rng):
        self.calls.append(("put_back", stream, BODIES[body]))
        self.lost.discard((stream, body))

    def get_state(self):
        everything = TASKS + RESET_TASKS
        tasks = np.array([everything.index(task) for task in self.current_tasks])
        return {"x": self.x.copy(), "t": np.full(self.num_envs, self.t), "task": tasks}

    def set_state(self, state):
        self.x, self.t = state["x"].copy(), int(state["t"][0])
        self.current_tasks = [(TASKS + RESET_TASKS)[i] for i in state["task"]]

    def close(self):
        pass


@PreTrainedConfig.register_subclass("dummy_linear")
@dataclass
class DummyPolicyConfig(PreTrainedConfig):
    device: str | None = "cpu"
    push_to_hub: bool = False

    def __post_init__(self):
        super().__post_init__()
        self.input_features = {"observation.state": PolicyFeature(FeatureType.STATE, (2,))}
        self.output_features = {"action": PolicyFeature(FeatureType.ACTION, (7,))}

    observation_delta_indices = action_delta_indices = reward_delta_indices = None

    def get_optimizer_preset(self):
        raise NotImplementedError

    def get_scheduler_preset(self):
        return None

    def validate_features(self):
        pass


class DummyPolicy(PreTrainedPolicy):
    """Linear logits over three bins (-1, 0, 1) for each of 7 dimensions, and a linear value."""

    config_class = DummyPolicyConfig
    name = "dummy_linear"

    def __init__(self, config=None, seed=0, **kwargs):
        super().__init__(config or DummyPolicyConfig())
        with torch.random.fork_rng():
            torch.manual_seed(seed)
            self.actor = torch.nn.Linear(3, 7 * NUM_BINS)
            self.critic = torch.nn.Linear(3, 1)

    def _inputs(self, batch):
        goals = torch.tensor([[float(text.removeprefix("go to "))] for text in batch["task"]])
        return torch.cat([batch["observation.state"][:, :2], goals], dim=1)

    def _distribution(self, batch, temperature):
        logits = self.actor(self._inputs(batch)).reshape(-1, 7, NUM_BINS)
        return torch.distributions.Categorical(logits=logits / temperature)

    def sample_actions(self, batch, *, temperature=1.0, generator=None):
        distribution = self._distribution(batch, temperature or 1.0)
        probabilities = distribution.probs.reshape(-1, NUM_BINS)
        if temperature == 0:
            tokens = probabilities.argmax(dim=1)
        else:
            tokens = torch.multinomial(probabilities, 1, generator=generator)
        tokens = tokens.reshape(-1, 7)
        log_prob = distribution.log_prob(tokens).sum(dim=1)
        action = tokens.float() - 1
        return {
            "actions": action[:, None],
            "trace": tokens,
            "log_prob": log_prob,
            "value": self.predict_values(batch),
        }

    def evaluate_actions(self, batch, tokens, *, temperature=1.0):
        distribution = self._distribution(batch, temperature)
        return {
            "log_prob": distribution.log_prob(tokens).sum(dim=1),
            "entropy": distribution.entropy().mean(dim=1),
            "value": self.predict_values(batch),
        }

    def predict_values(self, batch):
        return self.critic(self._inputs(batch)).squeeze(1)

    def rl_parameter_groups(self):
        return [
            {"name": "policy", "params": list(self.actor.parameters())},
            {"name": "value", "params": list(self.critic.parameters())},
        ]

    def forward(self, batch):
        raise NotImplementedError

    def get_optim_params(self):
        raise NotImplementedError

    def predict_action_chunk(self, batch, **kwargs):
        raise NotImplementedError

    def select_action(self, batch, **kwargs):
        return self.sample_actions(batch, temperature=0)["actions"][:, 0]

    def reset(self):
        pass


def identity_processors():
    return make_policy_processor_pipelines(input_steps=[], output_steps=[])
