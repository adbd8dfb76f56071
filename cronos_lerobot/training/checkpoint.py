"""Checkpoints in LeRobot's layout that continue a run bit for bit.

checkpoints/
  0102400/
    pretrained_model/   config.json, model.safetensors, processors, train_config.json: what LeRobot loads
    training_state/     optimizer, RNGs, loop.json, env_state.npz, observers.pt, training_step.json, run.json;
                        agent.pt: what the agent keeps of its own; strategies.pt: task order and resets
  last -> 0102400

Of a run on many processes it holds the streams and random numbers of all of them, written by the first one.
"""

from __future__ import annotations

import json
import logging
import os
import shutil
import tempfile
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from pickle import UnpicklingError
from typing import Any
from zipfile import BadZipFile

import numpy as np
import torch
from lerobot.common.train_utils import get_step_identifier, load_training_num_processes, save_training_step
from lerobot.optim import load_optimizer_state, load_optimizer_state_dict, save_optimizer_state
from lerobot.utils.constants import (
    CHECKPOINTS_DIR,
    LAST_CHECKPOINT_LINK,
    OPTIMIZER_STATE,
    PRETRAINED_MODEL_DIR,
    TRAINING_STATE_DIR,
)
from lerobot.utils.random_utils import (
    deserialize_rng_state,
    load_rng_state,
    save_rng_state,
    serialize_rng_state,
    set_seed,
)
from lerobot.utils.utils import flatten_dict, unflatten_dict
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch.optim import Optimizer

from cronos_lerobot.agents.base import LearningAgent
from cronos_lerobot.agents.state import agent_state, as_it_was, to_arrays, to_tensors
from cronos_lerobot.agents.weights import load_weights, weights_file
from cronos_lerobot.processes import Processes
from cronos_lerobot.protocol.loop_state import LoopState
from cronos_lerobot.protocol.own_state import load_own_states, own_states
from cronos_lerobot.training.config import CronosTrainConfig
from cronos_lerobot.training.resume import RUN, check_resumed, describe_run
from cronos_lerobot.training.seeding import NamedGenerators
from cronos_lerobot.whole_files import written_whole

DAMAGE = (ValueError, RuntimeError, KeyError, EOFError, BadZipFile, UnpicklingError, SafetensorError)
"""What the readers of the files raise for a truncated one."""

AGENT = "agent.pt"
ENV_STATE = "env_state.npz"
LOOP = "loop.json"
OBSERVERS = "observers.pt"
STRATEGIES = "strategies.pt"
PROCESS_RNG = "rng_state_process_{rank}.safetensors"
"""State of Python's, NumPy's and PyTorch's own generators of the processes after the first."""
PARTIAL = ".partial_"
"""Prefix of folders that a kill may leave behind; the next checkpoint removes them."""


@dataclass
class RunState:
    """What a run is made of, beside its config."""

    agent: LearningAgent
    loop: LoopState
    generators: NamedGenerators
    env: Any
    preprocessor: Any
    postprocessor: Any
    processes: Processes = field(default_factory=Processes)
    strategies: tuple[Any, ...] = ()
    """Task order and resets: they may keep something of their own."""


def save_checkpoint(
    run: RunState, config: CronosTrainConfig, observers: dict[str, Any], env_state: dict[str, np.ndarray]
) -> Path:
    """Write a checkpoint and point `last` at it; returns its folder. All processes call it, the first one writes.

    A kill at any moment leaves either the whole checkpoint or none: it is written beside its place and
    renamed into it, and `last` changes hands in one step.

    Args:
        run: the run between two segments.
        config: of the run.
        observers: states of the loggers and recorders by name: numbers, strings, NumPy arrays.
        env_state: of `env.get_state()`.
    """
    assert config.output_dir is not None
    folder = Path(config.output_dir) / CHECKPOINTS_DIR
    final = folder / get_step_identifier(run.loop.n, config.total_steps)
    generators = _merge(run.processes.gather_to_main(run.generators.state_dict()))
    agent = agent_state(run.agent)
    other_rngs = run.processes.gather_to_main(serialize_rng_state())[1:]
    if not run.processes.is_main:
        return final
    folder.mkdir(parents=True, exist_ok=True)
    _remove_partial(folder)
    partial = Path(tempfile.mkdtemp(prefix=PARTIAL, dir=folder))
    try:
        save_model(run.agent, config, run.preprocessor, run.postprocessor, partial / PRETRAINED_MODEL_DIR)
        state_dir = partial / TRAINING_STATE_DIR
        _write_training_state(run, state_dir, observers, env_state, generators)
        torch.save(agent, state_dir / AGENT)
        about = describe_run(config, run.loop.n, run.loop.b)
        (state_dir / RUN).write_text(json.dumps(about, indent=2))
        for rank, rng in enumerate(other_rngs, start=1):
            save_file(flatten_dict(rng), state_dir / PROCESS_RNG.format(rank=rank))
        partial.chmod(0o755)
        _flush_to_disk(partial)
        if final.exists():
            final.rename(folder / f"{PARTIAL}{final.name}")
        partial.rename(final)
    except BaseException:
        shutil.rmtree(partial, ignore_errors=True)
        raise
    _point_last_at(final)
    if config.keep_checkpoints is not None:
        for old in list_checkpoints(folder)[: -config.keep_checkpoints]:
            # Of a run that goes on from an earlier one, those of its former end are the later ones.
            if old != final:
                # Half of one would look like one.
                old.rename(tempfile.mkdtemp(prefix=PARTIAL, dir=folder))
    _remove_partial(folder)
    return final


