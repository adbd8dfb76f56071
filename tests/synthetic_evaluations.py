"""Folders of cronos-eval with made-up outcomes."""

import json

from lerobot_env_cronos import gymnasium_id, load_benchmark
from synthetic_runs import INSTRUCTIONS

HEAD = {"format": 2, "scene": "kitchen_2x2", "temperature": 0.6, "seed": 1000, "obs_type": "pixels_agent_pos"}
HEAD |= {"advance": "window", "end_effector_reset": False, "renderer": "classic", "versions": {"mujoco": "4"}}
BENCHMARK = {"environment": gymnasium_id("kitchen_2x2")}
BENCHMARK |= {"fingerprint": load_benchmark(None, "kitchen_2x2").fingerprint}


def write_evaluation(folder, policy, *, tasks=None, chains=None, split="held_out", **changes):
    """Results of cronos-eval: `tasks` has a string of 0 and 1 for each, `chains` the lengths of each ordering."""
    benchmark = BENCHMARK | changes.pop("benchmark", {})
    head = HEAD | {"policy": policy, "policy_fingerprint": policy, "benchmark": benchmark} | changes
    parts = {}
    if tasks:
        parts[f"independent_{split}"] = ("independent", [[int(x) for x in line] for line in tasks])
        head["independent"] = {split: {"per_task": {text: {} for text in INSTRUCTIONS[: len(tasks)]}}}
    if chains:
        parts[f"sequential_{split}_0"] = ("sequential", chains)
        head["sequential"] = {split: {"positions": [{}] * 4}}
    (folder / "parts").mkdir(parents=True)
    for name, (suite, lengths) in parts.items():
        records = [
            {"number": number, "configuration": configuration, "length": length}
            for number, row in enumerate(lengths)
            for configuration, length in enumerate(row)
        ]
        content = {"suite": suite, "split": split, "chains": records}
        (folder / "parts" / f"{name}.json").write_text(json.dumps(content))
    (folder / "results.json").write_text(json.dumps(head | {"made_by": [{"parts": list(parts)}]}))
    return folder


def write_compared_run(folder, seed, tasks, steps=10240, **changes):
    """A run of cronos-train with one evaluation before and one after."""
    folder.mkdir(parents=True)
    lines = []
    for step, strings in ((0, ["0" * len(tasks[0])] * len(tasks)), (steps, tasks)):
        episodes = [[1000, number, c, int(x)] for number, line in enumerate(strings) for c, x in enumerate(line)]
        line = {"kind": "evaluation", "interaction_steps": step, "interventions": 0, "split": "train"}
        line |= {
            "temperature": 0.6,
            "per_task": {text: {} for text in INSTRUCTIONS[: len(tasks)]},
            "episodes": episodes,
        }
        lines.append(json.dumps(line))
    (folder / "metrics.jsonl").write_text("\n".join(lines))
    config = {"seed": seed, "env": {"scene": "kitchen_2x2"}, "protocol": {"scene_reset_interval": 80} | changes}
    start = {"config": config, "environment": BENCHMARK["environment"], "benchmark": BENCHMARK}
    (folder / "manifest.json").write_text(json.dumps({"starts": [start]}))
    return folder
