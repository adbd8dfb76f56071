"""Configuration of the PocketVLA policy."""

import math
from dataclasses import dataclass, field
from typing import Any, Literal, get_args

from lerobot.configs import NormalizationMode, PreTrainedConfig
from lerobot.optim import AdamWConfig, CosineDecayWithWarmupSchedulerConfig
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_STATE

from lerobot_policy_pocketvla.action_bounds import BRIDGE_ORIG_BOUNDS
from lerobot_policy_pocketvla.bodies import BODY_WIDTH, bodies_named
from lerobot_policy_pocketvla.pose_encoder import View
from lerobot_policy_pocketvla.precision import Precision

Observation = Literal["auto", "image", "environment_state"]
CriticObservation = Literal["actor", "environment_state"]
Head = Literal["gaussian", "categorical", "flow"]
BoundsSource = Literal["bridge_orig", "dataset", "unit"]

DEFAULT_CHUNK_SIZE = 4
"""Of the `flow` head: 0.8 s at 5 control steps a second."""
DEFAULT_ACTION_STEPS = 2
LEAST = {"temperature": 0, "num_bins": 2, "hidden_depth": 1, "num_inference_steps": 1, "flow_draws": 1}
"""Smallest values that make sense."""


@PreTrainedConfig.register_subclass("pocketvla")
@dataclass
class PocketVLAConfig(PreTrainedConfig):
    """A language-conditioned policy, small enough for a laptop CPU.

    The actor sees one camera image, or the environment's state in its place, the proprioception
    (`observation.state`) and the instruction (`task`), and returns one bin per action dimension, or with
    `head=flow` a chunk of continuous actions.
    """

    observation: Observation = "auto"
    """What the actor sees besides proprioception and instruction: `image`, `environment_state`, or `auto`:
    the image if the data has one. A data set may hold both; the actor ignores the one not named here."""
    image_key: str | None = None
    """Which camera, e.g. `observation.images.front`. None: the only one there is."""
    critic_observation: CriticObservation = "actor"
    """What the value network sees: `actor` (as the actor does) or `environment_state` (a privileged critic,
    asymmetric actor-critic). It is used in training only."""
    bodies: list[str] = field(default_factory=list)
    """Bodies that the privileged state describes, in its order; taken from the dataset."""
    hand: list[int] = field(default_factory=list)
    """Where `observation.state` has the hand's position; taken from the dataset."""
    joints: list[int] = field(default_factory=list)
    """With `head=flow`: where `observation.state` has the joint that each dimension of the action moves, -1 for
    the gripper and where there is none. Chunks are relative to these joints. Taken from the dataset; empty if the
    actions move no joint of it."""
    view: View | None = None
    """With an image actor: where the camera sees the bodies, by which cloning teaches the encoder; taken from
    the dataset, null if that does not say."""
    freeze_encoder: bool = True
    """With an image actor: reinforcement learning leaves the encoder as it was cloned. What it says of a picture
    is then computed once, while acting, and an update costs what it costs from the privileged state. Cloning
    always trains everything."""

    head: Head = "gaussian"
    """`gaussian`: a mean and one sigma per dimension generate the bins' logits, the gripper has a sign.
    `categorical`: a free logit for every bin.
    `flow`: a chunk of continuous actions, integrated from noise (flow matching)."""
    num_bins: int = 256
    """Bins per action dimension, equal parts of [-1, 1]."""
    gripper_dim: int | None = -1
    """Index of the gripper among the action's dimensions (`gaussian` head only); None for none."""
    sigma_init: float = 0.2
    """Initial standard deviation of the `gaussian` head, in normalised action units."""
    sigma_min: float = 0.05
    """Smallest standard deviation that can be learned; below half a bin nothing is explored."""
    sigma_max: float = 0.6
    """Largest standard deviation that can be learned."""
    gripper_logit_limit: float = 5.0
    """Largest logit of the gripper's sign (`gaussian` head): at temperature 1 the less likely command keeps a
    probability of 0.7 %, so that reinforcement learning still explores when to close and open."""
    temperature: float = 0.6
    """Sampling temperature of `select_action`: logits are divided by it; 0 takes the likeliest bin. `flow`,
    which begins with noise, has none."""
    action_bounds: BoundsSource = "bridge_orig"
    """Physical actions that -1 and 1 stand for: the 1st and 99th percentile of BridgeData V2, as in OpenVLA
    (7 dimensions), the data set's own minimum and maximum, or, with `unit`, -1 and 1. Fixed at the first
    training."""

    chunk_size: int | None = None
    """Actions that the `flow` head predicts at once, H; null is 4. The other heads predict one."""
    n_action_steps: int | None = None
    """How many of them are played before the policy looks again, the first ones; null is 2, of one action 1."""
    num_inference_steps: int = 5
    """Euler steps from noise to actions (`flow` head)."""
    flow_width: int = 256
    """Width of the `flow` head's layers."""
    flow_depth: int = 3
    """Number of the `flow` head's residual blocks."""
    flow_draws: int = 4
    """Noises and times that behaviour cloning draws for each chunk of a batch; the trunk is asked only once."""

    task_width: int = 64
    """Width of the instruction's embedding."""
    vocabulary_size: int = 1024
    """Hash buckets for words and pairs of words."""
    hidden_width: int = 256
    """Width of the trunk's layers."""
    hidden_depth: int = 3
    """Number of the trunk's layers."""
    value_width: int = 256
    """Width of the value head's hidden layer."""
    dtype: Precision = "auto"
    """Format of the convolutions: `auto` is bfloat16 where the hardware multiplies it and oneDNN may use it,
    float32 elsewhere. All else, action probabilities included, is float32."""

    optimizer_lr: float = 3e-3
    """Peak learning rate of behaviour cloning."""
    optimizer_sigma_lr: float = 1e-2
    """Peak learning rate of the raw sigmas, which have far to go and see every sample."""
    optimizer_weight_decay: float = 1e-4
    """AdamW's weight decay of the encoder and the actor's matrices; its biases, norms, embeddings and sigmas have
    none."""
    optimizer_grad_clip_norm: float = 10.0
    """Largest gradient norm in behaviour cloning."""
    scheduler_warmup_steps: int = 1000
    """Warm-up updates of a run of `scheduler_decay_steps`; LeRobot scales both down for shorter runs."""
    scheduler_decay_steps: int = 100_000
    """Updates until the learning rate has decayed."""
    scheduler_decay_lr: float = 1e-5
    """Learning rate after the decay."""

    normalization_mapping: dict[str, NormalizationMode] = field(
        default_factory=lambda: {
            "VISUAL": NormalizationMode.IDENTITY,
            "STATE": NormalizationMode.MEAN_STD,
            "ENV": NormalizationMode.MEAN_STD,
            # The processor's own action-bounds step scales actions; see action_bounds.py.
            "ACTION": NormalizationMode.IDENTITY,
        }
    )
    """LeRobot's normalisation per kind of feature."""

    def __post_init__(self) -> None:
        """Check all that can be checked without the features.

        Raises:
            ValueError: naming the bad value and the valid ones.
        """
        super().__post_init__()
        self._check_choices_and_ranges()
        self._check_chunk()

    def _check_choices_and_ranges(self) -> None:
        for name, choices in (
            ("observation", Observation),
            ("critic_observation", CriticObservation),
            ("head", Head),
            ("action_bounds", BoundsSource),
            ("dtype", Precision),
        ):
            if getattr(self, name) not in get_args(choices):
                raise ValueError(f"{name}={getattr(self, name)!r} is not one of {list(get_args(choices))}")
        if self.n_obs_steps != 1:
            raise ValueError(f"n_obs_steps={self.n_obs_steps}: PocketVLA sees one step, n_obs_steps must be 1")
        if not 0 < self.sigma_min < self.sigma_init < self.sigma_max:
            raise ValueError(
                "0 < sigma_min < sigma_init < sigma_max is needed, got "
                f"{self.sigma_min}, {self.sigma_init}, {self.sigma_max}"
            )
        if self.head == "gaussian" and 2 / self.num_bins > self.sigma_min:
            raise ValueError(
                f"num_bins={self.num_bins}: bins must not be wider than sigma_min={self.sigma_min}, so at least "
                f"{math.ceil(2 / self.sigma_min)}"
            )
        for name, least in LEAST.items():
            if not getattr(self, name) >= least:
                raise ValueError(f"{name}={getattr(self, name)} must be at least {least}")

    def _check_chunk(self) -> None:
        if self.chunk_size is None:
            self.chunk_size = DEFAULT_CHUNK_SIZE if self.head == "flow" else 1
        if self.n_action_steps is None:
            self.n_action_steps = min(DEFAULT_ACTION_STEPS, self.chunk_size)
        if self.head != "flow" and self.chunk_size != 1:
            raise ValueError(
                f"chunk_size={self.chunk_size}: head={self.head} predicts one action, chunk_size must be 1; "
                "head=flow predicts chunks"
            )
        if not 1 <= self.n_action_steps <= self.chunk_size:
            raise ValueError(
                f"n_action_steps={self.n_action_steps} must be at least 1 and at most chunk_size={self.chunk_size}"
            )

    @property
    def actor_observation(self) -> Literal["image", "environment_state"]:
        """`observation` with `auto` resolved by the input features."""
        if self.observation == "auto":
            return "image" if self.image_features else "environment_state"
        return self.observation

    @property
    def camera(self) -> tuple[str, tuple[int, int, int]]:
        """Key and (channels, height, width) of the image the actor sees.

        Raises:
            ValueError: when there is no image feature, several and no `image_key`, or none of that name.
        """
        images = self.image_features
        key = next(iter(images)) if self.image_key is None and len(images) == 1 else self.image_key
        if key not in images:
            raise ValueError(f"image_key={key!r} must be one of the image features {sorted(images)}")
        channels, height, width = images[key].shape
        return key, (channels, height, width)

    @property
    def unscaled_images(self) -> tuple[str, ...]:
        """Keys of the images that must have the size that the policy was made for."""
        return (self.camera[0],) if self.actor_observation == "image" else ()

    @property
    def state_width(self) -> int:
        """Width of `observation.state`, 0 without it."""
        return self.robot_state_feature.shape[0] if self.robot_state_feature else 0

    @property
    def environment_state_width(self) -> int:
        """Width of the environment state as the policy reads it, 0 without it."""
        if self.bodies:
            return BODY_WIDTH * len(self.bodies)
        return self.env_state_feature.shape[0] if self.env_state_feature else 0

    @property
    def action_dim(self) -> int:
        """Number of action dimensions."""
        if self.action_feature is None:
            raise ValueError(f"output_features must hold 'action', got {sorted(self.output_features or {})}")
        return self.action_feature.shape[0]

    @property
    def chunk_shape(self) -> tuple[int, int]:
        """(H, action dimensions) of what the head predicts."""
        assert self.chunk_size is not None
        return self.chunk_size, self.action_dim

    def physical_bounds(self, stats: dict[str, dict[str, Any]] | None) -> tuple[list[float], list[float]]:
        """Lowest and highest physical action, from `action_bounds` and, for `dataset`, its statistics.

        Raises:
            ValueError: when the bounds do not fit the action, or statistics are needed and missing.
        """
        if self.action_bounds == "bridge_orig":
            low, high = (list(side) for side in BRIDGE_ORIG_BOUNDS)
        elif self.action_bounds == "unit":
            low, high = [-1.0] * self.action_dim, [1.0] * self.action_dim
        elif stats is None or "action" not in stats:
            raise ValueError("action_bounds='dataset' needs the data set's statistics of 'action'")
        else:
            low, high = ([float(v) for v in stats["action"][side]] for side in ("min", "max"))
        if len(low) != self.action_dim:
            raise ValueError(
                f"action_bounds={self.action_bounds!r} has {len(low)} dimensions, the action has "
                f"{self.action_dim}; use action_bounds='dataset'"
            )
        return low, high

    def set_dataset_feature_metadata(self, features: dict[str, dict[str, Any]]) -> None:
        """Take from a dataset what its states and pictures show; LeRobot calls this before training.

        A policy that has weights keeps what these were trained on.
        """
        if self.pretrained_path:
            return
        state, privileged = features.get(OBS_STATE, {}), features.get(OBS_ENV_STATE, {})
        names = list(state.get("names") or [])
        moved = [name if "gripper" not in name else None for name in features.get(ACTION, {}).get("names") or []]
        if self.head == "flow" and self.robot_state_feature and set(moved) & set(names):
            self.joints = [names.index(name) if name in names else -1 for name in moved]
        hand = [f"ee.{axis}" for axis in "xyz"]
        bodies = bodies_named(privileged.get("names"))
        from_pictures, has_hand = self.actor_observation == "image", set(hand) <= set(names)
        if not bodies or (from_pictures and not has_hand):
            return
        self.bodies = bodies
        self.hand = [names.index(name) for name in hand] if has_hand else []
        # The policy's own step scales them; see bodies.py.
        self.normalization_mapping["ENV"] = NormalizationMode.IDENTITY
        keypoints = privileged.get("keypoints")
        if from_pictures and keypoints and "projection" in features[self.camera[0]]:
            self.view = View(features[self.camera[0]]["projection"], [keypoints[body] for body in self.bodies])

    def validate_features(self) -> None:
        """Check the features once they are known; LeRobot's policies call this when they are built.

        Raises:
            ValueError: when an input that the configuration asks for is missing.
        """
        if self.actor_observation == "image":
            _ = self.camera
        for name, wanted in (
            ("observation", self.actor_observation),
            ("critic_observation", self.critic_observation),
        ):
            if wanted == "environment_state" and not self.environment_state_width:
                raise ValueError(
                    f"{name}='environment_state' needs the feature 'observation.environment_state', got "
                    f"{sorted(self.input_features or {})}"
                )
        if self.gripper_dim is not None and not -self.action_dim <= self.gripper_dim < self.action_dim:
            raise ValueError(f"gripper_dim={self.gripper_dim} is outside an action of {self.action_dim}")

    def get_optimizer_preset(self) -> AdamWConfig:
        """Return AdamW for behaviour cloning from scratch."""
        return AdamWConfig(
            lr=self.optimizer_lr,
            weight_decay=self.optimizer_weight_decay,
            grad_clip_norm=self.optimizer_grad_clip_norm,
        )

    def get_scheduler_preset(self) -> CosineDecayWithWarmupSchedulerConfig:
        """Return linear warm-up and cosine decay."""
        return CosineDecayWithWarmupSchedulerConfig(
            num_warmup_steps=self.scheduler_warmup_steps,
            num_decay_steps=self.scheduler_decay_steps,
            peak_lr=self.optimizer_lr,
            decay_lr=self.scheduler_decay_lr,
        )

    @property
    def observation_delta_indices(self) -> None:
        """No history of observations."""
        return None

    @property
    def action_delta_indices(self) -> list[int] | None:
        """The steps of the chunk (`flow` head); else None, the action of the same step alone."""
        return list(range(self.chunk_size or 1)) if self.head == "flow" else None

    @property
    def reward_delta_indices(self) -> None:
        """No rewards."""
        return None
