"""Checkpoints in LeRobot's layout that resume a run bit for bit.

checkpoints/
  0102400/
    pretrained_model/   config.json, model.safetensors, processors, train_config.json: what LeRobot loads
    training_state/     state.pt: loop, random numbers, environment, agent, optimizer, observers, strategies
  last -> 0102400

Of a run on many processes it holds the streams and random numbers of all of them, written by the first one.
"""

from __future__ import annotations

import logging
import os
import shutil
import tempfile
from pathlib import Path
from pickle import UnpicklingError
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from lerobot.common.train_utils import get_step_identifier
from lerobot.utils.constants import (
    CHECKPOINTS_DIR,
    LAST_CHECKPOINT_LINK,
    PRETRAINED_MODEL_DIR,
    TRAINING_STATE_DIR,
)
from lerobot.utils.random_utils import deserialize_rng_state, serialize_rng_state, set_seed
from safetensors import SafetensorError
from torch.optim import Optimizer

from cronos_lerobot.agents.state import agent_state, as_it_was, to_saved
from cronos_lerobot.agents.weights import load_weights
from cronos_lerobot.protocol.loop_state import LoopState
from cronos_lerobot.protocol.own_state import load_own_states, own_states
from cronos_lerobot.training.run_folder import MANIFEST, describe_environment

if TYPE_CHECKING:
    from cronos_lerobot.training.run import Run

STATE = "state.pt"
FORMAT = 1
"""Of state.pt; another one is an error."""
PARTIAL = ".partial_"
"""Prefix of folders that a kill may leave behind; the next checkpoint removes them."""
DAMAGE = (RuntimeError, ValueError, KeyError, TypeError, AttributeError, EOFError, OSError, UnpicklingError)
"""What PyTorch raises for a file that is truncated, or no state at all."""


def save_checkpoint(run: Run, observers: dict[str, Any], env_state: dict[str, np.ndarray] | None) -> Path:
    """Write a checkpoint and point `last` at it; returns its folder. All processes call it, the first one writes.

    A kill at any moment leaves either the whole checkpoint or none: it is written beside its place and
    renamed into it, and `last` changes hands in one step.

    Args:
        run: between two segments.
        observers: states of the loggers and recorders by name: numbers, strings, NumPy arrays.
        env_state: of `env.get_state()`; None of a world without.

    Raises:
        OSError: the run's folder is gone, or the disk is full.
    """
    output_dir = Path(run.config.output_dir or "")
    folder = output_dir / CHECKPOINTS_DIR
    final = folder / get_step_identifier(run.loop.n, run.config.total_steps)
    state = _collect(run, observers, env_state)
    if not run.ranks.is_main:
        return final
    if not (output_dir / MANIFEST).is_file():
        raise FileNotFoundError(f"the run's folder {output_dir} is gone: the run cannot save and has stopped.")
    folder.mkdir(exist_ok=True)
    _remove_partial(folder)
    partial = Path(tempfile.mkdtemp(prefix=PARTIAL, dir=folder))
    try:
        _write(run, state, partial)
        if final.exists():
            final.rename(folder / f"{PARTIAL}{final.name}")
        partial.rename(final)
    except BaseException:
        shutil.rmtree(partial, ignore_errors=True)
        raise
    point_last_at(final)
    if run.config.keep_checkpoints is not None:
        for old in list_checkpoints(folder)[: -run.config.keep_checkpoints]:
            # Of a run that resumes from an earlier one, those of its former end are the later ones.
            if old != final:
                # Half of one would look like one.
                old.rename(tempfile.mkdtemp(prefix=PARTIAL, dir=folder))
    _remove_partial(folder)
    return final


def read_state(checkpoint: Path) -> dict[str, Any]:
    """Read the state in a checkpoint, without executing anything that the file says.

    Raises:
        ValueError: the file is missing or damaged, or of another version of this package.
    """
    path = checkpoint / TRAINING_STATE_DIR / STATE
    try:
        state = as_it_was(torch.load(path, map_location="cpu", weights_only=True, mmap=True))
        found = state["format"]
    except DAMAGE as error:
        # PyTorch's own message advises to load the file unsafely.
        raise ValueError(f"{path} is missing or damaged, or cronos-train did not write it.") from error
    if found != FORMAT:
        raise ValueError(f"{path} has format {found}, this version reads {FORMAT}: begin a new run.")
    return state


def restore(run: Run, state: dict[str, Any]) -> dict[str, Any]:
    """Bring `run` to where it was saved, but for what its config changes; returns the observers' states.

    Args:
        run: just made, of a config with a `checkpoint_path`.
        state: of `read_state`.

    Raises:
        ValueError: the weights or the state are damaged, or of another policy or environment.
    """
    checkpoint = Path(run.config.checkpoint_path or "")
    _check_identity(state, describe_environment(run.env.identity))
    try:
        load_weights(run.agent.policy, checkpoint / PRETRAINED_MODEL_DIR)
        _restore(run, state)
    except (*DAMAGE, SafetensorError) as error:
        raise ValueError(f"{checkpoint} is damaged, or of another policy: {error}") from error
    return state["observers"]


def list_checkpoints(folder: Path) -> list[Path]:
    """Return the checkpoints in `folder`, oldest first."""
    found = (p for p in folder.iterdir() if p.is_dir() and not p.is_symlink() and p.name.isdigit())
    # By the number: a run that was made longer than a million steps has names of other lengths.
    return sorted(found, key=lambda p: int(p.name))


