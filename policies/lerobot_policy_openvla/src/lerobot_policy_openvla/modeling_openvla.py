"""The OpenVLA policy: acting, behaviour cloning, and what an actor-critic trainer needs."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, nullcontext
from copy import copy
from pathlib import Path
from typing import Any, Literal

import torch
from lerobot.configs import PreTrainedConfig
from lerobot.policies.pretrained import PreTrainedPolicy
from lerobot.utils.constants import ACTION, OBS_STR
from torch import Tensor
from torch.nn.functional import cross_entropy

from lerobot_policy_openvla.action_tokens import ActionTokenizer, TokenDistribution
from lerobot_policy_openvla.adapters import has_adapter, is_adapter_tensor, linear_names, save_adapter
from lerobot_policy_openvla.building import architecture_of, build, resolve_dtype
from lerobot_policy_openvla.configuration_openvla import OpenVLAConfig
from lerobot_policy_openvla.images import prepare_images
from lerobot_policy_openvla.loading import config_for, load_saved_tensors
from lerobot_policy_openvla.network import ValueHead
from lerobot_policy_openvla.sequence import Prompts, generate_actions, prompt_hidden, score_actions

Batch = Mapping[str, Any]
"""A batch after the preprocessor: `observation.images.<camera>` (B, 3, H, W), uint8 or floats in [0, 1]; `task`,
B strings; in training `action` (B, A), normalised."""

FEATURES = f"{OBS_STR}.vision_features"
"""Key of cached patch features in a batch, see `OpenVLAPolicy.encode_observation`."""


class OpenVLAPolicy(PreTrainedPolicy):
    """A published OpenVLA with a value head, and with LoRA if the configuration asks for it.

    What `state_dict` has, and so what is saved, is what training can change: with LoRA the adapters and the value
    head, and the configuration names the checkpoint below them; otherwise everything.

    Raises:
        ValueError: the configuration names no checkpoint, or does not fit it or the features.
    """

    config_class = OpenVLAConfig  # ty: ignore[invalid-assignment]
    name = "openvla"  # ty: ignore[invalid-assignment]
    takes_uint8_images = True
    """Camera frames may come as they are, in 0..255."""

    def __init__(self, config: OpenVLAConfig, **kwargs: Any) -> None:
        """Load the checkpoint.

        Args:
            config: its `architecture` and `action_statistics` are filled in.
            **kwargs: `dataset_stats` of LeRobot, for `unnorm_key=dataset`; `parts`, a network and a prompt
                tokenizer to use instead of the checkpoint's; LeRobot's others do not matter.
        """
        super().__init__(config)
        config.resolve(kwargs.get("dataset_stats"))
        config.validate_features()
        self.config: OpenVLAConfig = config
        self.architecture = architecture_of(config)
        self.dtype = resolve_dtype(config)
        self.network, self.prompt_tokenizer = kwargs.get("parts") or build(config)
        self.value_head = ValueHead(self.network.text_width)
        self.action_tokenizer = ActionTokenizer(self.architecture.vocabulary_size, self.architecture.n_action_bins)
        # PEFT notes it as the model below an adapter that LeRobot puts around this policy.
        self.name_or_path = config.checkpoint
        self.register_state_dict_post_hook(_without_base)
        self.register_load_state_dict_post_hook(_do_not_miss_base)
        self.to(config.device)

    @property
    def action_dim(self) -> int:
        """Tokens A of an action."""
        assert self.config.action_statistics is not None
        return len(self.config.action_statistics["q01"])

    @property
    def saves_base(self) -> bool:
        """Whether the network's own weights are part of the policy's state."""
        return not has_adapter(self.network) and self.config.quantization == "none"

    # What the network is fed.

    @property
    def device(self) -> torch.device:
        """Where the policy is."""
        return next(self.value_head.parameters()).device

    def _precision(self) -> torch.autocast:
        """The network's own format, whatever the caller's autocast is."""
        return torch.autocast(self.device.type, torch.bfloat16, enabled=self.dtype == torch.bfloat16)

    def _prompts(self, batch: Batch) -> Prompts:
        texts = batch["task"]
        texts = [texts] if isinstance(texts, str) else texts
        return Prompts.of([self.prompt_tokenizer(text) for text in texts], self.device)

    def _vision_features(self, batch: Batch) -> Tensor:
        """Patch features (B, P, vision width), from the batch if they were kept."""
        if FEATURES in batch:
            kept = batch[FEATURES]
            return kept.view(torch.bfloat16) if kept.dtype == torch.int16 else kept
        pixels = prepare_images(batch[self.config.camera], self.architecture, self.config.center_crop)
        with nullcontext() if self._trains_vision else torch.no_grad():
            return self.network.vision_backbone(pixels.to(self.dtype))

    def _patches(self, batch: Batch) -> Tensor:
        """Patch embeddings (B, P, text width)."""
        return self.network.projector(self._vision_features(batch))

    @property
    def _trains_vision(self) -> bool:
        return any(parameter.requires_grad for parameter in self.network.vision_backbone.parameters())

    def _recomputing(self) -> AbstractContextManager[None]:
        wanted = self.config.gradient_checkpointing and torch.is_grad_enabled()
        return self.network.recomputing() if wanted else nullcontext()

    def _distribution(self, logits: Tensor, temperature: float) -> TokenDistribution:
        return TokenDistribution(logits, self.action_tokenizer.token_range, temperature)

    def _values(self, hidden: Tensor) -> Tensor:
        with torch.autocast(hidden.device.type, enabled=False):
            return self.value_head(hidden.detach() if self.config.value_detach else hidden)

    def _chunks(self, batch: Batch) -> Iterator[tuple[Batch, slice]]:
        """Cut a batch into parts of `inference_batch_size`, so that memory does not grow with the streams."""
        size, step = len(batch["task"]), self.config.inference_batch_size
        for start in range(0, size, step):
            rows = slice(start, min(start + step, size))
            yield {k: v[rows] if isinstance(v, Tensor | list | tuple) else v for k, v in batch.items()}, rows

    # LeRobot's policy interface.

    def forward(
        self, batch: Batch, reduction: Literal["mean", "none"] = "mean"
    ) -> tuple[Tensor, dict[str, float]]:
        """Behaviour cloning: next-token loss on the action tokens, over the whole vocabulary.

        Args:
            batch: with `action` (B, A) or (B, 1, A), normalised, and `action_is_pad` (B,) or (B, 1) if some
                actions are padding.
            reduction: `mean` over the samples that are not padding, or `none`.

        Returns:
            The loss, a scalar or (B,), in nats as the mean over the action's tokens, and numbers for the log.
        """
        actions = batch[ACTION].reshape(-1, self.action_dim)
        tokens = self.action_tokenizer.encode(actions)
        with self._precision(), self._recomputing():
            logits, _ = score_actions(self.network, self._prompts(batch), self._patches(batch), tokens)
        losses = cross_entropy(logits.transpose(1, 2), tokens, reduction="none").mean(dim=1)
        valid = torch.ones_like(losses)
        if "action_is_pad" in batch:
            valid = 1.0 - batch["action_is_pad"].reshape(-1).to(losses.dtype)
        losses = losses * valid
        loss = losses if reduction == "none" else losses.sum() / valid.sum().clamp(min=1.0)
        return loss, self._metrics(logits, tokens, actions, valid)

    @torch.no_grad()
    def _metrics(self, logits: Tensor, tokens: Tensor, actions: Tensor, valid: Tensor) -> dict[str, float]:
        """Of the likeliest tokens, each given the demonstrated ones before it."""
        likeliest = self._distribution(logits, 0.0).quantile(torch.zeros_like(tokens))
        error = (self.action_tokenizer.decode(likeliest) - actions.float()).abs().mean(dim=1)
        accuracy = (likeliest == tokens).float().mean(dim=1)
        total = valid.sum().clamp(min=1.0)
        return {
            "token_accuracy": float((accuracy * valid).sum() / total),
            "greedy_abs_error": float((error * valid).sum() / total),
        }

    @torch.no_grad()
    def select_action(  # ty: ignore[incompatible-method-override]
        self,
        batch: Batch,
        *,
        temperature: float | None = None,
        generator: torch.Generator | None = None,
        **_: Any,
    ) -> Tensor:
        """Choose one normalised action per sample, (B, A) float32.

        Args:
            batch: image and `task`.
            temperature: of the sampling, 0 is greedy; None takes the configuration's.
            generator: random source; None is torch's global one.
        """
        temperature = self.config.temperature if temperature is None else temperature
        return self.sample_actions(batch, temperature=temperature, generator=generator)["actions"][:, 0]

    def predict_action_chunk(self, batch: Batch, **kwargs: Any) -> Tensor:
        """`select_action` as a chunk of one action, (B, 1, A)."""
        return self.select_action(batch, **kwargs).unsqueeze(1)

    def reset(self) -> None:
        """Nothing to forget: the policy has no memory between steps."""

    def get_optim_params(self) -> list[dict[str, Any]]:  # ty: ignore[incompatible-method-override]
        """What behaviour cloning trains: all of the network that is not frozen."""
        return [{"params": [p for p in self.network.parameters() if p.requires_grad]}]

    def _get_default_peft_targets(self) -> dict[str, Any]:
        return {"target_modules": [f"network.{n}" for n in linear_names(self.network, self.config.lora_modules)]}

    def _validate_peft_config(self, peft_config: Any) -> None:
        if has_adapter(self.network):
            raise ValueError("the policy has adapters of its own already: use either --policy.lora_rank or --peft")

    @classmethod
    def from_pretrained(
        cls, pretrained_name_or_path: str | Path, *, config: PreTrainedConfig | None = None, **kwargs: Any
    ) -> OpenVLAPolicy:
        """Load a policy that was saved by LeRobot or with PEFT, or a published checkpoint.

        Args:
            pretrained_name_or_path: folder or Hub repository.
            config: None takes the saved one; its `checkpoint` may name another place of the weights below.
            **kwargs: `revision`, and what the constructor takes.
        """
        name, revision = str(pretrained_name_or_path), kwargs.pop("revision", None)
        config, saved = config_for(name, revision, config)
        policy = cls(config, **kwargs)
        if saved is not None:
            load_saved_tensors(policy, saved)
        return policy.to(config.device).eval()

    def _save_pretrained(self, save_directory: Path, state_dict: dict[str, Tensor] | None = None) -> None:
        super()._save_pretrained(save_directory, state_dict)
        if self.saves_base:
            # All of it is in the folder: what it was built from need not be there where it is loaded.
            config = copy(self.config)
            config.checkpoint = config.checkpoint_revision = None
            config._save_pretrained(save_directory)
        self.prompt_tokenizer.save(save_directory)

    def save_adapter(self, folder: Path) -> None:
        """Write the LoRA adapter, if there is one, in PEFT's format, by the names of the published model class."""
        save_adapter(self.network, folder, self.config.checkpoint)

    # What an actor-critic trainer needs (structurally; nothing is imported from it).

    @property
    def encode_observation(self) -> Callable[[Batch], Batch] | None:
        """If the vision towers are frozen, the function that puts their features instead of the image."""
        return None if self._trains_vision else self._with_features

    @torch.no_grad()
    def _with_features(self, batch: Batch) -> Batch:
        with self._precision():
            features = torch.cat([self._vision_features(part) for part, _ in self._chunks(batch)])
        if features.dtype == torch.bfloat16:
            # The same bits under a type that NumPy knows, too.
            features = features.view(torch.int16)
        return {key: value for key, value in batch.items() if key != self.config.camera} | {FEATURES: features}

    @torch.no_grad()
    def sample_actions(
        self,
        batch: Batch,
        *,
        temperature: float = 1.0,
        generator: torch.Generator | None = None,
        uniform: Tensor | None = None,
    ) -> dict[str, Tensor]:
        """Draw actions with what is needed to learn from them.

        Args:
            batch: image, or kept features, and `task`.
            temperature: of the sampling, 0 is greedy.
            generator: random source; None is torch's global one.
            uniform: the randomness itself, (B, A) in [0, 1), instead of a generator: a sample then does not
                depend on the others of its batch.

        Returns:
            `actions` (B, 1, A) float32, normalised; `trace` (B, A) int64, tokens of the vocabulary; `log_prob`
            (B,), summed over the tokens, at this temperature; `value` (B,). Temperature 0 is greedy, its
            `log_prob` is 0.
        """
        if uniform is None:
            shape = (len(batch["task"]), self.action_dim)
            uniform = torch.rand(shape, generator=generator, device=self.device)
        parts = [self._sample(part, temperature, uniform[rows]) for part, rows in self._chunks(batch)]
        return {key: torch.cat([part[key] for part in parts]) for key in parts[0]}

    def _sample(self, batch: Batch, temperature: float, uniform: Tensor) -> dict[str, Tensor]:
        def choose(logits: Tensor, i: int) -> Tensor:
            return self._distribution(logits, temperature).quantile(uniform[:, i])

        with self._precision():
            tokens, logits, hidden = generate_actions(
                self.network, self._prompts(batch), self._patches(batch), self.action_dim, choose
            )
        return {
            "actions": self.action_tokenizer.decode(tokens).unsqueeze(1),
            "trace": tokens,
            "log_prob": self._distribution(logits, temperature).log_prob(tokens),
            "value": self._values(hidden),
        }

    def evaluate_actions(self, batch: Batch, tokens: Tensor, *, temperature: float = 1.0) -> dict[str, Tensor]:
        """Evaluate drawn tokens (B, A) under the policy as it is now, differentiable.

        Returns:
            `log_prob` (B,), summed over the tokens; `entropy` (B,), mean over the tokens, in nats; `value` (B,).
        """
        with self._precision(), self._recomputing():
            logits, hidden = score_actions(self.network, self._prompts(batch), self._patches(batch), tokens)
        distribution = self._distribution(logits, temperature)
        return {
            "log_prob": distribution.log_prob(tokens),
            "entropy": distribution.entropy(),
            "value": self._values(hidden),
        }

    def predict_values(self, batch: Batch) -> Tensor:
        """Values of the observations, (B,), differentiable."""
        values = []
        for part, _ in self._chunks(batch):
            with self._precision(), self._recomputing():
                hidden = prompt_hidden(self.network, self._prompts(part), self._patches(part))
            values.append(self._values(hidden))
        return torch.cat(values)

    def rl_parameter_groups(self) -> list[dict[str, Any]]:
        """Two disjoint groups: `policy`, all of the network that is not frozen, and `value`, the value head."""
        policy = [parameter for parameter in self.network.parameters() if parameter.requires_grad]
        return [
            {"name": "policy", "params": policy},
            {"name": "value", "params": list(self.value_head.parameters())},
        ]


def _is_base(name: str) -> bool:
    return "network." in name and not is_adapter_tensor(name)


def _without_base(policy: Any, state: dict[str, Tensor], prefix: str, _: Any) -> None:
    """Leave the weights that LoRA does not touch out of the policy's state."""
    if not policy.saves_base:
        for name in [key for key in state if key.startswith(f"{prefix}network.") and _is_base(key)]:
            del state[name]


def _do_not_miss_base(policy: Any, incompatible: Any) -> None:
    """The counterpart of `_without_base` when a state is loaded."""
    if not policy.saves_base:
        incompatible.missing_keys[:] = [key for key in incompatible.missing_keys if not _is_base(key)]
