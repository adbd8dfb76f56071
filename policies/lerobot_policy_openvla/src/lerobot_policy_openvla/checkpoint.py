"""Checkpoints to start from: the published format, or a whole OpenVLA in LeRobot's format."""

from __future__ import annotations

import json
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from httpx import HTTPError
from huggingface_hub import snapshot_download
from huggingface_hub.errors import HFValidationError
from safetensors import safe_open

from lerobot_policy_openvla.architecture import Architecture

CONFIG, PREPROCESSOR = "config.json", "preprocessor_config.json"
STATISTICS = "dataset_statistics.json"
"""Action statistics of a fine-tuning run, beside what it trained."""
WEIGHTS, WEIGHTS_INDEX = "model.safetensors", "model.safetensors.index.json"
NETWORK_PREFIX = "network."
"""Where the network is in a policy's model.safetensors."""
FILES = ["*.json", "*.safetensors"]


@dataclass(frozen=True)
class Checkpoint:
    """A folder with weights, a tokenizer and what is needed to use them."""

    folder: Path
    architecture: Architecture
    action_statistics: dict[str, dict[str, Any]]
    """By data set: q01, q99 and mask of its actions, among others."""
    prefix: str
    """What the names of the network's tensors begin with."""


def fetch(name: str, revision: str | None = None) -> Path:
    """Return the folder `name`, or that of the Hub repository of that name, downloaded if need be.

    Raises:
        FileNotFoundError: there is no such folder, and no such repository that can be reached.
    """
    if Path(name).is_dir():
        return Path(name)
    try:
        return Path(snapshot_download(name, revision=revision, allow_patterns=FILES))
    except (OSError, HTTPError, HFValidationError) as error:
        # Of a commit the Hub is asked for the list of its files, also offline, unless the cache has that.
        with suppress(OSError, HTTPError, HFValidationError):
            return Path(snapshot_download(name, revision=revision, allow_patterns=FILES, local_files_only=True))
        raise FileNotFoundError(
            f"{name} is no folder, seen from here or from above the policy that names it, and the Hub did not "
            f"give it: {error}"
        ) from error


def commit_of(name: str, folder: Path) -> str | None:
    """The commit of the Hub that `fetch(name)` returned as `folder`; None where `name` is a folder itself."""
    return None if Path(name).is_dir() else folder.name


def seen_from(folder: Path, name: str) -> str:
    """`name`, or the folder of that name above `folder`: it may have been named from where a training ran."""
    if Path(name).is_dir():
        return name
    above = (parent / name for parent in folder.absolute().parents)
    return str(next((place for place in above if place.is_dir()), name))


def read_checkpoint(name: str, revision: str | None = None) -> Checkpoint:
    """Read all of a checkpoint but its weights.

    Args:
        name: a folder or a repository on the Hub, in the published format or in LeRobot's.
        revision: of the repository.

    Raises:
        FileNotFoundError: there is no config.json.
        ValueError: it is not an OpenVLA, or has only adapters.
    """
    folder = fetch(name, revision)
    config = read_json(folder / CONFIG)
    if config.get("type") == "openvla":
        if not config.get("architecture") or not holds_network(folder):
            raise ValueError(f"{name} holds adapters, not a whole network; use it as --policy.path.")
        statistics = {config["action_statistics"]["key"]: config["action_statistics"]}
        return Checkpoint(folder, Architecture.from_dict(config["architecture"]), statistics, NETWORK_PREFIX)
    preprocessor = read_json(folder / PREPROCESSOR) if (folder / PREPROCESSOR).is_file() else None
    architecture = Architecture.from_published(config, preprocessor)
    statistics = tuned_statistics(folder) or _actions(config.get("norm_stats", {}))
    return Checkpoint(folder, architecture, statistics, "")


def tuned_statistics(folder: Path) -> dict[str, dict[str, Any]] | None:
    """Return the action statistics in the folder's dataset_statistics.json, None without that file.

    They take the place of all that the checkpoint below has, as the published loader does it.
    """
    path = folder / STATISTICS
    return _actions(read_json(path)) if path.is_file() else None


def _actions(published: dict[str, Any]) -> dict[str, dict[str, Any]]:
    return {key: value["action"] for key, value in published.items()}


def holds_network(folder: Path) -> bool:
    """Whether a folder in LeRobot's format has the whole network, not adapters only."""
    return (folder / WEIGHTS).is_file() and f"{NETWORK_PREFIX}projector.fc1.weight" in tensor_names(
        folder / WEIGHTS
    )


def tensor_names(path: Path) -> list[str]:
    """Names in a safetensors file."""
    with safe_open(path, framework="pt") as file:
        return list(file.keys())


def timm_name(name: str) -> str:
    """The published name of a tensor -> ours: the layer scales of the towers are called `gamma` in timm."""
    return name.replace(".scale_factor", ".gamma") if name.startswith("vision_backbone.") else name


def read_json(path: Path) -> dict[str, Any]:
    """Return what a file of JSON says."""
    return json.loads(path.read_text())
