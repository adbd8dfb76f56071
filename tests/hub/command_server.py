"""Runs console commands in processes of their own, without starting Python and importing LeRobot for each.

This process imports everything once, then forks for every line that it reads: {"command", "arguments",
"environment", "impatient"}; it answers {"code", "output"}. What huggingface_hub reads on import, HF_ENDPOINT and
HF_HOME, is what this process was started with.
"""

from __future__ import annotations

import importlib
import json
import os
import sys
import tempfile
import time
import traceback
from pathlib import Path
from typing import Any

from draccus.argparsing import ArgumentParser
from lerobot.utils.import_utils import register_third_party_plugins

MAINS = {
    "cronos-publish": "cronos_lerobot.scripts.publish",
    "cronos-train": "cronos_lerobot.scripts.train",
    "cronos-eval": "cronos_lerobot.scripts.eval",
    "cronos-streams": "cronos_lerobot.scripts.streams",
    "lerobot-eval": "lerobot.scripts.lerobot_eval",
}
PRELOADED = (
    "faster", *MAINS.values(), "cronos_lerobot.hub.benchmark", "cronos_lerobot.hub.policy",
    "cronos_lerobot.hub.streams", "cronos_lerobot.hub.results", "lerobot_policy_pocketvla", "datasets",
)  # fmt: skip


def run(request: dict[str, Any]) -> None:
    """Run a command, or Python code, in this process."""
    os.environ.update(request["environment"])
    if request["impatient"]:
        # Retries of huggingface_hub wait for seconds.
        sleep = time.sleep
        time.sleep = lambda seconds: sleep(seconds / 100)
    command, arguments = request["command"], request["arguments"]
    sys.argv = [command, *arguments]
    if command == "python":
        exec(arguments[0], {"__name__": "__main__"})
    else:
        importlib.import_module(MAINS[command]).main()


def run_child(request: dict[str, Any], output: int) -> None:
    """Run in a forked child that writes to the file `output`, and end it."""
    os.dup2(output, 1)
    os.dup2(output, 2)
    code = 0
    try:
        run(request)
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else int(end.code is not None)
        if isinstance(end.code, str):
            print(end.code, file=sys.stderr)
    except BaseException:
        traceback.print_exc()
        code = 1
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)


def main() -> None:
    """Serve until the input ends."""
    sys.path.append(str(Path(__file__).parents[1]))
    for module in PRELOADED:
        importlib.import_module(module)
    register_third_party_plugins()
    # What it has read of the configs, no child reads again.
    ArgumentParser(config_class=importlib.import_module("cronos_lerobot.training.config").CronosTrainConfig)
    print("ready", flush=True)
    for line in sys.stdin:
        request = json.loads(line)
        with tempfile.NamedTemporaryFile() as output:
            child = os.fork()
            if not child:
                run_child(request, output.fileno())
            _, status = os.waitpid(child, 0)
            answer = {"code": os.waitstatus_to_exitcode(status), "output": Path(output.name).read_text()}
        print(json.dumps(answer), flush=True)


if __name__ == "__main__":
    main()
