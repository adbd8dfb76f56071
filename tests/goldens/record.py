"""Goldens: what tiny runs of the public commands give, recorded before a change and compared after it.

    python tests/goldens/record.py record WORKDIR
    python tests/goldens/record.py compare WORKDIR [--sections ppo env ...]

It knows commands (commands.toml), file formats and Gymnasium's interface, and no module of the package, which
may all change. Bits depend on the kind of processor and on PyTorch's release: record anew on another machine
before comparing there. With --sections those are made anew; what they need is taken from WORKDIR if it is there
from an earlier time.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import re
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from importlib.metadata import version
from itertools import zip_longest
from pathlib import Path
from string import Template
from typing import Any

import gymnasium
import lerobot_env_cronos
import numpy as np
import pyarrow.parquet as pq
import torch
from safetensors.numpy import load_file

GOLDENS, COMMANDS = (Path(__file__).with_name(name) for name in ("goldens.json", "commands.toml"))
VOLATILE = {
    "time", "steps_per_s", "time_share", "date", "seconds", "commit", "made_by", "versions", "config", "policy",
    "policy_fingerprint", "policy_files", "policy_revision", "policy_config", "policy_env", "device",
    "seconds_per_step", "video_paths", "predicted_video_paths", "eval_s", "eval_ep_s",
}  # fmt: skip
"""Of metrics and results: clocks, speeds, paths, and which program it was."""
FAILED = "failed"
SCENES = ("kitchen_2x2", "kitchen_3x3", "playroom_2x2")
MODEL = "checkpoints/last/pretrained_model"


def sha(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()[:16]


def clean(value: Any) -> Any:
    """Without what differs from run to run."""
    if isinstance(value, dict):
        return {key: clean(item) for key, item in value.items() if key not in VOLATILE}
    return [clean(item) for item in value] if isinstance(value, list) else value


def read_weights(folder: Path) -> dict[str, Any]:
    """Names and numbers apart, so that it is seen whether only a name changed."""
    files = {}
    for path in sorted(folder.rglob("*.safetensors")):
        names, tensors = zip(*sorted(load_file(path).items()))
        values = sha(b"".join(tensor.tobytes() for tensor in tensors))
        files[path.name] = {"names": sha(" ".join(names).encode()), "values": values, "tensors": len(names)}
    return files


def read_dataset(root: Path) -> dict[str, Any]:
    """Type and hash of each column over all files, and the features."""
    tables = [pq.read_table(path) for path in sorted((root / "data").rglob("*.parquet"))]
    columns = {}
    for name in tables[0].column_names:
        data = sha(json.dumps([row for table in tables for row in table[name].to_pylist()]).encode())
        columns[name] = f"{tables[0].schema.field(name).type} {data}"
    features = json.loads((root / "meta/info.json").read_text())["features"]
    read = {name: f"{f['dtype']} {f['shape']} {sha(str(f['names']).encode())}" for name, f in features.items()}
    return {"rows": sum(map(len, tables)), "columns": columns, "features": read}


def read_interventions(root: Path) -> list[str]:
    """`stream:step:intervention`, those other than none."""
    names = ["cronos.stream_id", "cronos.step", "cronos.event"]
    tables = [pq.read_table(path, columns=names) for path in (root / "data").rglob("*.parquet")]
    rows = [row for table in tables for row in zip(*(table[name].to_pylist() for name in names), strict=True)]
    return [":".join(map(str, row)) for row in sorted(rows) if row[2]]


def play_tape(scene: str) -> dict[str, str]:
    """50 steps of random actions in two environments, through Gymnasium's interface."""
    scene_id, actions = lerobot_env_cronos.gymnasium_id(scene), np.random.default_rng(1)
    env = gymnasium.make_vec(scene_id, num_envs=2, obs_type="environment_state_agent_pos", num_threads=1)
    low, high = env.single_action_space.low, env.single_action_space.high
    observation, _ = env.reset(seed=1)
    tape = {name: [value] for name, value in observation.items()} | {"reward": []}
    for _ in range(50):
        observation, reward, *_ = env.step(actions.uniform(low, high, (2, len(low))).astype(np.float32))
        for name, value in {**observation, "reward": reward}.items():
            tape[name].append(value)
    env.close()
    return {name: f"{values[0].dtype} {sha(np.stack(values).tobytes())}" for name, values in tape.items()}


def read_outputs(folder: Path) -> Any:
    """What is recorded of a command, by the files that it has left."""
    if (metrics := folder / "metrics.jsonl").exists():
        lines = [clean(json.loads(line)) for line in metrics.read_text().splitlines()]
        read = {"metrics": lines, "weights": read_weights(folder / MODEL)}
        if (streams := folder / "streams").exists():
            read |= {"streams": read_dataset(streams), "interventions": read_interventions(streams)}
        return read
    if results := sorted(folder.glob("*/results.json")):
        return {path.parent.name: clean(json.loads(path.read_text())) for path in results}
    if (info := folder / "eval_info.json").exists():
        return clean(json.loads(info.read_text()))
    if (folder / "meta").exists():
        return read_dataset(folder)
    if (folder / MODEL).exists():
        return read_weights(folder / MODEL)
    files = sorted(path for path in folder.rglob("*") if path.is_file() and path.suffix != ".md")
    return {str(path.relative_to(folder)): sha(path.read_bytes()) for path in files}


