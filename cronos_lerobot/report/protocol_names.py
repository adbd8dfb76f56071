"""Protocols in words."""

from __future__ import annotations

from typing import Any

DESCRIBED = tuple(
    f"protocol.{name}"
    for name in (
        "scene_reset_interval", "curriculum", "end_effector_reset", "learned_reset", "heuristic_reset",
        "extra_resets", "task_order", "num_configurations", "reset_phase", "reset_starts", "scene_reset",
        "takeover_after", "takeover_price", "reset_budget", "takeover_budget",
    )
)  # fmt: skip
"""Fields that `describe_protocol` puts into words."""


def describe_protocol(protocol: dict[str, Any]) -> str:
    """A protocol as the paper's Table 1 calls it, such as `T = 1280, EER, CL, HSR`.

    Args:
        protocol: of a training config.
    """
    interval = protocol.get("scene_reset_interval")
    words = ["no scene resets" if interval is None else f"T = {interval}"]
    ticks = {"EER": "end_effector_reset", "CL": "curriculum", "LSR": "learned_reset", "HSR": "heuristic_reset"}
    budget, asked = protocol.get("reset_budget"), protocol.get("scene_reset", "periodic") == "critic"
    if asked:
        interval, words = None, [f"{budget} resets asked for by the critic"]
    is_episodic = interval == protocol.get("task_switch_interval") and not protocol.get("curriculum")
    if interval and is_episodic:
        # A scene reset at every task switch sends the arm home anyway.
        del ticks["EER"]
    if protocol.get("reset_phase", "together") != "together":
        words.append(protocol["reset_phase"])
    if protocol.get("reset_starts", "random") != "random":
        words.append(f"{protocol['reset_starts']} starts")
    words += [word for word, name in ticks.items() if protocol.get(name)]
    words += protocol.get("extra_resets") or []
    if protocol.get("task_order", "heuristic") != "heuristic":
        words.append(f"{protocol['task_order']} order")
    if protocol.get("num_configurations", 64) != 64:
        words.append(f"{protocol['num_configurations']} configuration(s)")
    if protocol.get("takeover_after") is not None:
        price = f" at {protocol['takeover_price']} each" if protocol["takeover_price"] != 1 else ""
        words.append(f"takeovers after {protocol['takeover_after']}{price}")
        if (limit := protocol.get("takeover_budget")) is not None:
            words.append(f"at most {limit} for takeovers")
    if budget is not None and not asked:
        words.append(f"at most {budget} interventions")
    return ", ".join(words)
