"""Run the commands of the documentation, page by page, in one new folder.

    python benchmarks/pages.py README.md docs/quickstart.md

Files that the pages ask for are written, and their commands run in their order, shortened: a few steps, episodes
and demonstrations show that the pages hold together. A page that uses the policies of another comes after it.
Commands that need the Hub, a GPU, an installation or something of your own (`<...>`) are printed as skipped.
"""

import argparse
import os
import re
import shlex
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).parents[1]
BLOCK = re.compile(r"(?:`([\w/]+\.py)`[^\n]*:\n\n)?```(bash|python)\n(.*?)```", re.DOTALL)
"""A block of code, and the file that the line before it names."""
OURS = re.compile(r"(PYTHONPATH=\S+ )?(cronos|lerobot)-")
SKIPPED = re.compile(
    r"<|\.\.\.|=cuda|smolvla|openvla|metaworld|-reproduce|=mine |outputs/mine"
    r"|me/(policy|eer|t320|my_|clone|lora|cronos_kitchen)"
)
SHORT = (
    # Command, flag, value that a quick run has.
    ("cronos-demo", "--scale", "smoke"),
    ("cronos-train", "--steps", "20480"),
    ("cronos-train", "--eval.n_episodes", "1"),
    ("lerobot-train", "--steps", "4"),
    ("lerobot-train", "--save_freq", "4"),
    ("lerobot-train", "--batch_size", "8"),
    ("cronos-record-demos", "--dataset.num_episodes", "8"),
    ("cronos-eval", "--eval.n_episodes", "1"),
    ("cronos-eval", "--eval.orderings", "1"),
    ("lerobot-eval", "--eval.n_episodes", "1"),
    ("lerobot-eval", "--eval.batch_size", "1"),
)


def main() -> None:
    """Run the pages; ends with the number of commands that failed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("pages", nargs="+", type=Path)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        for name in ("examples", "benchmarks", "policies", "cronos_lerobot", "datasets_cards"):
            (Path(folder) / name).symlink_to(ROOT / name)
        failed = sum(run_page(page, folder) for page in args.pages)
    sys.exit(f"{failed} commands failed" if failed else 0)


def run_page(page: Path, folder: str) -> int:
    """Run the commands of a page; returns how many failed."""
    failed = 0
    for file, language, code in BLOCK.findall(page.read_text()):
        if language == "python" and file:
            path = Path(folder) / file
            path.parent.mkdir(exist_ok=True)
            path.write_text(code)
        for command in commands(code) if language == "bash" else ():
            failed += not run(shorten(command), folder)
    return failed


def commands(code: str) -> list[str]:
    """The commands of a block."""
    lines = [line.split(" # ")[0].strip() for line in code.replace("\\\n", " ").splitlines()]
    return [line for line in lines if OURS.match(line)]


def shorten(command: str) -> str:
    """The command with a quick run's values."""
    for name, flag, value in SHORT:
        if re.search(rf"(^| ){name}( |$)", command):
            command = re.sub(rf" {re.escape(flag)}=\S+", "", command) + f" {flag}={value}"
    return command


def run(command: str, folder: str) -> bool:
    """Run it, and say how it went."""
    if SKIPPED.search(command):
        print(f"skipped  {command[:110]}")
        return True
    start = time.perf_counter()
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    python_path = os.pathsep.join([folder, str(Path(folder, "examples/lerobot_policy_mine"))])
    env = os.environ | {"PATH": path, "PYTHONPATH": python_path, "HF_HUB_OFFLINE": "1"}
    words = ["bash", "-c", command]
    ended = subprocess.run(words, cwd=folder, env=env, capture_output=True, text=True, check=False)
    state = "failed  " if ended.returncode else "done    "
    print(f"{state} {time.perf_counter() - start:5.0f} s  {shlex.quote(command)[:100]}", flush=True)
    if ended.returncode:
        print("\n".join((ended.stdout + ended.stderr).splitlines()[-8:]))
    return not ended.returncode


if __name__ == "__main__":
    main()
