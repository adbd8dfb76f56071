"""What a card tells about a training run of cronos-train."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from huggingface_hub import constants
from lerobot.configs.train import TRAIN_CONFIG_NAME
from lerobot.utils.constants import (
    CHECKPOINTS_DIR,
    LAST_CHECKPOINT_LINK,
    PRETRAINED_MODEL_DIR,
    TRAINING_STATE_DIR,
)

from cronos_lerobot.hub.cards import command_line, without_folders
from cronos_lerobot.protocol.config import COUNTED_INTERVENTIONS
from cronos_lerobot.protocol.interventions import Intervention
from cronos_lerobot.report.protocol_names import describe_protocol
from cronos_lerobot.report.runs import TrainingRun, config_of, read_training_run
from cronos_lerobot.training.logging import MANIFEST, METRICS
from cronos_lerobot.training.resume import read_run as read_checkpoint

LEARNED = {
    "ppo": ("reinforcement learning", "reinforcement-learning"),
    "ppo_paper": ("reinforcement learning", "reinforcement-learning"),
    "steering": ("reinforcement learning of the noise that it begins with", "reinforcement-learning"),
    "imitation": ("imitation of its own successes", "imitation-learning"),
}
"""How an agent learns, in words, and the Hub's tag of that."""
WEIGHTED = "imitation of its own segments, weighted by their {weighting}"


@dataclass(frozen=True)
class Checkpoint:
    """A policy on disk, and the run that it comes from."""

    model: Path
    """LeRobot's folder: config.json, model.safetensors, processors."""
    run: Path | None
    """Folder of cronos-train, if it is of one."""
    step: int | None
    """Interaction steps before it, if it is of a run."""


def find_checkpoint(path: Path) -> Checkpoint:
    """The checkpoint that `path` means: a run folder (the last one), a checkpoint, or a model's folder.

    Raises:
        FileNotFoundError: there is no policy there.
        ValueError: the checkpoint is of an end that its run no longer has.
    """
    candidates = (
        path / CHECKPOINTS_DIR / LAST_CHECKPOINT_LINK / PRETRAINED_MODEL_DIR,
        path / PRETRAINED_MODEL_DIR,
        path,
    )
    for model in candidates:
        if (model / "config.json").is_file() and any(model.glob("*.safetensors")):
            break
    else:
        raise FileNotFoundError(
            f"{path} holds no policy: expected a run folder of cronos-train, one of its checkpoints, or a folder"
            " with config.json and model.safetensors"
        )
    model = model.resolve()
    checkpoint = model.parent
    run = checkpoint.parent.parent
    if checkpoint.name.isdigit() and (run / METRICS).is_file() and (run / MANIFEST).is_file():
        _check_history(checkpoint, run)
        return Checkpoint(model, run, int(checkpoint.name))
    return Checkpoint(model, None, None)


def _check_history(checkpoint: Path, folder: Path) -> None:
    """Refuse a checkpoint of an end that a run no longer has: it went on from an earlier one, in another way."""
    if not (checkpoint / TRAINING_STATE_DIR).is_dir():
        # A copy without the training's state.
        return
    saved, steps, run = read_checkpoint(checkpoint), int(checkpoint.name), read_training_run(folder)
    had = [one["interventions"] for one in (*run.updates, *run.ends) if one["interaction_steps"] == steps]
    # Where a budget had ended it the run may have gone on from just there, which has no record then.
    went_on = not had and any(start.get("interaction_steps") == steps for start in run.starts)
    if not went_on and (not had or had[-1] != saved["interventions"]):
        now = f"comes to {had[-1]}" if had else f"ends at step {run.last['interaction_steps']}"
        raise ValueError(
            f"{checkpoint} is not of the run that is in {folder} now: it had {saved['interventions']} "
            f"interventions at step {steps}, and the run, which has gone on from an earlier checkpoint, {now}"
        )


def read_run(folder: Path, step: int | None = None) -> TrainingRun:
    """A run as it was at `step`, or as it is."""
    run = read_training_run(folder)
    if step is not None:
        run.evaluations = [record for record in run.evaluations if record["interaction_steps"] <= step]
        run.updates = [record for record in run.updates if record["interaction_steps"] <= step]
        run.ends = [record for record in run.ends if record["interaction_steps"] <= step]
        # Of before it was noted, all may have come to it.
        run.starts = run.starts[:1] + [one for one in run.starts[1:] if one.get("interaction_steps", 0) < step]
        run.config = config_of(folder, run.starts)
    return run


def is_of_cronos_train(config: dict[str, Any]) -> bool:
    """Whether a training config, which lies beside a policy wherever that is copied to, is of cronos-train."""
    return all(config.get(name) for name in ("env", "protocol", "algorithm"))


