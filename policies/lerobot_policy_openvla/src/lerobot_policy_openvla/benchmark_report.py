"""What the benchmark prints (see benchmark.py)."""

from __future__ import annotations

from typing import Any

TOTAL_STEPS = 1_300_000
"""Interaction steps of the paper's Table 1."""


def report(result: dict[str, Any]) -> str:
    """The result of `measure` as a text for the console."""
    rollout, update, work = result["rollout_s"], result["update_s"], result["arithmetic"]
    args, gib = result["settings"], 2.0**30
    flop = work["rollout_flop"] + work["update_flop"]
    step = rollout["whole"] + update["whole"]
    lines = [
        f"OpenVLA {args['size']}, {result['parameters'] / 1e9:.2f} G parameters, {result['trained'] / 1e6:.1f} M "
        f"trained, on {result['machine'] or 'CPU'} ({args['device']}, {result['threads']} threads)",
        "memory [GiB]: "
        + ", ".join(f"{k} {v / gib:.2f}" for k, v in result["memory_bytes"].items())
        + f"; activations {result['activation_bytes'] / gib:.3f} for each transition of a minibatch",
        f"log ratio before the first update: {result['ratio_error']:.1e} nats from 0 in the mean",
        f"rollout  {1 / rollout['whole']:10.2f} steps/s: " + _seconds(rollout),
        f"update   {1 / update['whole']:10.2f} steps/s: " + _seconds(update),
        f"prompt {work['prompt_flop'] / rollout['prompt'] / 1e12:.2f} TFLOP/s, update "
        f"{work['update_flop'] / update['whole'] / 1e12:.2f} TFLOP/s",
        f"together {1 / step:10.2f} steps/s, {flop / step / 1e12:.2f} TFLOP/s; rollout "
        f"{rollout['whole'] / step:.0%}, update {update['whole'] / step:.0%}",
        "measures, time without it / with it:",
        *(f"  {name:48s} {a / b:6.2f}" for name, (a, b) in result["before_after_s"].items()),
        f"{TOTAL_STEPS / 1e6:.1f} M steps: {TOTAL_STEPS * step / 3600:.1f} h as measured",
        report_of_formulas(work),
    ]
    return "\n".join(lines)


def report_of_formulas(work: dict[str, float]) -> str:
    """The result of `count` as a text for the console."""
    bound = work["h100_rollout_s"] + work["h100_update_s"]
    hours = f"{TOTAL_STEPS / 1e6:.1f} M steps on an H100"
    best = TOTAL_STEPS * bound / 3600
    lines = [
        f"operations a step [TFLOP]: rollout {work['rollout_flop'] / 1e12:.3f} (vision "
        f"{work['vision_flop'] / 1e12:.3f}, prompt {work['prompt_flop'] / 1e12:.3f}, decode "
        f"{work['decode_flop'] / 1e12:.3f}), update {work['update_flop'] / 1e12:.3f}",
        f"bytes a step [GB]: rollout {work['rollout_bytes'] / 1e9:.3f}, update {work['update_bytes'] / 1e9:.3f}",
        f"weights {work['weight_bytes'] / 1e9:.2f} GB, {work['trained'] / 1e6:.1f} M trained",
        f"H100 at its limits: {1 / bound:.1f} steps/s (rollout {1e3 * work['h100_rollout_s']:.2f} ms, update "
        f"{1e3 * work['h100_update_s']:.2f} ms a step)",
        f"{hours}: {best:.1f} h at its limits, {best / 0.4:.1f} h at 40 % of them",
    ]
    return "\n".join(lines)


def _seconds(times: dict[str, float]) -> str:
    parts = (f"{name} {t:.3g} s ({t / times['whole']:.0%})" for name, t in times.items() if name != "whole")
    return f"{times['whole']:.3g} s a step, of it " + ", ".join(parts)