def save_observers(checkpoint: Path, observers: dict[str, Any]) -> None:
    """Replace what a checkpoint keeps of the loggers and recorders, at once or not at all."""
    with written_whole(checkpoint / TRAINING_STATE_DIR / OBSERVERS, "wb") as file:
        torch.save(to_tensors(observers), file)


def go_on_from(checkpoint: Path) -> None:
    """Point `last` at the checkpoint that a run goes on from: later ones are of an end that it no longer has."""
    link = checkpoint.parent / LAST_CHECKPOINT_LINK
    if link.is_symlink() and link.resolve() != checkpoint.resolve():
        _point_last_at(checkpoint.resolve())


def load_checkpoint(run: RunState, config: CronosTrainConfig, folder: Path) -> dict[str, Any]:
    """Bring `run` to where it was saved, but for what `config` changes; returns the observers' states.

    Raises:
        NotADirectoryError: `folder` is no checkpoint of a run.
        ValueError: `config` has what a resumed run refuses, or a file is damaged; it is named.
    """
    saved = check_resumed(config, folder)
    state_dir = folder / TRAINING_STATE_DIR
    with _reading(state_dir / LOOP) as path:
        state = json.loads(path.read_text())
    _warn_of_other_count(folder, run.processes)
    is_elsewhere = _is_of_other_device(saved["config"], config, run.processes)
    with _reading(weights_file(run.agent.policy, folder / PRETRAINED_MODEL_DIR)) as path:
        load_weights(run.agent.policy, path.parent)
    if run.agent.optimizer is not None:
        load = _load_optimizer_of_other_device if is_elsewhere else load_optimizer_state
        with _reading(state_dir / OPTIMIZER_STATE):
            load(run.agent.optimizer, state_dir)
    run.loop.__dict__.update(vars(LoopState.from_state_dict(state["loop"])))
    run.generators.load_state_dict(state["generators"], run.loop.n)
    with _reading(state_dir / ENV_STATE) as path, np.load(path) as arrays:
        run.env.set_state(dict(arrays))
    run.agent.load_state_dict(_load_agent(state_dir / AGENT))
    _load_strategies(run, state_dir / STRATEGIES)
    _load_rng_state(state_dir, run.processes.rank, (config.seed, run.processes.rank, run.loop.n), is_elsewhere)
    with _reading(state_dir / OBSERVERS) as path:
        return to_arrays(torch.load(path))


def list_checkpoints(folder: Path) -> list[Path]:
    """Return the checkpoints in `folder`, oldest first."""
    found = (p for p in folder.iterdir() if p.is_dir() and not p.is_symlink() and p.name.isdigit())
    # By the number: a run that was made longer than a million steps has names of other lengths.
    return sorted(found, key=lambda p: int(p.name))


def save_model(
    agent: LearningAgent, config: CronosTrainConfig, preprocessor: Any, postprocessor: Any, folder: Path
) -> None:
    """Write what LeRobot loads of a run into `folder`, and the config that it was trained with."""
    agent.save_pretrained(folder)
    config.save_pretrained(folder)
    preprocessor.save_pretrained(folder)
    postprocessor.save_pretrained(folder)


def _write_training_state(
    run: RunState,
    folder: Path,
    observers: dict[str, Any],
    env_state: dict[str, np.ndarray],
    generators: dict[str, Any],
) -> None:
    folder.mkdir()
    if run.agent.optimizer is not None:
        save_optimizer_state(run.agent.optimizer, folder)
    save_rng_state(folder)
    save_training_step(run.loop.n, folder, num_processes=run.processes.count)
    np.savez(folder / ENV_STATE, allow_pickle=False, **env_state)
    torch.save(to_tensors(observers), folder / OBSERVERS)
    torch.save(to_tensors(own_states(run.strategies)), folder / STRATEGIES)
    state = {"loop": run.loop.state_dict(), "generators": generators}
    (folder / LOOP).write_text(json.dumps(state))