def point_last_at(checkpoint: Path) -> None:
    """Point `last` at a checkpoint: later ones are of an end that the run no longer has."""
    checkpoint = checkpoint.resolve()
    link = checkpoint.parent / LAST_CHECKPOINT_LINK
    new = checkpoint.parent / f".{LAST_CHECKPOINT_LINK}"
    new.unlink(missing_ok=True)
    new.symlink_to(checkpoint.name)
    new.replace(link)


def _collect(run: Run, observers: dict[str, Any], env_state: dict[str, np.ndarray] | None) -> dict[str, Any]:
    """What state.pt holds; only the first process has all of it."""
    optimizer = run.agent.optimizer
    state = {
        "format": FORMAT,
        "interaction_steps": run.loop.n,
        "interventions": run.loop.b,
        "config": run.config.to_dict(),
        "num_processes": run.ranks.count,
        "loop": run.loop.state_dict(),
        "generators": _merge(run.ranks.gather_to_main(run.generators.state_dict())),
        "rng": run.ranks.gather_to_main(serialize_rng_state()),
        "env": env_state,
        "strategies": own_states(run.strategies),
        "optimizer": None if optimizer is None else _states(optimizer),
        "observers": observers,
    }
    saved = to_saved(state | describe_environment(run.env.identity), "state")
    return saved | {"agent": agent_state(run.agent)}


def _write(run: Run, state: dict[str, Any], folder: Path) -> None:
    for part in (run.agent, run.config, run.preprocessor, run.postprocessor):
        part.save_pretrained(folder / PRETRAINED_MODEL_DIR)
    path = folder / TRAINING_STATE_DIR / STATE
    path.parent.mkdir()
    try:
        torch.save(state, path)
    except RuntimeError as error:
        # Of PyTorch's own file writer.
        raise OSError(f"{path} cannot be written, perhaps the disk is full: {error}") from error
    folder.chmod(0o755)
    for path in folder.rglob("*"):
        if path.is_file():
            with path.open("rb") as file:
                os.fsync(file.fileno())


def _restore(run: Run, state: dict[str, Any]) -> None:
    if run.agent.optimizer is not None:
        _load_optimizer(run.agent.optimizer, state["optimizer"])
    run.loop.__dict__.update(vars(LoopState.from_state_dict(state["loop"])))
    run.generators.load_state_dict(state["generators"], run.loop.n)
    _restore_world(run, state["env"])
    run.agent.load_state_dict(state["agent"])
    load_own_states(run.strategies, state["strategies"])
    rank, count = run.ranks.rank, len(state["rng"])
    if count != run.ranks.count:
        logging.warning(
            f"The checkpoint is of {count} processes, this run has {run.ranks.count}: its random numbers are "
            "others, and an optimizer step takes the minibatches of as many processes."
        )
    if rank < count and not _changes_device(run, state["config"]["policy"].get("device")):
        deserialize_rng_state(state["rng"][rank])
    else:
        # Those of the first process, or of the run's beginning, would be drawn twice.
        set_seed(int(np.random.SeedSequence((run.config.seed, rank, run.loop.n)).generate_state(1)[0]))


def _check_identity(was: dict[str, Any], now: dict[str, Any]) -> None:
    """Check that a run resumes in the world that it began in. The source names a release."""
    for name in ("environment", "benchmark"):
        had, has = (one[name] if name == "environment" else one[name]["fingerprint"] for one in (was, now))
        if had != has:
            raise ValueError(
                f"the run began with the {name} {was[name]}, which now is {now[name]}: begin a new run"
            )


def _restore_world(run: Run, state: dict[str, np.ndarray] | None) -> None:
    """Put the streams back to where they were; where a world keeps no state, place them anew."""
    if state is not None:
        run.env.set_state(state)
        return
    logging.warning(f"{run.env.identity.id} keeps no state: every stream begins with a new placement.")
    streams = np.arange(run.loop.num_streams)
    run.resets.initial.apply(run.env, streams)
    run.loop.count_intervention(streams, run.resets.initial.kind)
    run.loop.diverged[:] = False


def _changes_device(run: Run, was: str | None) -> bool:
    """Whether the policy was on another kind of device, which is told."""
    now = getattr(run.config.policy, "device", None)
    if not (was and now) or torch.device(was).type == torch.device(now).type:
        return False
    logging.warning(
        f"This run began on {was} and resumes on {now}, with other random numbers and another rounding: it will "
        "not be what it would have been there."
    )
    return True


def _states(optimizer: Optimizer | dict[str, Optimizer]) -> dict[str, Any]:
    if isinstance(optimizer, dict):
        return {name: part.state_dict() for name, part in optimizer.items()}
    return optimizer.state_dict()


def _load_optimizer(optimizer: Optimizer | dict[str, Optimizer], state: dict[str, Any]) -> None:
    if isinstance(optimizer, dict):
        for name, part in optimizer.items():
            _load_optimizer(part, state[name])
        return
    for group, own in zip(state["param_groups"], optimizer.param_groups, strict=True):
        # How its steps are computed depends on the device.
        group |= {name: own[name] for name in ("fused", "foreach", "capturable") if name in own}
    optimizer.load_state_dict(state)


def _merge(states: list[dict[str, Any]]) -> dict[str, Any]:
    """Join the generators of all processes; those they have in common are alike."""
    return {kind: {name: s for state in states for name, s in state[kind].items()} for kind in ("numpy", "torch")}


def _remove_partial(folder: Path) -> None:
    for path in folder.glob(f"{PARTIAL}*"):
        # On NFS a file that somebody has open stays, and its folder; the next checkpoint tries again.
        shutil.rmtree(path, ignore_errors=True)
