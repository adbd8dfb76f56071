"""The published model class as transformers and PEFT see it: a PreTrainedModel with the published names."""

from published_checkpoint import Parts
from torch import nn
from transformers import PretrainedConfig, PreTrainedModel


class PublishedConfig(PretrainedConfig):
    model_type = "openvla"


class PublishedModel(PreTrainedModel):
    """Holds the modules; in and output layer are the language model's, which is what PEFT asks for."""

    config_class = PublishedConfig
    supports_gradient_checkpointing = True

    def __init__(self, parts: Parts) -> None:
        super().__init__(PublishedConfig(tie_word_embeddings=False))
        self.vision_backbone = nn.Module()
        self.vision_backbone.featurizer = parts.featurizer
        self.vision_backbone.fused_featurizer = parts.fused_featurizer
        self.projector = parts.projector
        self.language_model = parts.language_model

    def get_input_embeddings(self) -> nn.Module:
        return self.language_model.get_input_embeddings()

    def get_output_embeddings(self) -> nn.Module:
        return self.language_model.get_output_embeddings()
