"""Reads the folders of `cronos-eval`: both evaluation suites."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from cronos_lerobot.evaluation.outcomes import observed_in
from cronos_lerobot.evaluation.store import IDENTITY as IDENTITY_FILE
from cronos_lerobot.evaluation.store import read_results

SUITES = ("independent", "sequential")
DECISIVE = (
    "policy", "policy_fingerprint", "scene", "obs_type", "temperature", "seed", "advance", "end_effector_reset",
)  # fmt: skip
"""Fields of results.json in which two evaluations of one policy must agree to be shown as one."""
IDENTITY = {"benchmark": "the package's", "n_episodes": None, "orderings": None, "renderer": "classic"}
"""Fields of its `identity` in which they must agree too, with what it means that one is missing."""


@dataclass
class SuiteRun:
    """What `cronos-eval` found of one policy."""

    name: str
    """The policy in short."""
    results: dict[str, dict[str, Any]]
    """By suite, then by split."""
    videos: list[tuple[Path, dict[str, Any]]]
    """Files, and what they show."""
    settings: dict[str, Any] = field(default_factory=dict)
    """How it was evaluated."""

    def splits(self, suite: str) -> dict[str, dict[str, Any]]:
        """Results of a suite by split, empty if it was not run."""
        return self.results.get(suite, {})


def is_results(path: Path) -> bool:
    """Whether a file called results.json is one of `cronos-eval`, if only a damaged one."""
    try:
        content = json.loads(path.read_text())
    except ValueError:
        return (path.parent / IDENTITY_FILE).is_file()
    return isinstance(content, dict) and "format" in content and any(suite in content for suite in SUITES)


def check_results(path: Path) -> None:
    """Read a results.json once.

    Raises:
        ValueError: it is damaged, or of another version.
    """
    read_results(path)


def read_suite_runs(files: Iterable[Path]) -> list[SuiteRun]:
    """Read results.json files, each once; the evaluations of one policy in several folders are put together."""
    merged: dict[str, SuiteRun] = {}
    for folder in dict.fromkeys(path.resolve().parent for path in files):
        results = read_results(folder)
        settings = _settings(results)
        key = json.dumps(settings)
        run = merged.setdefault(key, SuiteRun(policy_name(results["policy"]), {}, []))
        for suite in SUITES:
            run.results.setdefault(suite, {}).update(results.get(suite, {}))
        run.videos.extend((folder / video["path"], video) for video in results.get("videos") or [])
        run.settings.update(settings)
    runs = list(merged.values())
    names = [run.name for run in runs]
    told = [f" ({_what_differs(run, runs)})" if names.count(run.name) > 1 else "" for run in runs]
    for run, what in zip(runs, told, strict=True):
        run.name += what
    return runs


def _settings(results: dict[str, Any]) -> dict[str, Any]:
    identity = results.get("identity", {})
    own = {name: identity.get(name, default) for name, default in IDENTITY.items()}
    own["repetitions"] = results.get("repetitions", 1)
    own |= observed_in(results)
    return {name: results.get(name) for name in DECISIVE} | own


def policy_name(policy: str) -> str:
    """A policy in short: run and step of a checkpoint, such as `eer 0102400`; a Hub id or a name as it is."""
    parts = Path(policy).parts
    if "checkpoints" not in parts[:-1]:
        return "/".join(parts[-2:])
    place = len(parts) - 1 - parts[::-1].index("checkpoints")
    run = parts[:place]
    name = "/".join(run[-3:-1]) if run and run[-1] == "train" else "/".join(run[-1:])
    return f"{name} {parts[place + 1]}"


def _what_differs(run: SuiteRun, runs: list[SuiteRun]) -> str:
    same = [
        other for other in runs if other.settings["policy"] == run.settings["policy"] or other.name == run.name
    ]
    names = [name for name in run.settings if len({str(other.settings[name]) for other in same}) > 1]
    return ", ".join(f"{name}={run.settings[name]}" for name in names)
