"""Commands that make a folder each, and the notes that tell which are done."""

from __future__ import annotations

import fcntl
import hashlib
import importlib.util
import json
import os
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from cronos_lerobot.provenance import git_commit, package_versions
from cronos_lerobot.whole_files import written_whole

RUNNING, STOPPED = "running", "stopped"
BASE, RUN, EVALUATION = "base", "run", "evaluation"
PLUGIN_FLAG = "discover_packages_path"
"""Of LeRobot's commands: imports a module that registers policies or environments."""
PLUGIN = "the module "
"""In a note, before the name of a module that the command imports."""
POLICY = "the policy "
"""In a note, before a policy of one's own that the command begins with."""


@dataclass(frozen=True)
class Progress:
    """How far a job has come."""

    done: int
    total: int
    """In the job's own unit, such as interaction steps."""
    seconds_left: float | None
    text: str = ""
    """Anything else worth showing, such as the success so far."""


@dataclass(frozen=True)
class Job:
    """One command. Beside its `output` lie `<output>.job.json`, `<output>.log` and a lock.

    Jobs may be shared between experiments: the same output is made by the same command or not at all.
    """

    name: str
    command: tuple[str, ...]
    """A console script of this environment, or `python`, and its flags."""
    output: Path
    """The folder that the command makes; removed before the command starts anew."""
    made_from_it: tuple[Path, ...] = ()
    """What other jobs have made of the output, which is removed with it."""
    needs: tuple[str, ...] = ()
    """Names of the jobs whose outputs it uses."""
    reads: tuple[Path, ...] = ()
    """What of those outputs it reads: they may have come from another machine without their checkpoints."""
    resume: Callable[[], list[str] | None] = lambda: None
    """The command that goes on with an unfinished `output`, None if there is nothing to go on with."""
    progress: Callable[[], Progress | None] = lambda: None
    environment: str = ""
    """Id of the environment that the command works in, with its version."""
    stage: str = RUN
    """BASE, RUN or EVALUATION: of each a cluster has an array."""
    work: int = 0
    """Interaction steps, for the time that all jobs together may still take."""
    root: Path | None = None
    """The folder that `output` and the paths of the command lie below; what is below it may be moved elsewhere."""

    @property
    def log(self) -> Path:
        """What the command printed, over all its starts."""
        return self.output.with_name(f"{self.output.name}.log")

    @property
    def record(self) -> Path:
        """The note of what was run."""
        return self.output.with_name(f"{self.output.name}.job.json")

    def remove_output(self) -> None:
        """Make room for a new start."""
        for folder in (self.output, *self.made_from_it):
            if folder.is_dir():
                shutil.rmtree(folder)
        self.log.unlink(missing_ok=True)


def read_record(job: Job) -> dict[str, Any]:
    """Return what `write_record` wrote; {} before the job's start, and where the note is damaged.

    `command`, `status` (running, done, failed, stopped), `seconds`, `starts`, `made_by` (see there) and
    `commits`, those that it was started at.
    """
    return {} if _damage(job) else json.loads(job.record.read_text()) if job.record.is_file() else {}


def _damage(job: Job) -> str | None:
    """What is wrong with the note, None if nothing is or there is none."""
    if not job.record.is_file():
        return None
    try:
        record = json.loads(job.record.read_text())
    except ValueError as error:
        return f"{job.record} is damaged ({error})"
    complete = isinstance(record, dict) and {"command", "status", "seconds", "starts"} <= record.keys()
    return None if complete else f"{job.record} is damaged (it is no note of a job)"


def write_record(job: Job, record: dict[str, Any]) -> None:
    """Replace the note in one step, on disk once this returns: a kill or a power cut leaves the old or the new."""
    with written_whole(job.record) as file:
        file.write(json.dumps(record, indent=2))


@cache
def this_version() -> dict[str, str]:
    """The versions of the packages that make what is started now."""
    return package_versions()


@cache
def this_commit() -> str | None:
    """The commit of the checkout that this process runs from."""
    return git_commit()


def status(job: Job) -> str | None:
    """What became of a job: running, done, failed or stopped; None before its start.

    Where its runner was killed, the note says `running` for ever: with nobody who holds the claim it was stopped.
    """
    found = read_record(job).get("status")
    if found != RUNNING:
        return found
    try:
        claim = lock(job)
    except OSError:  # of a root that may only be read
        return found
    if claim is None:
        return RUNNING
    os.close(claim)
    return STOPPED


def is_done(job: Job) -> bool:
    """Whether this very command has run to its end, in this version, and its output is still there."""
    return read_record(job).get("status") == "done" and not changes(job) and job.output.exists()


def continuation(job: Job) -> list[str] | None:
    """The command that goes on with the output; None where it begins anew, and what was made of it goes."""
    return job.resume() if job.output.exists() and read_record(job) else None


def missing(job: Job) -> list[Path]:
    """What a job whose needs are done reads and does not find, such as a checkpoint that was not carried along."""
    return [path for path in job.reads if not path.exists()]


def changes(job: Job) -> list[str]:
    """Why `output` is not the job's, or may not be: `known_changes`, or it has no note; empty if it is.

    A note is written before its command starts: what lies there without one came from elsewhere.
    """
    # In this order: another process may start the job meanwhile.
    if _is_filled(job.output) and not job.record.is_file():
        why = f"{job.output} has no note, so nobody knows what made it"
        return [f"{why}: copy {job.record.name} from where it was made"]
    return known_changes(job)


def known_changes(job: Job) -> list[str]:
    """How a note tells that `output` is not the job's: `changed_flags`, `changed_versions`, or it is damaged."""
    if not job.output.exists():
        return []
    if damage := _damage(job):
        return [damage]
    return changed_flags(job) + changed_versions(job)


