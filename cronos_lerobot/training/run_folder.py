"""A run's folder: where it resumes from, and its manifest of every start, with machine and versions."""

from __future__ import annotations

import json
import logging
import os
import platform
import shutil
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from lerobot.utils.constants import CHECKPOINTS_DIR, LAST_CHECKPOINT_LINK

from cronos_lerobot.evaluation.policy_source import files_fingerprint
from cronos_lerobot.provenance import git_commit, package_versions
from cronos_lerobot.whole_files import written_whole

if TYPE_CHECKING:
    from cronos_lerobot.protocol.streams import EnvIdentity
    from cronos_lerobot.training.config import CronosTrainConfig

MANIFEST = "manifest.json"
METRICS = "metrics.jsonl"
TENSORBOARD = "tensorboard"
STREAMS = "streams"


def last_checkpoint(folder: Path) -> Path | None:
    """The checkpoint that the run in `folder` resumes from; None if there is none."""
    link = folder / CHECKPOINTS_DIR / LAST_CHECKPOINT_LINK
    return link if link.is_dir() else None


def check_links(folder: Path) -> None:
    """Check that what a run writes in its folder stays there: somebody else may have made the folder.

    Raises:
        ValueError: a link leads out of it.
    """
    root = folder.resolve()
    for parent, folders, files in os.walk(folder):
        for path in (Path(parent, name) for name in (*folders, *files)):
            if path.is_symlink() and not path.resolve().is_relative_to(root):
                raise ValueError(f"{path} leads out of the run's folder: replace the link by what it points to.")


def clear_unfinished(folder: Path) -> None:
    """Remove what a run has left in `folder` that was killed before its first checkpoint.

    Raises:
        ValueError: the folder has a manifest of something else.
    """
    if not read_manifest(folder)["starts"]:
        return
    logging.warning(f"The run in {folder} has no checkpoint: it begins anew.")
    for path in (folder / METRICS, folder / TENSORBOARD, *folder.glob(f"{STREAMS}*"), folder / MANIFEST):
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink(missing_ok=True)


def read_manifest(folder: Path) -> dict[str, Any]:
    """The manifest of the run in `folder`; without one there are no `starts`.

    Raises:
        ValueError: it is of something else.
    """
    path = folder / MANIFEST
    if not path.is_file():
        return {"starts": []}
    manifest = json.loads(path.read_text())
    if not (isinstance(manifest, dict) and isinstance(manifest.get("starts"), list)):
        raise ValueError(f"{path} is not of a run of cronos-train.")
    return manifest


def note_start(
    config: CronosTrainConfig, identity: EnvIdentity, num_processes: int = 1, interaction_steps: int = 0
) -> None:
    """Append a start, after `interaction_steps`, to the manifest: a change of machine or version is on record."""
    manifest, weights = read_manifest(Path(config.output_dir or "")), config.weights_path
    instructions = torch.backends.cpu.get_cpu_capability()
    start = {
        "time": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        "interaction_steps": interaction_steps,
        "seed": config.seed,
        "command": [Path(sys.argv[0]).name, *sys.argv[1:]],
        "versions": {"python": platform.python_version()} | package_versions(),
        "git_commit": git_commit(),
        "machine": {
            "platform": platform.platform(),
            "cpu_count": os.cpu_count(),
            # What its floating-point sums are made with, and so their last bits.
            "cpu_capability": instructions,
        },
        "num_processes": num_processes,
        "renderer": os.environ.get("MUJOCO_GL"),
        "policy_device": config.policy.device if config.policy else None,
        # Of a folder: two machines may have made other clones of it.
        "policy_fingerprint": files_fingerprint(Path(weights)) if weights and Path(weights).is_dir() else None,
        "config": config.to_dict(),
    } | describe_environment(identity)
    was = manifest["starts"][-1]["machine"].get("cpu_capability") if manifest["starts"] else None
    if was not in (None, instructions):
        logging.warning(
            f"This run computed with {was} and resumes with {instructions}, whose last bits differ: it becomes "
            "another run, as with another seed. docs/reproduce.md has the variables that hold a command to AVX2."
        )
    _write(config, {"starts": [*manifest["starts"], start]})


def note_end(config: CronosTrainConfig) -> None:
    """Say in the manifest that the run has done all that its config asks for."""
    end = {"steps": config.total_steps, "reset_budget": config.protocol.reset_budget}
    _write(config, read_manifest(Path(config.output_dir or "")) | {"finished": end})


def is_finished(config: CronosTrainConfig) -> bool:
    """Whether the run in the config's folder has done all that the config asks for."""
    end = read_manifest(Path(config.output_dir or "")).get("finished")
    if end is None:
        return False
    return config.total_steps <= end["steps"] and config.protocol.reset_budget == end["reset_budget"]


def describe_environment(identity: EnvIdentity) -> dict[str, Any]:
    """The environment's id with its version, and the source and fingerprint of its starts."""
    return {
        "environment": identity.id,
        "benchmark": {"source": identity.source, "fingerprint": identity.fingerprint},
    }


def _write(config: CronosTrainConfig, manifest: dict[str, Any]) -> None:
    with written_whole(Path(config.output_dir or "") / MANIFEST) as file:
        file.write(json.dumps(manifest, indent=2))