def _load_agent(path: Path) -> dict[str, Any]:
    if not path.is_file():
        raise ValueError(
            f"{path} is missing: an earlier version made this checkpoint. Begin a new run, with the checkpoint as "
            "--policy.path."
        )
    with _reading(path):
        return as_it_was(torch.load(path, map_location="cpu"))


def _load_strategies(run: RunState, path: Path) -> None:
    # Checkpoints were once without: strategies kept nothing then.
    if not path.is_file():
        return
    with _reading(path):
        states = to_arrays(torch.load(path))
    load_own_states(run.strategies, states)


@contextmanager
def _reading(path: Path) -> Generator[Path]:
    """Name the file that cannot be read."""
    try:
        yield path
    except DAMAGE as error:
        raise ValueError(f"{path} is damaged, or is of another policy: {error}") from error


def _merge(states: list[dict[str, Any]]) -> dict[str, Any]:
    """Join the generators of all processes; those they have in common are alike."""
    return {kind: {name: s for state in states for name, s in state[kind].items()} for kind in ("numpy", "torch")}


def _load_rng_state(folder: Path, rank: int, entropy: tuple[int, ...], is_elsewhere: bool) -> None:
    """Go on with the process's own random numbers.

    One that was not there yet, or not on this kind of device, begins with those of `entropy`.
    """
    path = folder / PROCESS_RNG.format(rank=rank)
    if is_elsewhere or (rank > 0 and not path.exists()):
        # Those of the first process, or of the run's beginning, would be drawn twice.
        set_seed(int(np.random.SeedSequence(entropy).generate_state(1)[0]))
    elif rank > 0:
        deserialize_rng_state(unflatten_dict(load_file(path)))
    else:
        load_rng_state(folder)


def _warn_of_other_count(folder: Path, processes: Processes) -> None:
    saved = load_training_num_processes(folder) or 1
    if saved != processes.count and processes.is_main:
        logging.warning(
            f"The checkpoint is of {saved} processes, this run has {processes.count}: the streams go on where "
            "they were, but with other random numbers, and an optimizer step now takes algorithm.minibatch_size * "
            f"algorithm.grad_accumulation transitions of {processes.count} processes."
        )


def _is_of_other_device(saved: dict[str, Any], config: CronosTrainConfig, processes: Processes) -> bool:
    """Whether the policy was on another kind of device; says what that means."""
    was, now = (saved["policy"] or {}).get("device"), getattr(config.policy, "device", None)
    if not was or not now or torch.device(was).type == torch.device(now).type:
        return False
    if processes.is_main:
        logging.warning(
            f"This run began on {was} and goes on with {now}: other random numbers, another rounding and, of "
            "pixels, other pictures. It will not be what it would have been there."
        )
    return True


def _load_optimizer_of_other_device(optimizer: Optimizer | dict[str, Optimizer], folder: Path) -> None:
    """As LeRobot's `load_optimizer_state`, but how its steps are computed stays what it is on this device."""
    if isinstance(optimizer, dict):
        for name, part in optimizer.items():
            _load_optimizer_of_other_device(part, folder / name)
        return
    saved = load_optimizer_state_dict(folder)
    for group, own in zip(saved["param_groups"], optimizer.param_groups, strict=True):
        group |= {name: own[name] for name in ("fused", "foreach", "capturable") if name in own}
    saved["state"] = {int(index): state for index, state in saved["state"].items()}
    optimizer.load_state_dict(saved)


def _remove_partial(folder: Path) -> None:
    for path in folder.glob(f"{PARTIAL}*"):
        # On NFS a file that somebody has open stays, and its folder; the next checkpoint tries again.
        shutil.rmtree(path, ignore_errors=True)


def _flush_to_disk(folder: Path) -> None:
    for path in folder.rglob("*"):
        if path.is_file():
            with path.open("rb") as file:
                os.fsync(file.fileno())


def _point_last_at(checkpoint: Path) -> None:
    link = checkpoint.parent / LAST_CHECKPOINT_LINK
    new = checkpoint.parent / f".{LAST_CHECKPOINT_LINK}"
    new.unlink(missing_ok=True)
    new.symlink_to(checkpoint.name)
    new.replace(link)
