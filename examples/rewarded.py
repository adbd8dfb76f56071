"""An agent that clones the actions that were rewarded since the last update, in a single step.

    PYTHONPATH=examples cronos-train --discover_packages_path=rewarded --algorithm.type=rewarded \
        --policy.path=<checkpoint> --env.type=cronos --output_dir=outputs/rewarded
"""

from dataclasses import dataclass

import torch

from cronos_lerobot import ActionSample, AgentConfig, LearningAgent, register_agent
from cronos_lerobot.agents import observation_columns
from cronos_lerobot.agents.chunk_player import make_player
from cronos_lerobot.agents.imitation.batches import segment_batch
from cronos_lerobot.agents.imitation.memory import Segment


@AgentConfig.register_subclass("rewarded")
@dataclass
class RewardedConfig(AgentConfig):
    """Its fields are flags: `--algorithm.threshold=0.2`."""

    threshold: float = 0.5
    """Reward above which an action is cloned."""


@register_agent("rewarded")
class RewardedAgent(LearningAgent):
    """Any policy that `lerobot-train` trains can be its policy."""

    def __init__(self, context):
        self.policy, self.processors, self.config = context.policy.eval(), context.processors, context.config
        self.player, self.frames = make_player(self.policy, self.processors), []
        self.optimizer = self.policy.config.get_optimizer_preset().build(self.policy.get_optim_params())

    @torch.no_grad()
    def act(self, o_t, tau):
        """Play as the policy does in `lerobot-eval`."""
        actions = self.player.act(observation_columns(o_t), tau, range(len(tau)))
        return ActionSample(self.processors.physical_actions(actions))

    def store(self, o_t, tau, a_t, r_t, o_tp1, cut_t, diverged_t):
        """Keep what was rewarded."""
        columns = observation_columns(o_t) | {"action": a_t.action}
        for i in (r_t > self.config.threshold).nonzero()[0]:
            self.frames.append({"instruction": tau[i], "columns": {k: c[[i]] for k, c in columns.items()}})
        self.player.begin(cut_t.nonzero()[0])

    def update(self):
        """Clone it."""
        frames, self.frames = self.frames, []
        if frames:
            batch = segment_batch([(Segment(**frame), 0) for frame in frames], self.policy.config)
            self.policy.forward(self.processors.preprocessor(batch))[0].backward()
            self.optimizer.step()
            self.optimizer.zero_grad()
        return {"frames": len(frames)}

    def state_dict(self):
        """What a resumed run needs besides policy and optimizer."""
        return {"frames": self.frames}

    def load_state_dict(self, state):
        """Take it back."""
        self.frames = state["frames"]