def read_commands() -> dict[str, str]:
    """By `section/name`; those of [env] are no commands, but scenes."""
    sections, flags = tomllib.loads(COMMANDS.read_text()), dict[str, str]()
    for name, text in sections.pop("flags").items():
        flags[name] = Template(text).safe_substitute(flags)
    commands = {f"env/{scene}": "" for scene in SCENES}
    for section, named in sections.items():
        for name, text in named.items():
            commands[f"{section}/{name}"] = " ".join(Template(text).safe_substitute(flags).split())
    return commands


def run_step(name: str, command: str, work: Path, before: list[Future[Any]], anew: bool) -> Any:
    """What is recorded of the step; a command is run unless its outputs are there and will do."""
    for future in before:
        future.result()
    if not command:
        return play_tape(name.split("/")[1])
    out, log, done = work / name, work / f"{name}.log", work / f"{name}.done"
    if anew or not done.exists():
        done.unlink(missing_ok=True)
        shutil.rmtree(out, ignore_errors=True)
        out.parent.mkdir(parents=True, exist_ok=True)
        with log.open("w") as file:
            line = Template(command).substitute(work=work, out=out)
            if code := subprocess.call(line, shell=True, stdout=file, stderr=file):
                raise RuntimeError(f"{name} ended with {code}, see {log}")
        done.touch()
    print(f"{name} is there", flush=True)
    return read_outputs(out)


def make(work: Path, sections: list[str]) -> dict[str, dict[str, Any]]:
    """Run the sections, two commands at a time; a step waits only for steps that were begun before it."""
    commands, futures = read_commands(), dict[str, Future[Any]]()
    needs = {name: set(re.findall(r"\$work/(\w+/\w+)", command)) for name, command in commands.items()}
    chosen = [name for name in commands if name.split("/")[0] in sections]
    needed = set(chosen)
    for name in reversed(commands):
        if name in needed:
            needed |= needs[name]
    with ThreadPoolExecutor(2) as pool:
        for name in filter(needed.__contains__, commands):
            before = [futures[other] for other in needs[name]]
            futures[name] = pool.submit(run_step, name, commands[name], work, before, name in chosen)
    made: dict[str, dict[str, Any]] = {section: {} for section in sections}
    for name in chosen:
        (section, part), error = name.split("/"), futures[name].exception()
        made[section][part] = f"{FAILED}: {error}" if error else futures[name].result()
    return made


def differences(old: Any, new: Any, path: str = "") -> Iterator[str]:
    """Each place where they differ, with both values."""
    pairs = {type(old), type(new)}
    if pairs == {dict}:
        for key in [*old, *(key for key in new if key not in old)]:
            yield from differences(old.get(key, "nothing"), new.get(key, "nothing"), f"{path}/{key}")
    elif pairs == {list}:
        for i, (a, b) in enumerate(zip_longest(old, new, fillvalue="nothing")):
            yield from differences(a, b, f"{path}/{i}")
    elif len(pairs) > 1 or old != new:
        yield f"{path}: {str(old)[:300]} became {str(new)[:300]}"


def compare(golden: dict[str, Any], made: dict[str, Any]) -> int:
    """Print what held and what changed; the number of things that changed."""
    changed = 0
    for section, parts in made.items():
        before = golden.get(section, {})
        for name in [*before, *(name for name in parts if name not in before)]:
            found = list(differences(before.get(name, "nothing"), parts.get(name, "nothing")))
            changed += bool(found)
            print(f"{section}/{name}: " + (f"CHANGED in {len(found)}, first {found[0]}" if found else "held"))
    return changed


def to_text(value: Any, depth: int = 4) -> str:
    """JSON with a line for each line of metrics, file or column, so that a diff shows what changed."""
    if depth and isinstance(value, dict):
        items = [f"{json.dumps(key)}: {to_text(item, depth - 1)}" for key, item in value.items()]
        return "{\n" + ",\n".join(items) + "\n}"
    if isinstance(value, list) and value and isinstance(value[0], dict):
        return "[\n" + ",\n".join(map(json.dumps, value)) + "\n]"
    return json.dumps(value)


def describe_machine() -> dict[str, str]:
    """What last bits depend on."""
    cpu = [line for line in Path("/proc/cpuinfo").read_text().splitlines() if line.startswith("model name")]
    packages = {name: version(name) for name in ("torch", "numpy", "mujoco", "lerobot", "pyarrow")}
    return {"cpu": cpu[0].split(": ")[1], "instructions": torch.backends.cpu.get_cpu_capability()} | packages


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    sections = list(dict.fromkeys(name.split("/")[0] for name in read_commands()))
    parser.add_argument("action", choices=("record", "compare"))
    parser.add_argument("work", type=Path, metavar="WORKDIR")
    parser.add_argument("--sections", nargs="+", choices=sections, default=sections)
    args = parser.parse_args()
    programs = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    os.environ |= {"OMP_NUM_THREADS": "1", "HF_HUB_OFFLINE": "1", "PATH": programs}
    machine, made = describe_machine(), make(args.work.absolute(), args.sections)
    golden = json.loads(GOLDENS.read_text()) if GOLDENS.exists() else {}
    for change in differences(golden.get("machine", {}), machine, "machine"):
        print(f"another machine than the goldens': {change}")
    if args.action == "compare":
        sys.exit(1 if compare(golden, made) else 0)
    if failed := [part for parts in made.values() for part in parts.values() if str(part).startswith(FAILED)]:
        sys.exit("\n".join(failed))
    if {"resume", "ppo"} <= set(made) and made["resume"]["resumed"] != made["ppo"]["tokens"]:
        print("the resumed run is NOT the unbroken one")
    GOLDENS.write_text(to_text({**golden, "machine": machine, **made}) + "\n")


if __name__ == "__main__":
    main()
