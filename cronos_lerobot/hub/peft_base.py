"""Adapters (PEFT, LoRA) are of a base policy, which others can load only from the Hub."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from cronos_lerobot.evaluation.policy_source import ADAPTER_CONFIG, BASE, REVISION
from cronos_lerobot.hub.runs import is_repository

CHECKPOINT, CHECKPOINT_REVISION = "checkpoint", "checkpoint_revision"
"""OpenVLA's own names of them, in config.json."""


def find_base(model: Path, base_policy: str | None) -> str | None:
    """The repository of the policy that the adapters in `model` are of; None for a whole policy.

    Args:
        model: folder of the policy.
        base_policy: the repository, if they name a folder.

    Raises:
        ValueError: they name a folder, and there is no `base_policy`; or their configuration is damaged.
    """
    if not (model / ADAPTER_CONFIG).is_file():
        return None
    base = _read(model / ADAPTER_CONFIG).get(BASE)
    # A folder may have been named from where the training ran, such as outputs/clone.
    is_local = not is_repository(base) or any((parent / str(base)).exists() for parent in model.parents)
    if not is_local:
        return str(base)
    if base_policy is None:
        raise ValueError(
            f"{model} holds adapters of the policy in {base}, a folder that nobody else has: publish that policy"
            " first (cronos-publish policy --path=<the folder>), then give its repository here,"
            " --base_policy=<owner>/<name>"
        )
    return base_policy


def name_base(folder: Path, base: str) -> None:
    """Have the adapters in `folder` name the repository `base`; those that do stay as they are."""
    adapter, policy = folder / ADAPTER_CONFIG, folder / "config.json"
    if _read(adapter).get(BASE) != base:
        _change(adapter, {BASE: base, REVISION: None})
    named = _read(policy).get(CHECKPOINT)
    if named and not is_repository(named):
        _change(policy, {CHECKPOINT: base, CHECKPOINT_REVISION: None})


def _change(path: Path, changes: dict[str, Any]) -> None:
    path.write_text(json.dumps(_read(path) | changes, indent=2))


def _read(path: Path) -> dict[str, Any]:
    try:
        return dict(json.loads(path.read_text()))
    except (ValueError, TypeError) as error:
        raise ValueError(f"{path} is damaged: {error}") from error
