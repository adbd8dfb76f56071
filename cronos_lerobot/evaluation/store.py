"""The output folder of an evaluation: finished parts, written at once or not at all."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
from lerobot_env_cronos import check_environment_id

from cronos_lerobot.evaluation.chains import ChainResult, Trajectory
from cronos_lerobot.locks import INSIDE
from cronos_lerobot.whole_files import partial_name, written_whole

IDENTITY = "evaluation.json"
RESULTS = "results.json"
COMPARISON = "comparison.json"
"""In place of it, of an evaluation that ends as soon as two policies are told apart."""
FORMAT = 2
"""Version of results.json; 1 was of version 0 of the environments."""

OURS = (INSIDE, partial_name(IDENTITY))
"""What may lie in a folder that is no evaluation's yet: its lock, and a first file that was cut off."""
ANEW = "evaluate anew with another --output_dir"


class ResultStore:
    """Parts of one evaluation in a folder.

    Args:
        folder: made if it is not there.
        identity: everything that decides a chain's result, as JSON values; a folder is of one identity.

    Raises:
        FileExistsError: the folder holds something else.
        ValueError: the folder is of another evaluation, or of another version of the environments.
    """

    def __init__(self, folder: Path, identity: dict[str, Any]) -> None:
        self.folder = folder
        path = folder / IDENTITY
        if path.is_file():
            there = json.loads(path.read_text())
            check_environment_id(there.get("environment"), f"the evaluation in {folder}", ANEW)
            self._compare(there, identity)
        elif folder.exists() and (not folder.is_dir() or any(f.name not in OURS for f in folder.iterdir())):
            raise FileExistsError(f"{folder} is not empty and not of an evaluation; choose another --output_dir")
        else:
            write_json(path, identity)

    def _compare(self, there: dict[str, Any], here: dict[str, Any]) -> None:
        here = json.loads(json.dumps(here))
        names = [name for name in sorted(there | here) if there.get(name) != here.get(name)]
        if names:
            changes = "; ".join(f"{name}: {there.get(name)} there, {here.get(name)} now" for name in names)
            raise ValueError(f"{self.folder} holds another evaluation ({changes}); choose another --output_dir")

    def forget_if_empty(self) -> None:
        """Free a folder that has no part for another evaluation."""
        if not self.names():
            (self.folder / IDENTITY).unlink(missing_ok=True)

    def read(self, name: str) -> dict[str, Any] | None:
        """Return a finished part, or None."""
        path = self._path(name)
        return json.loads(path.read_text()) if path.is_file() else None

    def write(self, name: str, content: dict[str, Any], trajectories: dict[str, Trajectory]) -> None:
        """Keep a part: its content, and the trajectories from which videos may be drawn, by any name."""
        arrays = {}
        for key, t in trajectories.items():
            arrays |= {f"{key}.qpos": t.qpos, f"{key}.position": t.position, f"{key}.is_complete": t.is_complete}
        with written_whole(self._path(name).with_suffix(".npz"), "wb") as file:
            np.savez_compressed(file, **arrays)
        # Written last: a part is finished when it is there.
        write_json(self._path(name), content)

    def names(self) -> list[str]:
        """The finished parts."""
        return sorted(path.stem for path in self._path("").parent.glob("*.json"))

    def has_trajectories(self, name: str) -> bool:
        """Whether a part was written with trajectories, and they can be read."""
        try:
            with np.load(self._path(name).with_suffix(".npz")) as arrays:
                return bool(arrays.files)
        except (OSError, ValueError, EOFError, BadZipFile):
            return False

    def read_trajectory(self, name: str, key: str) -> Trajectory | None:
        """Return a trajectory that `write` kept, or None."""
        with np.load(self._path(name).with_suffix(".npz")) as arrays:
            if f"{key}.qpos" not in arrays:
                return None
            return Trajectory(arrays[f"{key}.qpos"], arrays[f"{key}.position"], arrays[f"{key}.is_complete"])

    def _path(self, name: str) -> Path:
        return self.folder / "parts" / f"{name}.json"


def read_results(path: Path) -> dict[str, Any]:
    """Read results.json of cronos-eval, given itself or its folder.

    Raises:
        FileNotFoundError: it is not there.
        ValueError: it is of something else, or of another version of the environments.
    """
    file = path / RESULTS if path.is_dir() else path
    if not file.is_file():
        raise FileNotFoundError(f"no {RESULTS} of cronos-eval at {path}")
    try:
        results = json.loads(file.read_text())
    except ValueError as error:
        raise ValueError(f"{file} is damaged: {error}") from error
    if not isinstance(results, dict) or "format" not in results:
        raise ValueError(f"{file} is no {RESULTS} of cronos-eval")
    check_environment_id((results.get("benchmark") or {}).get("environment"), str(file), ANEW)
    if results["format"] != FORMAT:
        raise ValueError(f"{file} is in format {results['format']!r}; this version reads {FORMAT}")
    return results


def chain_key(record: dict[str, Any]) -> str:
    """A chain's name within its suite and split."""
    return f"{record['number']}_{record['configuration']}"


def chain_records(results: Sequence[ChainResult]) -> list[dict[str, Any]]:
    """Outcomes as JSON values.

    `number` (ordering or task), `configuration`, `length`, `steps`, and the positions of the completed tasks that
    were `found_complete` or whose object was `never_grasped`; see `ChainResult`.
    """
    return [
        {
            "number": r.chain.number,
            "configuration": r.chain.configuration,
            "length": r.length,
            "steps": r.steps,
            "found_complete": list(r.found_complete),
            "never_grasped": list(r.never_grasped),
        }
        for r in results
    ]


def write_json(path: Path, content: Any) -> None:
    """Write a file at once or not at all."""
    with written_whole(path) as file:
        file.write(json.dumps(content, indent=2) + "\n")
