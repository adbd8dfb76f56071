"""Where a policy comes from, and what tells it from another: the commit on the Hub, a hash of what was loaded."""

from __future__ import annotations

import hashlib
import io
import json
import sys
from collections.abc import Iterator
from contextlib import redirect_stderr
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import draccus
from httpx import HTTPError
from huggingface_hub import HfApi, snapshot_download
from huggingface_hub.constants import CONFIG_NAME
from huggingface_hub.errors import HFValidationError
from lerobot.configs import PreTrainedConfig
from lerobot.utils.constants import LAST_CHECKPOINT_LINK

from cronos_lerobot.bases import official_base, official_bases

FILES = ("*.json", "*.safetensors", "*.model", "*.txt")
"""What a policy is loaded from: configs, weights, tokenizers."""

PUSHED = ("push_to_hub", "repo_id", "private", "tags", "license")
"""Fields of a policy's config that say where it is pushed to, and how."""
PINNED = "pretrained_revision"
"""Field of a policy's config with its commit on the Hub."""
UNDECISIVE = ("pretrained_path", PINNED, *PUSHED)
"""Fields of a policy's config that say where it is, not what it does."""

ADAPTER_CONFIG, BASE, REVISION = "adapter_config.json", "base_model_name_or_path", "revision"
"""PEFT's file beside adapters, and its fields about the policy that they go onto."""


@dataclass(frozen=True)
class PolicySource:
    """A checkpoint as it was when it was looked up."""

    name: str
    """As it was given: a folder, an official base, or `<owner>/<repository>[@<revision>]` on the Hub. A run's last
    checkpoint has the name that it had then."""
    folder: Path
    """Its files; those of the Hub in the cache, all of one commit."""
    revision: str | None = None
    """The Hub's commit."""


def find_policy(name: str) -> PolicySource:
    """Find a checkpoint; one on the Hub is downloaded whole, so that all of it is of one commit.

    Raises:
        ValueError: it is neither a folder with a config.json nor a repository's name.
        OSError: the Hub has no such repository, or cannot be reached.
    """
    if (official := official_base(name)) != name:
        return PolicySource(name, Path(official))
    folder = Path(name)
    if folder.is_dir():
        if not (folder / CONFIG_NAME).is_file():
            raise ValueError(f"{name} is no checkpoint of a policy: it has no {CONFIG_NAME}")
        followed = follow_last(folder)
        return PolicySource(name if followed == folder else str(followed), followed)
    repository, _, revision = name.partition("@")
    if "/" not in repository:
        raise ValueError(
            f"{name} is neither a folder, nor <owner>/<repository> on the Hub, nor an official base: "
            f"{official_bases()}"
        )
    snapshot = Path(snapshot_download(repository, revision=revision or None, allow_patterns=list(FILES)))
    return PolicySource(name, snapshot, snapshot.name)


def follow_last(folder: Path) -> Path:
    """`folder` below the checkpoint that is the last one now: a run that continues has another one soon."""
    for link in (folder, *folder.parents):
        if link.name == LAST_CHECKPOINT_LINK and link.is_symlink():
            return link.parent / link.readlink() / folder.relative_to(link)
    return folder


def pin_policy(name: str, given: str | None) -> tuple[str, str | None]:
    """Hold a policy of the Hub at the commit that it is at now, or at the revision that is given.

    Args:
        name: a folder or an official base, which have no revision, or `<owner>/<repository>[@<revision>]`.
        given: the revision that `--policy.pretrained_revision` says.

    Returns:
        The folder, or the name without its revision, and the commit.

    Raises:
        ValueError: two revisions are given.
    """
    name = official_base(name)
    if Path(name).is_dir():
        return str(follow_last(Path(name))), None
    repository, _, revision = name.partition("@")
    if revision and given and given != revision:
        raise ValueError(f"--policy.path={name} and --policy.{PINNED}={given} are two revisions: give one.")
    wanted = revision or given or None
    try:
        return repository, HfApi().model_info(repository, revision=wanted).sha or wanted
    except (OSError, HTTPError, HFValidationError):
        # It may be in the cache; who loads it says what is wrong.
        return repository, wanted


