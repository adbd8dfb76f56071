"""What a published checkpoint's config.json says of the network."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

IMAGENET_MEAN, IMAGENET_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
HALF = (0.5, 0.5, 0.5)
ATTENTION = ("sdpa", "eager", "flash_attention_2")
"""Ways of computing the language model's attention."""

SUPPORTED = {
    "model_type": "openvla",
    "arch_specifier": "no-align+fused-gelu-mlp",
    "use_fused_vision_backbone": True,
    "image_resize_strategy": "resize-naive",
}
"""The fields of config.json that decide what the network is, and the only values that are implemented."""
SUPPORTED_PREPROCESSING = {
    "image_resize_strategy": "resize-naive",
    "tvf_do_letterbox": False,
    "interpolations": ["bicubic", "bicubic"],
}
"""The same of preprocessor_config.json: how an image comes to the towers' size."""

Triple = tuple[float, float, float]


@dataclass(frozen=True)
class Architecture:
    """Sizes and constants of an OpenVLA network."""

    timm_model_ids: tuple[str, str]
    """Names of the two vision towers in timm: DINOv2 and SigLIP."""
    act_layers: tuple[str | None, str | None]
    """Activation of each tower, None for timm's own."""
    image_size: int
    """Side of the square image that both towers see [px]."""
    image_means: tuple[Triple, Triple]
    """Mean of each colour channel for each tower, of images in [0, 1]."""
    image_stds: tuple[Triple, Triple]
    """Standard deviation of each colour channel for each tower."""
    text_config: dict[str, Any]
    """Fields of the Llama config; transformers' defaults, those of Llama-7B, hold for the rest."""
    n_action_bins: int
    """Action tokens; the ends of the bins are this many points from -1 to 1."""
    pad_to_multiple_of: int
    """Rows of the embedding beyond the real vocabulary."""

    @property
    def vocabulary_size(self) -> int:
        """Tokens of the real vocabulary; the action tokens are the last ones of them."""
        return self.text_config["vocab_size"] - self.pad_to_multiple_of

    @classmethod
    def from_published(cls, config: dict[str, Any], preprocessor: dict[str, Any] | None) -> Architecture:
        """Read a published config.json and, if there is one, preprocessor_config.json.

        Published preprocessors hold ImageNet's statistics rounded to bfloat16, which the network was trained
        with; without the file they are ImageNet's for the first tower and 0.5 for the second.

        Raises:
            ValueError: it is another kind of network.
        """
        for name, value in SUPPORTED.items():
            if config.get(name, value) != value or "model_type" not in config:
                raise ValueError(f"config.json has {name}={config.get(name)!r}; only {value!r} is supported.")
        for name, value in SUPPORTED_PREPROCESSING.items():
            if preprocessor and preprocessor.get(name, value) not in (value, None):
                raise ValueError(
                    f"preprocessor_config.json has {name}={preprocessor[name]!r}; only {value!r} is supported: "
                    "images would not be what the network was trained with."
                )
        sizes = set(config["image_sizes"])
        if len(sizes) != 1 or len(config["timm_model_ids"]) != 2:
            raise ValueError(
                "Two vision towers on images of one size are supported, got "
                f"timm_model_ids={config['timm_model_ids']} and image_sizes={config['image_sizes']}."
            )
        means, stds = (IMAGENET_MEAN, HALF), (IMAGENET_STD, HALF)
        if preprocessor and "means" in preprocessor:
            means, stds = preprocessor["means"], preprocessor["stds"]
        if preprocessor and "tvf_normalize_params" in preprocessor:
            means = [tower["mean"] for tower in preprocessor["tvf_normalize_params"]]
            stds = [tower["std"] for tower in preprocessor["tvf_normalize_params"]]
        return cls.from_dict(
            {
                "timm_model_ids": config["timm_model_ids"],
                "act_layers": config.get("timm_override_act_layers") or (None, None),
                "image_size": sizes.pop(),
                "image_means": means,
                "image_stds": stds,
                "text_config": config["text_config"],
                "n_action_bins": config["n_action_bins"],
                "pad_to_multiple_of": config["pad_to_multiple_of"],
            }
        )

    @classmethod
    def from_dict(cls, fields: dict[str, Any]) -> Architecture:
        """Read what `to_dict` returned, from JSON too."""

        def pair(values: Any) -> Any:
            first, second = (tuple(v) if isinstance(v, list | tuple) else v for v in values)
            return first, second

        pairs = {
            name: pair(fields[name]) for name in ("timm_model_ids", "act_layers", "image_means", "image_stds")
        }
        return cls(**(fields | pairs))

    def to_dict(self) -> dict[str, Any]:
        """Return the fields as JSON-ready values."""
        return asdict(self)
