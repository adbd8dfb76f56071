"""Run folders of cronos-train with made-up numbers."""

import json

import numpy as np
from lerobot_env_cronos import gymnasium_id, load_benchmark
from lerobot_env_cronos.scene.scenes import SCENES

from cronos_lerobot.statistics import cluster_interval

TASKS = SCENES["kitchen_2x2"].tasks
INSTRUCTIONS = [task.instruction for task in TASKS]
BENCHMARK = {"source": "a test", "fingerprint": load_benchmark(None, "kitchen_2x2").fingerprint}
STREAMS = 8
KINDS = ("task_switch", "end_effector_reset", "heuristic_reset", "scene_reset", "divergence", "initial")


def ppo_metrics(update):
    return {
        "approx_kl": 0.01 * update,
        "entropy": 3.0 - 0.1 * update,
        "explained_variance": None if update == 1 else 0.1 * update,
    }


def imitation_metrics(update):
    """The first update has too few successes to learn from."""
    return {"segments": 10.0 * update} | ({} if update == 1 else {"loss": 1 / update, "grad_norm": 0.2})


AGENTS = {"ppo": ppo_metrics, "imitation": imitation_metrics}
"""What each agent says of an update, by `--algorithm.type`."""


def outcomes(successes, n=8):
    """Strings of 0 and 1, one for each of four tasks: `successes` of `n`."""
    return ["1" * successes + "0" * (n - successes)] * len(TASKS)


def write_training_run(
    folder,
    *,
    seed=0,
    interval=320,
    successes=(2, 3, 5),
    updates=8,
    agent="ppo",
    tasks=None,
    config=None,
    **protocol,
):
    """A run of `updates` updates of 160 steps, evaluated at its start, middle and end.

    `successes` of 8 episodes a task succeed at each evaluation. With `tasks`, none do before these last outcomes.
    """
    folder.mkdir(parents=True)
    rng = np.random.default_rng(seed)
    nothing = ["0" * len(line) for line in tasks or ()]
    found = [nothing, nothing, tasks] if tasks else [*map(outcomes, successes)]
    lines = [_counters("evaluation", 0, 0) | evaluation(found[0])]
    for update in range(1, updates + 1):
        n = 160 * STREAMS * update
        resets = STREAMS * (update * 160 // interval)
        lines.append(_counters("update", n, resets) | _update(update, interval, rng, agent))
        if update * 2 in (updates, 2 * updates):
            lines.append(_counters("evaluation", n, resets) | evaluation(found[update * 2 // updates]))
    (folder / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    settings = {
        "seed": seed,
        "job_name": "kitchen",
        "output_dir": str(folder),
        "num_envs": STREAMS,
        "env": {"scene": "kitchen_2x2"},
        "protocol": {"task_switch_interval": 80, "scene_reset_interval": interval} | protocol,
        "algorithm": {"type": agent},
    } | (config or {})
    start = {"command": ["cronos-train"], "versions": {"mujoco": "4.0.0"}, "config": settings}
    start |= {"environment": gymnasium_id("kitchen_2x2"), "benchmark": BENCHMARK}
    (folder / "manifest.json").write_text(json.dumps({"starts": [start]}))
    return folder


def edit_lines(run, edit):
    """Change the records of metrics.jsonl: `edit` takes the list of them."""
    path = run / "metrics.jsonl"
    lines = [json.loads(line) for line in path.read_text().splitlines()]
    edit(lines)
    path.write_text("".join(json.dumps(line) + "\n" for line in lines))


def edit_starts(run, edit):
    """Change the starts of manifest.json: `edit` takes the list of them."""
    content = json.loads((run / "manifest.json").read_text())
    edit(content["starts"])
    (run / "manifest.json").write_text(json.dumps(content))


def _update(update, interval, rng, agent):
    segments = {}
    for position in range(interval // 80):
        if (update * 2 - 2) % (interval // 80) <= position < (update * 2 - 2) % (interval // 80) + 2:
            rate = min(0.95, max(0.1, 0.8 - 0.15 * position + 0.02 * update))
            segments[str(position)] = [int(rng.binomial(STREAMS, rate)), STREAMS]
    won, tried = np.array(list(segments.values())).sum(0).tolist()
    rollout = {"success": won / tried, "segments": tried, "success_by_segment": segments}
    rollout |= {"success_by_task": {INSTRUCTIONS[0]: [won, tried]}, "reward_per_segment": 0.5, "diverged": 0}
    speed = {"steps_per_s": 500.0 if update % 2 else 1000.0, "time_share": {"env": 0.5, "update": 0.25}}
    return {"rollout": rollout, "agent": AGENTS[agent](update)} | speed


def _counters(kind, n, resets):
    kinds = dict.fromkeys(KINDS, 0) | {"scene_reset": resets, "initial": STREAMS}
    counts = {"interaction_steps": n, "interventions": resets, "updates": n // (160 * STREAMS)}
    streams = [resets // STREAMS] * STREAMS
    return {"kind": kind} | counts | {"interventions_by_kind": kinds, "interventions_by_stream": streams}


def rate(flags):
    flags = np.array(flags)
    interval = cluster_interval(flags, np.arange(len(flags)))
    numbers = {"success": float(flags.mean()), "n": len(flags), "ci95": list(interval)}
    return numbers | {"found_complete": 0, "never_grasped": 0}


def evaluation(tasks, split="train"):
    """A periodic evaluation, from outcomes: a string of 0 and 1 for each task."""
    flags = [[bool(int(x)) for x in line] for line in tasks]
    episodes = [[1000, number, c, int(x)] for number, line in enumerate(flags) for c, x in enumerate(line)]
    head = {"split": split, "temperature": 0.6, "episodes": episodes} | rate(
        [flag for line in flags for flag in line]
    )
    return head | {"per_task": dict(zip(INSTRUCTIONS, map(rate, flags), strict=False))}
