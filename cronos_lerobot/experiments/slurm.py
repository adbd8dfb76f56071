"""Pipelines on a Slurm cluster: one array, a pipeline an element, submitted and requeued by submitit."""

from __future__ import annotations

import signal
import subprocess
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from cronos_lerobot.experiments.pipeline import CommandFailedError, Pipeline, Runner

JOB_NAME = "cronos"


class Element:
    """A pipeline as an element of an array: pickled here, called on a node.

    Args:
        pipeline: whose commands are run.
        threads: of each command.
    """

    def __init__(self, pipeline: Pipeline, threads: int) -> None:
        self._pipeline, self._threads = pipeline, threads
        self._runner: Runner | None = None
        self._was_told_to_end = False

    def __call__(self) -> None:
        """Run what is not done.

        Raises:
            CommandFailedError: a command failed.
        """
        signal.signal(signal.SIGTERM, self._on_end)
        self._runner = Runner(self._threads)
        try:
            self._runner.run(self._pipeline.commands)
        except CommandFailedError:
            # Slurm requeues what is preempted only if it does not end by itself.
            while self._was_told_to_end:
                time.sleep(60)
            raise

    def checkpoint(self) -> Any:
        """Save, and go on in the next start: submitit calls this shortly before the time limit."""
        from submitit.helpers import DelayedSubmission

        if self._runner is not None:
            self._runner.stop()
        return DelayedSubmission(Element(self._pipeline, self._threads))

    def _on_end(self, number: int, frame: Any) -> None:
        self._was_told_to_end = True


def submit(
    pipelines: Sequence[Pipeline], folder: Path, parameters: dict[str, Any], threads: int, requeues: int
) -> list[Any]:
    """Submit pipelines as one array; returns submitit's jobs.

    Args:
        pipelines: at least one.
        folder: for logs, on a disk that all nodes share.
        parameters: of submitit's `SlurmExecutor`, without the prefix `slurm_`.
        threads: of each command.
        requeues: how often an element may come to its time limit.

    Raises:
        ValueError: pipelines of this folder are in the queue already.
    """
    import submitit

    folder = folder.resolve()
    name = f"{JOB_NAME}-{folder.parent.name}"
    queued = subprocess.run(["squeue", "--me", "--noheader", f"--name={name}"], capture_output=True, text=True)
    if waiting := queued.stdout.splitlines():
        raise ValueError(
            f"{len(waiting)} jobs called {name} are in the queue: wait for them, or `scancel --name={name}`."
        )
    executor = submitit.SlurmExecutor(folder, max_num_timeout=requeues)
    executor.update_parameters(job_name=name, cpus_per_task=threads, stderr_to_stdout=True, **parameters)
    with executor.batch():
        return [executor.submit(Element(pipeline, threads)) for pipeline in pipelines]