def _is_filled(output: Path) -> bool:
    """Whether there is anything in a folder; a command may find its own made."""
    return any(output.iterdir()) if output.is_dir() else output.exists()


def changed_flags(job: Job) -> list[str]:
    """How the command that made `output` differs from the job's, such as `--lr=1 there, --lr=2 here`.

    Empty if it does not. Paths below the root are compared as seen from there: runs may have been made below
    another root, or on another machine.
    """
    record = read_record(job)
    return differing_flags(job, record["command"]) if record and job.output.exists() else []


def differing_flags(job: Job, noted: list[str]) -> list[str]:
    """How a noted command differs from the job's; see `changed_flags`."""
    new = list(job.command)
    old = _in_root_of(job, noted)
    if old == new:
        return []
    only_old, only_new = [flag for flag in old if flag not in new], [flag for flag in new if flag not in old]
    names = dict.fromkeys(_name(flag) for flag in (*only_old, *only_new))
    differing = [f"{_named(name, only_old)} there, {_named(name, only_new)} here" for name in names]
    return differing or ["another order of the flags"]


def _in_root_of(job: Job, noted: list[str]) -> list[str]:
    """A noted command with the paths below the root that it was given in that of the job.

    That root is told by the flag that names the job's output.
    """
    flag = next((flag for flag in job.command if flag.partition("=")[2] == str(job.output)), None)
    if job.root is None or flag is None:
        return noted
    outputs = [Path(old.partition("=")[2]) for old in noted if _name(old) == _name(flag)]
    below = job.output.relative_to(job.root).parts
    if len(outputs) != 1 or outputs[0].parts[-len(below) :] != below:
        return noted
    root = Path(*outputs[0].parts[: -len(below)])
    moved = [_moved(old, root, job.root) for old in noted]
    # Below a root that is the working directory lies every text, paths or not.
    return [new if new in job.command else old for old, new in zip(noted, moved, strict=True)]


def _moved(flag: str, old_root: Path, new_root: Path) -> str:
    """A flag whose value is a path below one root with the same path below another; any other as it is."""
    name, _, value = flag.partition("=")
    path = Path(value)
    return f"{name}={new_root / path.relative_to(old_root)}" if value and path.is_relative_to(old_root) else flag


def _name(flag: str) -> str:
    return flag.partition("=")[0]


def _named(name: str, flags: list[str]) -> str:
    return " ".join(flag for flag in flags if _name(flag) == name) or "none"


def changed_versions(job: Job) -> list[str]:
    """How what made `output` differs from what would make it now, such as `mujoco 3.2 there, 3.3 here`."""
    record = read_record(job)
    if not record or not job.output.exists():
        return []
    if "made_by" not in record:
        return ["its note does not say which versions made it, as those of version 0"]
    old, new = record["made_by"], made_by(job)
    # A report needs neither, and notes have not always named them.
    known = [
        name for name in (*old, *new) if not name.startswith((PLUGIN, POLICY)) or (name in old and name in new)
    ]
    return [
        f"{name} {old.get(name, 'none')} there, {new.get(name, 'none')} here"
        for name in dict.fromkeys(known)
        if old.get(name) != new.get(name)
    ]


def made_by(job: Job) -> dict[str, str]:
    """What decides a job's output besides its command.

    Versions of packages, the id of the environment, and hashes of what has no version: the modules that its flags
    import, as a reset strategy of a user's, and a policy in a folder that is no other job's output.
    """
    hashes = {}
    for flag in job.command:
        name, _, value = flag.partition("=")
        if name.endswith(PLUGIN_FLAG) and (found := _source_hash(value)):
            hashes[f"{PLUGIN}{value}"] = found
        elif name == "--policy.path" and Path(value).is_dir() and not job.needs:
            stamp = tuple(sorted((file.name, file.stat().st_mtime_ns) for file in Path(value).iterdir()))
            hashes[f"{POLICY}{value}"] = _policy_hash(value, stamp)
    return this_version() | {"environment": job.environment} | dict(sorted(hashes.items()))


@cache
def _policy_hash(folder: str, _stamp: tuple[tuple[str, int], ...]) -> str:
    """A short hash of a checkpoint, computed once while its files stay as they are."""
    # With PyTorch, which commands that only explain do without.
    from cronos_lerobot.evaluation.policy_source import files_fingerprint

    return files_fingerprint(Path(folder))


def _source_hash(module: str) -> str | None:
    """A short hash of a module's Python files; None where it cannot be found."""
    try:
        spec = importlib.util.find_spec(module)
    except (ImportError, ValueError):
        return None
    if spec is None or spec.origin is None:
        return None
    origin = Path(spec.origin)
    digest = hashlib.sha256()
    for file in sorted(origin.parent.rglob("*.py")) if spec.submodule_search_locations else [origin]:
        digest.update(file.name.encode() + file.read_bytes())
    return digest.hexdigest()[:16]


def other_commits(job: Job) -> list[str]:
    """The commits that a job was started at, without this process's own."""
    return [commit for commit in read_record(job).get("commits", []) if commit != this_commit()]


def lock(job: Job) -> int | None:
    """Claim a job; None if another process has it.

    The claim is a file descriptor. A command that inherits it keeps the claim while it lives, so that a job whose
    runner was killed is not started twice. Close it to give the job back. Its file is not that of the command's
    own FolderLock, which would find the folder taken.
    """
    job.record.parent.mkdir(parents=True, exist_ok=True)
    path = job.record.with_name(f".{job.output.name}.job.lock")
    try:
        # The umask says whether a group may, as of the other files.
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
    except PermissionError:
        if not path.exists():
            raise
        # Of another user: to lock it, on a disk of this machine, takes no more than to read it.
        descriptor = os.open(path, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(descriptor)
        return None
    return descriptor
