"""A Hub on this machine, and commands that talk to it."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from hub_repositories import Faults, Hub
from hub_stand_in import serve

HERE = Path(__file__).parent
EXAMPLES = HERE.parents[1] / "examples"


@dataclass(frozen=True)
class Outcome:
    """How a command ended."""

    code: int
    output: str


class Commands:
    """Runs commands against a Hub, each in a process of its own.

    Args:
        hub: the Hub.
        home: HF_HOME of the commands: caches of huggingface_hub, datasets and LeRobot.
    """

    def __init__(self, hub: Hub, home: Path) -> None:
        self.home = home
        off = ("XET", "TELEMETRY", "UPDATE_CHECK", "PROGRESS_BARS")
        environment = os.environ | {f"HF_HUB_DISABLE_{name}": "1" for name in off}
        environment |= {"HF_ENDPOINT": hub.url, "HF_TOKEN": "any", "HF_HOME": str(home), "OMP_NUM_THREADS": "1"}
        environment |= {"PYTHONPATH": str(EXAMPLES)}
        for name in ("HF_HUB_CACHE", "HF_LEROBOT_HOME", "HF_DATASETS_CACHE"):
            environment.pop(name, None)
        self._server = subprocess.Popen(
            [sys.executable, HERE / "command_server.py"],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment,
        )  # fmt: skip
        assert self._server.stdout is not None
        assert self._server.stdout.readline() == "ready\n"

    def try_(self, command: str, *arguments: Any, impatient: bool = False, **environment: str) -> Outcome:
        """Run a command and say how it ended."""
        assert self._server.stdin is not None
        assert self._server.stdout is not None
        request = {
            "command": command, "arguments": [str(argument) for argument in arguments],
            "environment": environment, "impatient": impatient,
        }  # fmt: skip
        self._server.stdin.write(json.dumps(request) + "\n")
        self._server.stdin.flush()
        return Outcome(**json.loads(self._server.stdout.readline()))

    def run(self, command: str, *arguments: Any, **options: Any) -> str:
        """Run a command that has to succeed; returns its output."""
        outcome = self.try_(command, *arguments, **options)
        assert outcome.code == 0, outcome.output
        return outcome.output

    def forget(self) -> None:
        """Empty all caches: what is loaded next comes from the Hub, as on another machine."""
        shutil.rmtree(self.home, ignore_errors=True)

    def close(self) -> None:
        """End the server."""
        assert self._server.stdin is not None
        self._server.stdin.close()
        self._server.wait()


@pytest.fixture(scope="session")
def served() -> Iterator[Hub]:
    """A Hub for all tests, each file with repositories of its own."""
    hub, server = serve()
    yield hub
    server.shutdown()


@pytest.fixture
def hub(served: Hub) -> Iterator[Hub]:
    """The Hub, in which nothing goes wrong at first."""
    served.faults = Faults()
    yield served
    served.faults = Faults()


@pytest.fixture
def here(hub: Hub, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Hub:
    """The Hub, for what runs in this process, with a cache that is empty."""
    # What huggingface_hub has read of the environment when it was imported.
    constants = {
        "ENDPOINT": hub.url,
        "HUGGINGFACE_CO_URL_TEMPLATE": f"{hub.url}/{{repo_id}}/resolve/{{revision}}/{{filename}}",
        "HF_HUB_CACHE": str(tmp_path / "cache"),
    }
    for name, value in constants.items():
        monkeypatch.setattr(f"huggingface_hub.constants.{name}", value)
    monkeypatch.setenv("HF_TOKEN", "any")
    return hub


@pytest.fixture(scope="session")
def commands(served: Hub, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Commands]:
    """Commands against the Hub."""
    running = Commands(served, tmp_path_factory.mktemp("home") / "huggingface")
    yield running
    running.close()
