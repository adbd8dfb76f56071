"""Commands in processes of their own, without starting Python and importing LeRobot for each.

A server imports LeRobot, and nothing of this project, and forks for every command: the child is what a new Python
is after `import lerobot...`. Each process of pytest has one, from when it first needs it to its own end.
"""

from __future__ import annotations

import atexit
import importlib
import json
import os
import runpy
import subprocess
import sys
import tempfile
import time
import types
import warnings
from collections.abc import Mapping, Sequence
from functools import cache
from importlib.metadata import entry_points
from pathlib import Path
from typing import IO, Any

import faster  # noqa: F401
from draccus.argparsing import ArgumentParser
from lerobot.configs.train import TrainPipelineConfig

PRELOADED = (
    "lerobot.scripts.lerobot_train", "lerobot.scripts.lerobot_eval", "lerobot.rl.algorithms.configs",
    "lerobot.policies.act.modeling_act", "lerobot.policies.diffusion.modeling_diffusion",
    "lerobot.policies.smolvla.modeling_smolvla", "lerobot.policies.pi0.modeling_pi0",
    "lerobot.policies.pi05.modeling_pi05", "datasets", "peft", "pandas", "matplotlib.pyplot", "rich.console",
    "torch.utils.tensorboard",
)  # fmt: skip
OURS = ("cronos_lerobot", "lerobot_env_", "lerobot_robot_", "lerobot_policy_")


def run_forked(
    command: Sequence[Any], *, env: Mapping[str, str] | None = None, check: bool = False
) -> subprocess.CompletedProcess[str]:
    """As `subprocess.run(command, env=env, check=check, capture_output=True, text=True)`.

    Args:
        command: `sys.executable` with `-c` or `-m`, or a console script of this environment, by path or by name.
        env: its environment variables; those that are read when huggingface_hub is imported have no effect.
        check: raise a CalledProcessError if it fails.
    """
    words = [str(word) for word in command]
    environment = dict(os.environ if env is None else env)
    answer = _ask({"command": words, "environment": environment, "folder": os.getcwd()})
    done = subprocess.CompletedProcess(words, answer["code"], answer["stdout"], answer["stderr"])
    if check:
        done.check_returncode()
    return done


class ForkedPopen:
    """As `subprocess.Popen(command, stdout=log, stderr=STDOUT, env=env, start_new_session=True)`.

    The child inherits no file of this process but its log's: `pass_fds` has no effect.
    """

    def __init__(self, command: Sequence[Any], *, stdout: IO[bytes], env: Mapping[str, str], **_: Any) -> None:
        request = {"command": [str(word) for word in command], "environment": dict(env), "folder": os.getcwd()}
        self.pid = _ask(request | {"log": stdout.name})["pid"]
        self.returncode: int | None = None

    def poll(self) -> int | None:
        """The exit code, None while it runs."""
        if self.returncode is None:
            self.returncode = _ask({"poll": self.pid})["code"]
        return self.returncode

    def wait(self) -> int:
        """The exit code, once there is one."""
        while (code := self.poll()) is None:
            time.sleep(0.05)
        return code


def _ask(request: Mapping[str, Any]) -> dict[str, Any]:
    server = _server()
    assert server.stdin is not None
    assert server.stdout is not None
    server.stdin.write(json.dumps(request) + "\n")
    server.stdin.flush()
    return json.loads(server.stdout.readline())


@cache
def _server() -> subprocess.Popen[str]:
    environment = os.environ | {"OMP_NUM_THREADS": "1", "HF_HUB_OFFLINE": "1"}
    server = subprocess.Popen(
        [sys.executable, __file__], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment
    )
    assert server.stdout is not None
    assert server.stdout.readline() == "ready\n"
    atexit.register(server.communicate)
    return server


def _execute(command: list[str]) -> None:
    """What Python does with a command line."""
    program, *arguments = command
    if not Path(program).name.startswith("python"):
        (script,) = entry_points(group="console_scripts", name=Path(program).name)
        sys.argv = command
        sys.exit(script.load()())
    flag, what, *arguments = arguments
    sys.path.insert(0, "" if flag == "-c" else os.getcwd())
    sys.argv = [flag if flag == "-c" else what, *arguments]
    if flag == "-m":
        runpy.run_module(what, run_name="__main__", alter_sys=True)
        return
    module = sys.modules["__main__"] = types.ModuleType("__main__")
    exec(compile(what, "<string>", "exec"), vars(module))


def _run_child(request: dict[str, Any], outputs: Sequence[int]) -> None:
    """Run a command in this forked process, and end it."""
    for number, output in zip((0, 1, 2), (os.open(os.devnull, os.O_RDONLY), *outputs), strict=True):
        os.dup2(output, number)
    os.environ.clear()
    os.environ.update(request["environment"])
    os.chdir(request["folder"])
    # In place of this file's folder.
    paths = os.environ.get("PYTHONPATH", "").split(os.pathsep)
    sys.path[:1] = [path for path in paths if path and path not in sys.path[1:]]
    code: Any = 0
    try:
        _execute(request["command"])
    except SystemExit as end:
        code = end.code
        if isinstance(code, str):
            print(code, file=sys.stderr)
            code = 1
    except BaseException:
        sys.excepthook(*sys.exc_info())  # ty: ignore[invalid-argument-type]
        code = 1
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(int(code or 0))


def _serve() -> None:
    for module in PRELOADED:
        importlib.import_module(module)
    # What it has read of LeRobot's configs, no child reads again.
    ArgumentParser(config_class=TrainPipelineConfig)
    assert not [name for name in sys.modules if name.startswith(OURS)]
    # The thread is PyArrow's allocator's, which is made for forks.
    warnings.filterwarnings("ignore", ".*multi-threaded, use of fork", DeprecationWarning)
    print("ready", flush=True)
    for line in sys.stdin:
        request = json.loads(line)
        if "poll" in request:
            pid, status = os.waitpid(request["poll"], os.WNOHANG)
            print(json.dumps({"code": os.waitstatus_to_exitcode(status) if pid else None}), flush=True)
            continue
        if "log" in request:
            child = os.fork()
            if not child:
                os.setsid()
                log = os.open(request["log"], os.O_WRONLY | os.O_APPEND)
                _run_child(request, (log, log))
            print(json.dumps({"pid": child}), flush=True)
            continue
        with tempfile.NamedTemporaryFile() as stdout, tempfile.NamedTemporaryFile() as stderr:
            child = os.fork()
            if not child:
                _run_child(request, (stdout.fileno(), stderr.fileno()))
            _, status = os.waitpid(child, 0)
            outputs = {"stdout": Path(stdout.name).read_text(), "stderr": Path(stderr.name).read_text()}
        print(json.dumps({"code": os.waitstatus_to_exitcode(status)} | outputs), flush=True)


if __name__ == "__main__":
    _serve()
