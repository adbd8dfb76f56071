"""Folders of cronos-eval with made-up outcomes."""

import json

import numpy as np
from lerobot_env_cronos import gymnasium_id
from synthetic_runs import BENCHMARK, INSTRUCTIONS, rate

from cronos_lerobot.evaluation.results import FORMAT

HEAD = {"format": FORMAT, "scene": "kitchen_2x2", "temperature": 0.6, "seed": 1000, "obs_type": "pixels_agent_pos"}
HEAD |= {"environment": gymnasium_id("kitchen_2x2"), "benchmark": BENCHMARK, "renderer": "classic"}
HEAD |= {"advance": "window", "end_effector_reset": False, "versions": {"mujoco": "4"}}


BEFORE, AFTER = (["1" * wins + "0" * (8 - wins) for wins in some] for some in ((1, 2, 3, 4), (8, 6, 7, 5)))
"""Outcomes of four tasks: 10 and 26 of 32."""


def write_evaluation(
    folder, policy, *, tasks=None, chains=None, stream=None, split="held_out", video=None, **changes
):
    """Results of one suite: `tasks` has a string of 0 and 1 for each, `chains` the lengths for each ordering.

    `stream` has a string of 0 and 1 for each stream, `video` the bytes of one.
    """
    suite = "independent" if tasks else "sequential" if chains else "stream"
    rows = tasks or chains or [[line.count("1")] for line in stream]
    head = HEAD | {"policy": policy, "policy_fingerprint": policy, "suite": suite, "split": split} | changes
    episodes = [
        {
            "number": number,
            "configuration": configuration,
            "seed": head["seed"],
            "length": int(length),
            "steps": 80,
        }
        | {"found_complete": [], "never_grasped": []}
        for number, row in enumerate(rows)
        for configuration, length in enumerate(row)
    ]
    lengths = np.array([episode["length"] for episode in episodes])
    head |= {"n": len(episodes), "episodes": episodes}
    if suite == "sequential":
        head |= _positions(lengths) | {"seen": _positions(lengths), "unseen": None}
    elif suite == "independent":
        per_task = {text: rate([int(x) > 0 for x in row]) for text, row in zip(INSTRUCTIONS, rows, strict=False)}
        head |= rate(lengths > 0) | {"per_task": per_task}
    else:
        flags = np.array([[x == "1" for x in line] for line in stream])
        head |= rate(flags.ravel()) | {"n": len(stream), "by_segment": [rate(column) for column in flags.T]}
    path = folder / f"{suite}_{split}"
    path.mkdir(parents=True)
    (path / "results.json").write_text(json.dumps(head))
    if video is not None:
        (path / "videos").mkdir()
        (path / "videos/own.mp4").write_bytes(video)
    return folder


def _positions(lengths):
    positions = [rate(lengths > k) | {"std": 0.1} for k in range(4)]
    length = {"mean": float(lengths.mean()), "std": 0.2, "ci95": [0.0, 4.0]}
    return {"n": len(lengths), "positions": positions, "average_chain_length": length}