def load_policy_config(path: str | Path, overrides: list[str], revision: str | None = None) -> PreTrainedConfig:
    """Return the config of the policy that `--policy.path` names.

    Args:
        path: a folder, or a repository of the Hub.
        overrides: flags of the config.
        revision: of the repository, which the config then says.

    Raises:
        ValueError: there is no such folder or repository, or what it has is damaged.
    """
    folder, said = Path(path), io.StringIO()
    try:
        # argparse prints its whole usage for a flag that the policy does not have.
        with redirect_stderr(said):
            config = PreTrainedConfig.from_pretrained(path, revision=revision, cli_overrides=overrides)
    except SystemExit as error:
        why = said.getvalue().strip().rpartition("error: ")[2].replace("--", "--policy.")
        raise ValueError(f"--policy.path={path}: {why}") from error
    except (json.JSONDecodeError, draccus.ParsingError) as error:
        # draccus keeps what a policy's config says of its values in the cause.
        why = error.__cause__ or error
        raise ValueError(f"{folder / CONFIG_NAME} is damaged, or --policy.* does not fit it: {why}") from error
    except (OSError, ValueError) as error:
        nowhere = (
            f"no such folder, no such policy on the Hub ({type(error).__name__}), and none of the official bases, "
            f"{official_bases()}."
        )
        raise ValueError(f"--policy.path={path}: {error if folder.is_dir() else nowhere}") from error
    sys.stderr.write(said.getvalue())
    config.pretrained_path = folder
    if revision is not None:
        config.pretrained_revision = revision
    return config


def fingerprint(policy: PreTrainedConfig) -> str:
    """A short hash of all that decides a policy's actions: its config, its weights and its processors.

    Weights that the config names (`checkpoint`, `adapter`) count too: by their files, or the Hub's commit. It is
    the same on every device.
    """
    config = {name: value for name, value in draccus.encode(policy).items() if name not in (*UNDECISIVE, "device")}
    folder = Path(policy.pretrained_path or "")
    named = [
        content
        for field in ("checkpoint", "adapter")
        if (name := getattr(policy, field, None))
        for content in _named_weights(name, folder, getattr(policy, f"{field}_revision", None))
    ]
    flags = json.dumps(config, sort_keys=True, default=str).encode()
    return _digest(flags, *_files(folder, with_base=True), *named)


def files_fingerprint(folder: Path, *, with_base: bool = True) -> str:
    """A short hash of a checkpoint's weights and processors, whatever flags make of its config.

    Args:
        folder: the checkpoint.
        with_base: include the policy that PEFT's adapters go onto, which has another name once published.
    """
    return _digest(*_files(folder, with_base))


def _digest(*contents: bytes) -> str:
    digest = hashlib.sha256()
    for content in contents:
        digest.update(content)
    return digest.hexdigest()[:16]


def _files(folder: Path, with_base: bool) -> Iterator[bytes]:
    """Weights and processors; not config.json, which flags may change, nor how it was made (train_config.json)."""
    for pattern in ("*.safetensors", "policy_*.json"):
        yield from (file.name.encode() + _hash(file) for file in sorted(folder.glob(pattern)))
    if adapters := _adapter_config(folder):
        settings = {name: value for name, value in adapters.items() if name not in (BASE, REVISION)}
        yield json.dumps(settings, sort_keys=True).encode()
    name, base = find_base(folder)
    if with_base and base is not None:
        yield from (file.name.encode() + _hash(file) for file in sorted(base.glob("*.safetensors")))
    elif with_base and name is not None:
        yield f"{name} {adapters.get(REVISION)}".encode()


def find_base(folder: Path | str) -> tuple[str | None, Path | None]:
    """The policy that PEFT's adapters in `folder` go onto: as they name it, and its folder if it has one.

    The name may be relative to where the training ran, such as outputs/clone. None, None without adapters.
    """
    name = _adapter_config(Path(folder)).get(BASE)
    return (name, _find_weights(name, Path(folder))) if name else (None, None)


def _find_weights(name: str, folder: Path) -> Path | None:
    """The folder with weights that a checkpoint names, seen from the folders above it or from here."""
    places = (*(parent / name for parent in folder.absolute().parents), Path(name))
    return next((place for place in places if any(place.glob("*.safetensors"))), None)


def _named_weights(name: str, folder: Path, revision: str | None) -> list[bytes]:
    if place := _find_weights(name, folder):
        return [_hash(file) for file in sorted(place.glob("*.safetensors"))]
    return [_commit(name, revision).encode()]


def _adapter_config(folder: Path) -> dict[str, Any]:
    path = folder / ADAPTER_CONFIG
    return json.loads(path.read_text()) if path.is_file() else {}


def _hash(file: Path) -> bytes:
    with file.open("rb") as content:
        return hashlib.file_digest(content, "sha256").digest()


def _commit(repository: str, revision: str | None) -> str:
    """The commit of a repository on the Hub, or of its copy in the cache where the Hub cannot be reached."""
    try:
        return HfApi().model_info(repository, revision=revision).sha or repository
    except (OSError, HTTPError):
        copied = snapshot_download(
            repository, revision=revision, local_files_only=True, allow_patterns=["config.json"]
        )
        return Path(copied).name