def config_facts(config: dict[str, Any]) -> dict[str, Any]:
    """The facts that cards show of a training config of cronos-train."""
    env, protocol = config["env"], config["protocol"]
    return {
        "scene": env["scene"],
        "env": env,
        "observation": describe_observation(env),
        "configurations": _describe_configurations(env.get("benchmark"), protocol),
        "protocol": protocol,
        "protocol_name": describe_protocol(protocol),
        "scene_resets": _describe_scene_resets(protocol),
        "reset_phase": protocol["reset_phase"] if protocol.get("reset_phase", "together") != "together" else None,
        "takeovers": _describe_takeovers(protocol),
        "algorithm": config["algorithm"]["type"],
        "learned": _describe_learning(config["algorithm"]),
        "learned_tag": LEARNED.get(config["algorithm"]["type"], (None, None))[1],
        "num_envs": config["num_envs"],
        "seed": config["seed"],
    }


def run_facts(run: TrainingRun) -> dict[str, Any]:
    """The facts of a run that cards show."""
    last = run.last
    return config_facts(run.config) | {
        "steps": last["interaction_steps"],
        "updates": last["updates"],
        "interventions": last["interventions"],
        "by_kind": _by_kind(last["interventions_by_kind"], run.config["protocol"].get("takeover_price", 1)),
        "evaluations": run.evaluations,
        "versions_then": run.starts[-1]["versions"],
        "commit_then": run.starts[-1]["git_commit"],
        "command": command_line(run.starts[0]["command"]),
        "num_starts": len(run.starts),
        "changed": [without_folders(f"{name}={values}") for name, values in run.changed.items()],
    }


def _describe_scene_resets(protocol: dict[str, Any]) -> str:
    """When there is a scene reset, in words; critics ask for them where T has its default, too."""
    if protocol.get("scene_reset", "periodic") == "critic":
        return "asked for by the critic"
    interval = protocol["scene_reset_interval"]
    return f"every {interval} steps of a stream" if interval else "never"


def _describe_takeovers(protocol: dict[str, Any]) -> str | None:
    """When an expert takes over, in words; None if it never does."""
    if (after := protocol.get("takeover_after")) is None:
        return None
    budget, price = protocol.get("takeover_budget"), protocol["takeover_price"]
    limit = f", at most {budget} interventions in all" if budget is not None else ""
    return f"after {after} failures in a row, each counts as {price}{limit}"


def _describe_learning(algorithm: dict[str, Any]) -> str:
    """How the policy learned, in words, with the agent's name."""
    words = LEARNED.get(algorithm["type"], ("learning", None))[0]
    weighting = algorithm.get("weighting", "none")
    if algorithm["type"] == "imitation" and weighting != "none":
        words = WEIGHTED.format(weighting=weighting)
    return f"{words} (agent `{algorithm['type']}`)"


def _describe_configurations(benchmark: str | None, protocol: dict[str, Any]) -> str:
    """Where scene resets put the bodies, in words."""
    source = "the package"
    if benchmark is not None:
        name = benchmark.partition("@")[0]
        source = (
            f"[{benchmark}]({constants.ENDPOINT}/datasets/{name})" if is_repository(name) else "a local benchmark"
        )
    return f"{protocol['num_configurations']} training configurations of {source}"


def _by_kind(counts: dict[str, int], takeover_price: int) -> list[tuple[str, int, str]]:
    """(kind, number, whether one counts and as how many); no takeovers where there were none."""
    counted = {kind.name.lower(): "yes" for kind in COUNTED_INTERVENTIONS}
    takeover = Intervention.TAKEOVER.name.lower()
    counted[takeover] = f"yes, as {takeover_price}"
    return [
        (name.lower().replace("_", " "), number, counted.get(name.lower(), "no"))
        for name, number in counts.items()
        if number or name != takeover
    ]


def describe_observation(env: dict[str, Any]) -> str:
    """What was observed, in words."""
    # Runs of before there was a choice do not name it.
    told = "" if env.get("task_observation", "none") == "none" else ", with the task in `observation.state`"
    if env["obs_type"] != "pixels_agent_pos":
        return f"privileged state: the poses of all bodies{told}"
    cameras = " and ".join(f"`{name.strip()}`" for name in env["camera_name"].split(","))
    state = ", with the privileged state beside it" if env["privileged_state"] else ""
    renderer = env.get("renderer", "classic")
    drawn = "" if renderer == "classic" else f", drawn by {renderer}"
    return f"camera {cameras}, {env['observation_width']} x {env['observation_height']} px{drawn}{state}{told}"


def is_repository(name: Any) -> bool:
    """Whether a path or name can be a repository on the Hub: `<owner>/<name>`, and no folder here."""
    text = str(name or "")
    return text.count("/") == 1 and not text.startswith((".", "/", "~")) and not Path(text).exists()


def describe_source(source: str) -> str:
    """Where a benchmark is from, without the folders of whoever used it: a card is public."""
    is_folder = "/" in source or Path(source).exists()
    return "a local benchmark" if is_folder and not is_repository(source.partition("@")[0]) else source


def train_config_path(model: Path) -> Path:
    """Of the training config beside a policy."""
    return model / TRAIN_CONFIG_NAME
