"""Run folders with made-up numbers, in the formats of cronos-train and lerobot-eval."""

import csv
import json
from pathlib import Path

import numpy as np
from lerobot_env_cronos.scene.scenes import SCENES

from cronos_lerobot.evaluation.results import independent_results

TASKS = SCENES["kitchen_2x2"].tasks
INSTRUCTIONS = [task.instruction for task in TASKS]
STREAMS = 8
KINDS = ("task_switch", "end_effector_reset", "heuristic_reset", "scene_reset", "divergence", "initial")


def ppo_metrics(update):
    return {
        "approx_kl": 0.01 * update,
        "entropy": 3.0 - 0.1 * update,
        "explained_variance": None if update == 1 else 0.1 * update,
        "clip_fraction": 0.1,
        "policy_lr": 3e-5,
    }


def imitation_metrics(update):
    """With a weighting; the first update has too few successes to learn from."""
    metrics = {"segments": 10.0 * update, "frames": 300.0 * update, "failed_segments": 5.0 * update}
    metrics |= {"effective_share": 0.5, "optimizer_steps": 0.0 if update == 1 else 100.0}
    return metrics if update == 1 else metrics | {"loss": 1 / update, "grad_norm": 0.2}


def steering_metrics(update):
    """The first update has too few decisions to learn from."""
    metrics = {"decisions": 640.0 * update, "optimizer_steps": 0.0 if update == 1 else 64.0}
    if update == 1:
        return metrics
    return metrics | {
        "critic_loss": 0.1 / update, "critic_grad_norm": 0.4, "actor_loss": -0.1, "actor_grad_norm": 0.1,
        "value": 0.05 * update, "entropy": 0.3, "choice_abs": 0.5, "alpha": 0.01 / update,
    }  # fmt: skip


AGENTS = {"ppo": ppo_metrics, "imitation": imitation_metrics, "steering": steering_metrics}
"""What each agent says of an update, by `--algorithm.type`."""


def write_training_run(folder, *, seed=0, interval=320, successes=(2, 3, 5), updates=8, agent="ppo"):
    """A run of `updates` updates of 160 steps; `successes` of 4 episodes a task at each of three evaluations."""
    folder.mkdir(parents=True)
    rng = np.random.default_rng(seed)
    lines, n = [], 0
    lines.append(_counters("evaluation", 0, 0) | _evaluation(successes[0]))
    for update in range(1, updates + 1):
        n += 160 * STREAMS
        segments = {}
        for position in range(interval // 80):
            if (update * 2 - 2) % (interval // 80) <= position < (update * 2 - 2) % (interval // 80) + 2:
                rate = min(0.95, max(0.1, 0.8 - 0.15 * position + 0.02 * update))
                segments[str(position)] = [int(rng.binomial(STREAMS, rate)), STREAMS]
        won, tried = np.array(list(segments.values())).sum(0).tolist()
        resets = STREAMS * (update * 160 // interval)
        lines.append(
            _counters("update", n, resets)
            | {
                "rollout": {
                    "success": won / tried,
                    "segments": tried,
                    "success_by_segment": segments,
                    "success_by_task": {INSTRUCTIONS[0]: [won, tried]},
                    "reward_per_segment": 0.5,
                    "diverged": 0,
                },
                "agent": AGENTS[agent](update),
                "steps_per_s": 500.0 if update % 2 else 1000.0,
                "time_share": {"env": 0.5, "update": 0.25},
            }
        )
        if update * 2 in (updates, 2 * updates):
            lines.append(_counters("evaluation", n, resets) | _evaluation(successes[update * 2 // updates]))
    (folder / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    config = {
        "seed": seed,
        "output_dir": str(folder),
        "num_envs": STREAMS,
        "protocol": {"scene_reset_interval": interval},
        "algorithm": {"type": agent},
    }
    start = {"command": ["cronos-train"], "versions": {"mujoco": "4.0.0"}, "config": config}
    start["environment"] = "lerobot_env_cronos/kitchen_2x2-v1"
    (folder / "manifest.json").write_text(json.dumps({"starts": [start]}))
    return folder


def _counters(kind, n, resets):
    kinds = dict.fromkeys(KINDS, 0) | {"scene_reset": resets, "initial": STREAMS}
    return {"kind": kind, "interaction_steps": n, "interventions": resets, "interventions_by_kind": kinds} | {
        "updates": n // (160 * STREAMS)
    }


def _evaluation(successes):
    kinds: dict[str, list] = {"found_complete": [], "never_grasped": []}
    records = [{"number": task, "length": int(i < successes)} | kinds for task in range(4) for i in range(8)]
    episodes = [[1000, task, i, int(i < successes)] for task in range(4) for i in range(8)]
    results = independent_results(records, TASKS)
    return {"split": "train", "temperature": 0.6, "episodes": episodes} | results


def write_evaluation(folder, suite="independent_train", successes=(1, 2, 3, 4), n=8, video=None):
    """Output of lerobot-eval: `successes[i]` of `n` episodes of task i, the last ones; `video` is of episode 0."""
    per_task = []
    for number, wins in enumerate(successes):
        paths = []
        if video:
            path = Path(folder) / "videos" / f"{suite}_{number}" / "eval_episode_0.mp4"
            path.parent.mkdir(parents=True)
            path.write_bytes(video)
            # lerobot-eval writes the path as it was given --output_dir.
            paths = [f"elsewhere/{path.relative_to(folder)}"]
        metrics = {"successes": [i >= n - wins for i in range(n)], "video_paths": paths}
        per_task.append({"task_group": suite, "task_id": number, "metrics": metrics})
    Path(folder).mkdir(parents=True, exist_ok=True)
    (Path(folder) / "eval_info.json").write_text(json.dumps({"per_task": per_task}))
    return folder


def read_csv(path):
    """A CSV file of a report, a dict for each line."""
    with path.open() as file:
        return list(csv.DictReader(file))
