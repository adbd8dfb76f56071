"""Configuration of the OpenVLA policy."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal, get_args

from lerobot.configs import NormalizationMode, PreTrainedConfig
from lerobot.optim import AdamWConfig

from lerobot_policy_openvla.action_statistics import choose_statistics
from lerobot_policy_openvla.architecture import ATTENTION
from lerobot_policy_openvla.checkpoint import commit_of, fetch, read_checkpoint, tuned_statistics

Dtype = Literal["auto", "bfloat16", "float32"]
Quantization = Literal["none", "int8", "nf4"]
PARTS = ("vision", "projector", "language")


@PreTrainedConfig.register_subclass("openvla")
@dataclass
class OpenVLAConfig(PreTrainedConfig):
    """OpenVLA: one camera image and an instruction in, one token for each action dimension out."""

    checkpoint: str | None = None
    """Weights to build on: a Hub repository or folder in the published format (openvla/openvla-7b), or a whole
    OpenVLA in LeRobot's format."""
    checkpoint_revision: str | None = None
    """Revision of the Hub repository; null is what it is at when the policy is first built, which is then kept."""
    adapter: str | None = None
    """Trained LoRA adapter in PEFT's format, a Hub repository or folder, that goes onto the checkpoint."""
    merge_adapter: bool = False
    """Add `adapter` to the weights. False keeps it apart, and training continues with it."""
    unnorm_key: str | None = None
    """Data set whose action quantiles the bins span: of dataset_statistics.json beside the adapter or the
    checkpoint, or else of the checkpoint's config.json. null: the only one. `dataset`: the quantiles of the
    LeRobotDataset that training begins with."""

    lora_rank: int = 0
    """Rank of fresh LoRA adapters, the only weights that are then trained and saved (32 in the paper). 0: none,
    everything is trained and saved. Leave it 0 with LeRobot's own --peft."""
    lora_alpha: int | None = None
    """LoRA's scale times its rank; null is the rank, at most 16."""
    lora_dropout: float = 0.0
    """Dropout before LoRA, off in reinforcement learning."""
    lora_modules: list[str] = field(default_factory=lambda: list(PARTS))
    """What LoRA adapts, all linear layers of `vision`, `projector` and `language`. Without `vision`, the vision
    towers' features of an observation are computed once, while acting, and kept for the update."""
    lora_targets: list[str] = field(default_factory=list)
    """Names of the very layers to adapt instead of `lora_modules`; set when `adapter` is loaded."""

    image_key: str | None = None
    """Which camera, e.g. `observation.images.front`. null: the only one there is."""
    center_crop: bool = False
    """Keep the middle 90 % of the image's area: for checkpoints fine-tuned with random crops."""
    temperature: float = 0.6
    """Sampling temperature of `select_action`: logits are divided by it; 0 takes the likeliest tokens."""
    inference_batch_size: int = 32
    """Observations that act at a time."""
    value_detach: bool = False
    """Keep the value loss from changing the network below the value head."""

    dtype: Dtype = "auto"
    """Format of the network's weights and activations: `auto` is bfloat16 on a GPU, float32 elsewhere. Adapters,
    value head and action probabilities are float32."""
    quantization: Quantization = "none"
    """Format of the frozen language model's linear layers: `int8` or `nf4` (4 bits) by bitsandbytes."""
    attention: str = "sdpa"
    """Attention of the language model: `sdpa`, `eager`, or `flash_attention_2` if it is installed."""
    gradient_checkpointing: bool = False
    """Compute activations again in the backward pass: less memory, a third more computation."""

    architecture: dict[str, Any] | None = None
    """The network's sizes, read from the checkpoint."""
    action_statistics: dict[str, Any] | None = None
    """key, q01, q99 and mask of the actions, read from the checkpoint or the data set."""

    optimizer_lr: float = 5e-4
    """Learning rate of behaviour cloning."""
    optimizer_weight_decay: float = 0.01
    """AdamW's weight decay in behaviour cloning."""
    optimizer_grad_clip_norm: float = 1.0
    """Largest gradient norm in behaviour cloning."""

    normalization_mapping: dict[str, NormalizationMode] = field(
        default_factory=lambda: {
            # The policy itself and the processor's action step do what is needed.
            "VISUAL": NormalizationMode.IDENTITY,
            "STATE": NormalizationMode.IDENTITY,
            "ENV": NormalizationMode.IDENTITY,
            "ACTION": NormalizationMode.IDENTITY,
        }
    )
    """LeRobot's normalisation per kind of feature."""

    def __post_init__(self) -> None:
        """Check all that can be checked without the checkpoint and the features.

        Raises:
            ValueError: naming the bad value and the valid ones.
        """
        super().__post_init__()
        choices = {"dtype": get_args(Dtype), "quantization": get_args(Quantization), "attention": ATTENTION}
        for name, valid in choices.items():
            if getattr(self, name) not in valid:
                raise ValueError(f"{name}={getattr(self, name)!r} is not one of {list(valid)}")
        if self.n_obs_steps != 1:
            raise ValueError(f"n_obs_steps={self.n_obs_steps}: OpenVLA sees one step, n_obs_steps must be 1")
        if not self.lora_modules or set(self.lora_modules) - set(PARTS):
            raise ValueError(f"lora_modules={self.lora_modules} must name one or more of {list(PARTS)}")
        for name, least in (("lora_rank", 0), ("temperature", 0), ("inference_batch_size", 1)):
            if getattr(self, name) < least:
                raise ValueError(f"{name}={getattr(self, name)} must be at least {least}")
        if self.merge_adapter and not self.adapter:
            raise ValueError("merge_adapter=true adds an adapter to the weights: give it as adapter")
        if self.adapter and not self.merge_adapter and self.lora_rank:
            raise ValueError(
                f"lora_rank={self.lora_rank} makes fresh adapters beside {self.adapter!r}: train that one further "
                "(lora_rank=0), or add it to the weights (merge_adapter=true)"
            )

    def resolve(self, dataset_stats: dict[str, dict[str, Any]] | None = None) -> None:
        """Read sizes and action statistics from the checkpoint, unless they are known, and note its commit.

        Args:
            dataset_stats: LeRobot's statistics, for `unnorm_key=dataset`.

        Raises:
            ValueError: there is no checkpoint, or no statistics of that name, or others are asked for than the
                policy was made with.
        """
        if self.architecture and self.action_statistics:
            if self.unnorm_key != self.action_statistics["key"]:
                raise ValueError(
                    f"unnorm_key={self.unnorm_key!r}, but the policy was made with "
                    f"{self.action_statistics['key']!r}: its tokens would come to mean other actions"
                )
            return
        if self.checkpoint is None:
            raise ValueError("choose the weights to build on: --policy.checkpoint=openvla/openvla-7b")
        checkpoint = read_checkpoint(self.checkpoint, self.checkpoint_revision)
        self.checkpoint_revision = commit_of(self.checkpoint, checkpoint.folder) or self.checkpoint_revision
        self.architecture = checkpoint.architecture.to_dict()
        published = (
            tuned_statistics(fetch(self.adapter)) if self.adapter else None
        ) or checkpoint.action_statistics
        self.action_statistics = choose_statistics(self.unnorm_key, published, dataset_stats)
        self.unnorm_key = self.action_statistics["key"]

    @property
    def lora_scale_numerator(self) -> int:
        """`lora_alpha` with null resolved."""
        return min(self.lora_rank, 16) if self.lora_alpha is None else self.lora_alpha

    @property
    def camera(self) -> str:
        """Key of the image that the policy sees.

        Raises:
            ValueError: when there is no image feature, several and no `image_key`, or none of that name.
        """
        images = sorted(self.image_features)
        if self.image_key is None and len(images) == 1:
            return images[0]
        if self.image_key not in images:
            raise ValueError(f"image_key={self.image_key!r} must be one of the image features {images}")
        return self.image_key

    def validate_features(self) -> None:
        """Check the features once they are known.

        Raises:
            ValueError: there is not the one image, or the action has another width than its statistics.
        """
        _ = self.camera
        assert self.action_statistics is not None
        width = len(self.action_statistics["q01"])
        if self.action_feature is None or self.action_feature.shape != (width,):
            raise ValueError(
                f"the statistics {self.unnorm_key!r} are of {width} action dimensions, the features have "
                f"{self.output_features}; another set of statistics is chosen with unnorm_key"
            )

    def get_optimizer_preset(self) -> AdamWConfig:
        """Return AdamW for behaviour cloning with LoRA."""
        return AdamWConfig(
            lr=self.optimizer_lr,
            weight_decay=self.optimizer_weight_decay,
            grad_clip_norm=self.optimizer_grad_clip_norm,
        )

    def get_scheduler_preset(self) -> None:
        """The learning rate stays as it is."""
        return None

    @property
    def observation_delta_indices(self) -> None:
        """No history of observations."""
        return None

    @property
    def action_delta_indices(self) -> None:
        """No action chunks: the action of the same step."""
        return None

    @property
    def chunk_size(self) -> int:
        """Actions in a chunk; LeRobot's sample weighting looks so many frames ahead."""
        return 1

    @property
    def reward_delta_indices(self) -> None:
        """No rewards."""
        return None
