"""SmolVLA, pi0 and pi0.5 with random weights, small enough for a test."""

import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.policies import make_policy_config, make_pre_post_processors
from lerobot.policies.factory import get_policy_class
from tiny_checkpoints import save_policy
from tiny_pi0 import save_tiny_tokenizer, tiny_gemma, tokenizer_from, use_tokenizer
from tiny_smolvla import pretend_num2words, save_tiny_smolvlm

KINDS = ("smolvla", "pi0", "pi05")
CHUNK, PLAYED, DIMS, PADDED, STATE, STEPS = 6, 4, 3, 5, 4, 3
"""Actions of a chunk, those of them that are played; dimensions of an action, the same with padding, those of the
state; steps of the denoising."""
INPUTS = {
    "observation.state": PolicyFeature(FeatureType.STATE, (STATE,)),
    "observation.images.front": PolicyFeature(FeatureType.VISUAL, (3, 32, 32)),
}
OUTPUTS = {"action": PolicyFeature(FeatureType.ACTION, (DIMS,))}


def own_options(kind, folder):
    """What makes a kind small; `folder` gets what LeRobot would fetch from the Hub."""
    if kind == "smolvla":
        pretend_num2words()
        save_tiny_smolvlm(folder / "vlm")
        own = {"vlm_model_name": str(folder / "vlm"), "num_vlm_layers": 2, "num_steps": STEPS}
        return own | {"resize_imgs_with_padding": (32, 32)}
    save_tiny_tokenizer(folder / "tokenizer")
    return {"image_resolution": (28, 28), "num_inference_steps": STEPS}


def save_clone(kind, folder):
    """An untrained policy of pictures of 64 x 64 that plays five actions, as a checkpoint in `folder`."""
    pixels = {"observation_height": 64, "observation_width": 64}
    own = own_options(kind, folder)
    with tiny_gemma(), tokenizer_from(folder / "tokenizer"):
        clone = save_policy(folder / "clone", kind, pixels, chunk_size=CHUNK, n_action_steps=5, **own)
    use_tokenizer(clone, folder / "tokenizer")
    return clone


def make_vla(kind, folder, **options):
    """An untrained policy; `folder` gets what LeRobot would fetch from the Hub."""
    own = own_options(kind, folder)
    sizes = {"chunk_size": CHUNK, "n_action_steps": PLAYED, "max_action_dim": PADDED}
    features = {"input_features": dict(INPUTS), "output_features": dict(OUTPUTS)}
    config = make_policy_config(
        kind, **{**features, **sizes, **own, "device": "cpu", "push_to_hub": False} | options
    )
    torch.manual_seed(0)
    with tiny_gemma():
        policy = get_policy_class(kind)(config).eval()
    for name, param in policy.named_parameters():
        # Left at LeRobot's initial values, a narrow network hardly looks at what it is shown.
        if param.ndim > 1:
            torch.nn.init.normal_(param, std=0.3 if "embed" in name else param[0].numel() ** -0.5)
    return policy


def make_processors(policy, folder, stats=None):
    """LeRobot's own processors; those of pi0 and pi0.5 with the tokenizer in `folder`."""
    with tokenizer_from(folder / "tokenizer"):
        return make_pre_post_processors(policy.config, dataset_stats=stats)


def save_vla(policy, processors, checkpoint, folder):
    """What `lerobot-train` saves, with the tokenizer in `folder`."""
    policy.save_pretrained(checkpoint)
    for processor in processors:
        processor.save_pretrained(checkpoint)
    use_tokenizer(checkpoint, folder / "tokenizer")
    return checkpoint


def make_batch(n=3, words=(5, 3, 6)):
    """Observations as the policy's preprocessor returns them, instructions of different lengths among them."""
    generator = torch.Generator().manual_seed(1)
    tokens = torch.randint(2, 6, (n, max(words[:n])), generator=generator)
    mask = torch.arange(tokens.shape[1]) < torch.tensor(words[:n])[:, None]
    return {
        "observation.state": torch.randn((n, STATE), generator=generator),
        "observation.images.front": torch.rand((n, 3, 32, 32), generator=generator),
        "observation.language.tokens": tokens.where(mask, 0),
        "observation.language.attention_mask": mask,
        "task": ["put it there"] * n,
    }
