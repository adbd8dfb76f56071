"""What tells that a run, or an evaluation beside it, is not the experiment's though it lies in its place."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from cronos_lerobot.report.runs import TrainingRun


def went_on(run: TrainingRun, planned: int) -> str | None:
    """How a run was gone on with otherwise than its command does, by hand; None if it was not.

    Args:
        run: of an experiment.
        planned: interaction steps that it was to have.
    """
    if run.evaluations and (last := run.last["interaction_steps"]) > planned:
        return f"it was gone on with to {last:,} steps, of {planned:,}"
    if run.changed:
        return "it was gone on with other flags: " + "; ".join(f"{n} {what}" for n, what in run.changed.items())
    if len(run.alike) < len(run.evaluations):
        return "its evaluations were not all made alike"
    return None


def is_of_another(results: Mapping[str, Any], run: TrainingRun) -> bool:
    """Whether results of `cronos-eval` are of another base policy than the one in a folder that a run began with.

    Two machines may clone the same demonstrations to other last bits. Where one of both says no fingerprint, as
    those of earlier versions, they are taken for one.
    """
    files = results.get("policy_files")
    return None not in (files, run.base) and files != run.base
