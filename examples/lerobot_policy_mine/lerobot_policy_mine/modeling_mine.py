"""A policy that reads the privileged state and the instruction, with all that PPO needs."""

import torch
from lerobot.policies.pretrained import PreTrainedPolicy
from torch import nn

from lerobot_policy_mine.configuration_mine import MineConfig

BINS = 256


class MinePolicy(PreTrainedPolicy):
    """A bin of 256 for each action dimension, and a critic."""

    config_class, name = MineConfig, "mine"

    def __init__(self, config, **kwargs):
        super().__init__(config)
        width = config.robot_state_feature.shape[0] + config.env_state_feature.shape[0] + 16
        self.words = nn.EmbeddingBag(4096, 16)
        self.actor = nn.Sequential(nn.Linear(width, 256), nn.ReLU(), nn.Linear(256, 7 * BINS))
        self.critic = nn.Sequential(nn.Linear(width, 256), nn.ReLU(), nn.Linear(256, 1))
        self.register_buffer("centres", (torch.arange(BINS) + 0.5) / BINS * 2 - 1)
        self.to(config.device)

    def _inputs(self, batch):
        words = [[sum(map(ord, w)) % 4096 for w in text.split()] for text in batch["task"]]
        flat = torch.tensor([word for some in words for word in some], device=self.config.device)
        starts = torch.tensor([0, *map(len, words[:-1])], device=self.config.device).cumsum(0)
        state = batch["observation.state"], batch["observation.environment_state"]
        return torch.cat([*state, self.words(flat, starts)], dim=1)

    def _bins(self, inputs, temperature=1.0):
        logits = self.actor(inputs).reshape(len(inputs), 7, BINS)
        return torch.distributions.Categorical(logits=logits / max(temperature, 1e-6))

    def sample_actions(self, batch, *, temperature=1.0, generator=None):
        """Draw a decision, see docs/extend.md."""
        inputs = self._inputs(batch)
        bins = self._bins(inputs, temperature)
        tokens = torch.multinomial(bins.probs.flatten(0, 1), 1, generator=generator).reshape(-1, 7)
        if temperature == 0:
            tokens = bins.logits.argmax(-1)
        value = self.critic(inputs).squeeze(1)
        log_prob = bins.log_prob(tokens).sum(1)
        actions = self.centres[tokens][:, None]
        return {"actions": actions, "trace": tokens, "log_prob": log_prob, "value": value}

    def evaluate_actions(self, batch, trace, *, temperature=1.0):
        """How likely a decision is now."""
        inputs = self._inputs(batch)
        bins = self._bins(inputs, temperature)
        log_prob, entropy = bins.log_prob(trace).sum(1), bins.entropy().mean(1)
        return {"log_prob": log_prob, "entropy": entropy, "value": self.critic(inputs).squeeze(1)}

    def predict_values(self, batch):
        """Values (B,)."""
        return self.critic(self._inputs(batch)).squeeze(1)

    def rl_parameter_groups(self):
        """What PPO trains, with a learning rate for each group."""
        policy = [*self.actor.parameters(), *self.words.parameters()]
        return [{"name": "policy", "params": policy}, {"name": "value", "params": [*self.critic.parameters()]}]

    def forward(self, batch):
        """The loss of behaviour cloning, for `lerobot-train`."""
        tokens = ((batch["action"] + 1) / 2 * BINS).long().clamp(0, BINS - 1)
        return -self._bins(self._inputs(batch)).log_prob(tokens).mean(), {}

    def get_optim_params(self):
        """What `lerobot-train` trains."""
        return self.parameters()

    def select_action(self, batch, **kwargs):
        """One action, for LeRobot."""
        return self.sample_actions(batch, temperature=0.6)["actions"][:, 0]

    def predict_action_chunk(self, batch, **kwargs):
        """A chunk of one action, for LeRobot."""
        return self.select_action(batch)[:, None]

    def reset(self):
        """Nothing is remembered."""
